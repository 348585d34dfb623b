"""A small program for vehicles, and its tests on simulated vehicles with the fixtures of the pytest plugin.

pytest examples/test_your_program.py           run the tests
python examples/test_your_program.py [LINK]    run the program
"""

from __future__ import annotations

import asyncio
import sys

import pytest

from paramclient import ParamClient
from paramclient.links import Link
from paramclient.sim import Endpoint
from paramclient.testing import MakeArduPilot, MakePX4

INDOOR = {"MPC_XY_VEL_MAX": 2.0, "MPC_Z_VEL_MAX_UP": 1.0, "COM_RC_IN_MODE": 1}


# The program


async def prepare_for_indoors(link: str | Link | Endpoint) -> list[str]:
    """Limit a PX4 vehicle's speed; return the names of the parameters that were changed."""
    async with ParamClient(link) as client:
        vehicle = await client.only_component()
        if vehicle.autopilot != "px4":
            raise ValueError(f"this program needs a px4 vehicle, and the vehicle is {vehicle.autopilot}")
        changed = []
        for name, wanted in INDOOR.items():
            if (await vehicle.get(name)).value != wanted:
                await vehicle.set(name, wanted)
                changed.append(name)
        return changed


# Its tests: sim_px4 and sim_ardupilot create vehicles, whose values the tests can read


def test_sets_the_limits(sim_px4: MakePX4) -> None:
    px4 = sim_px4()
    asyncio.run(prepare_for_indoors(px4))
    assert {name: px4.vehicle.values[name] for name in INDOOR} == INDOOR


def test_does_not_write_values_that_are_right(sim_px4: MakePX4) -> None:
    px4 = sim_px4(table=INDOOR)
    assert asyncio.run(prepare_for_indoors(px4)) == []
    assert px4.vehicle.requests["PARAM_SET"] == 0


def test_works_on_a_lossy_radio(sim_px4: MakePX4) -> None:
    px4 = sim_px4(loss=0.2, delay=0.02, jitter=0.02, seed=7)
    asyncio.run(prepare_for_indoors(px4))
    assert {name: px4.vehicle.values[name] for name in INDOOR} == INDOOR


def test_refuses_other_autopilots(sim_ardupilot: MakeArduPilot) -> None:
    ardupilot = sim_ardupilot()
    with pytest.raises(ValueError, match="the vehicle is ardupilot"):
        asyncio.run(prepare_for_indoors(ardupilot))
    assert ardupilot.vehicle.requests["PARAM_SET"] == 0


if __name__ == "__main__":
    link = sys.argv[1] if len(sys.argv) > 1 else "sim:px4"
    print("changed:", asyncio.run(prepare_for_indoors(link)) or "nothing")
