"""A small program for vehicles, and its tests against simulated ones.

python examples/test_your_program.py           run the tests; pytest finds them as well
python examples/test_your_program.py LINK      run the program
"""

from __future__ import annotations

import asyncio
import sys
from contextlib import suppress

from paramclient import ParamClient
from paramclient.links import Link
from paramclient.sim import Air, ArduPilotVehicle, Endpoint, PX4Vehicle

INDOOR = {"MPC_XY_VEL_MAX": 2.0, "MPC_Z_VEL_MAX_UP": 1.0, "COM_RC_IN_MODE": 1}


# the program


async def prepare_for_indoors(link: str | Link | Endpoint) -> list[str]:
    """Limit a PX4 vehicle's speed; give the names of the parameters that had to be changed."""
    async with ParamClient(link, cache=False) as client:
        vehicle = await client.component()
        if vehicle.autopilot != "px4":
            raise ValueError(f"this is for px4, and the vehicle is {vehicle.autopilot}")
        changed = []
        for name, wanted in INDOOR.items():
            if (await vehicle.get(name)).value != wanted:
                await vehicle.set(name, wanted)
                changed.append(name)
        return changed


# its tests: a vehicle is an ordinary object, and what is on board can be looked at


def test_sets_the_limits() -> None:
    px4 = PX4Vehicle()
    asyncio.run(prepare_for_indoors(px4))
    assert {name: px4.param(name).value for name in INDOOR} == INDOOR


def test_leaves_alone_what_is_right() -> None:
    px4 = PX4Vehicle()
    for name, value in INDOOR.items():
        px4.set_param(name, value)
    assert asyncio.run(prepare_for_indoors(px4)) == []
    assert px4.requests["PARAM_SET"] == 0


def test_works_on_a_bad_radio() -> None:
    px4 = PX4Vehicle()
    asyncio.run(prepare_for_indoors(Air.symmetric([px4], loss=0.2, delay=0.02, jitter=0.02, seed=7)))
    assert {name: px4.param(name).value for name in INDOOR} == INDOOR


def test_refuses_other_autopilots() -> None:
    ardupilot = ArduPilotVehicle()
    with suppress(ValueError):
        asyncio.run(prepare_for_indoors(ardupilot))
        raise AssertionError("it took an ArduPilot for a PX4")
    assert ardupilot.requests["PARAM_SET"] == 0


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print("changed:", asyncio.run(prepare_for_indoors(sys.argv[1])) or "nothing")
    else:
        for name, test in list(globals().items()):
            if name.startswith("test_"):
                test()
                print("passed:", name)
