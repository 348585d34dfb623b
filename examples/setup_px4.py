"""Set a PX4 vehicle up from a parameter file: show, keep what was before, apply, start again, verify.

python examples/setup_px4.py [LINK [FILE]]

Ended in the middle, it goes on from what the vehicle has when it is run again.
"""

from __future__ import annotations

import asyncio
import sys
import tempfile
import time
from pathlib import Path

from paramclient import (
    Component,
    LinkError,
    NoReply,
    ParamClient,
    ParamSet,
    UsageError,
    VehicleError,
    read_file,
)
from paramclient.provision import ApplyProgress, PlanStatus, apply, prepare, verify

FILE = Path(__file__).parent / "parameters/px4/quad.params"


async def main(link: str, file: Path) -> bool:
    wanted = read_file(file).choose()
    async with ParamClient(link) as client:
        vehicle = await client.only_component()
        if vehicle.autopilot != "px4":
            raise UsageError(f"this is for px4, and the vehicle is {vehicle.autopilot}")
        if not await show(vehicle, wanted):
            return False
        backup = Path(tempfile.gettempdir()) / f"before-{time.strftime('%Y%m%dT%H%M%S')}.yaml"
        result = await apply(vehicle, wanted, reboot=True, backup=backup, progress=tell)
        print(f"{result}; what was before is in {backup.name}")
        if result.error is not None:
            print("ended before its time:", result.error)
            return False
        vehicle = await client.component(result.system, result.component)  # another id, if the file sets one
        state = await verify(vehicle, wanted)
        print("as the file says" if state.is_met else "NOT as the file says")
        return state.is_met


async def show(vehicle: Component, wanted: ParamSet) -> bool:
    """Print what is going to be done; whether it can be."""
    plan = await prepare(vehicle, wanted)
    for stage in plan.stages:
        print(f"{stage.purpose}:")
        for step in stage.steps:
            print(f"  {step}{' (from the next start on)' if step.needs_reboot else ''}")
    for row in plan.rows.values():
        if row.reason:
            print(row)
    return not plan.of(PlanStatus.INVALID)


def tell(how_far: ApplyProgress) -> None:
    if how_far.row is not None:
        print(f"{how_far.done}/{how_far.total} {how_far.row}")
    elif how_far.phase == "rebooting":
        print("the vehicle starts again")


if __name__ == "__main__":
    try:
        is_done = asyncio.run(
            main(
                sys.argv[1] if len(sys.argv) > 1 else "sim:px4",
                Path(sys.argv[2]) if len(sys.argv) > 2 else FILE,
            )
        )
    except (UsageError, VehicleError, NoReply, LinkError) as error:  # nothing was set
        sys.exit(str(error))
    sys.exit(not is_done)
