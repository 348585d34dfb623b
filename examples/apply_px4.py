"""Apply a parameter file to a PX4 vehicle: show the plan, back up, apply, reboot, verify.

python examples/apply_px4.py [LINK [FILE]]

After an interruption, run it again to continue.
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
from paramclient.provision import ApplyProgress, apply, plan

FILE = Path(__file__).parent / "parameters/px4/quad.params"


async def main(link: str, file: Path) -> bool:
    wanted = read_file(file).choose()
    async with ParamClient(link) as client:
        vehicle = await client.only_component()
        if vehicle.autopilot != "px4":
            raise UsageError(f"this program needs a px4 vehicle, and the vehicle is {vehicle.autopilot}")
        if not await show(vehicle, wanted):
            return False
        backup = Path(tempfile.gettempdir()) / f"before-{time.strftime('%Y%m%dT%H%M%S')}.json"
        result = await apply(vehicle, wanted, reboot=True, backup=backup, progress=show_progress)
        print(f"{result}; the state before is in {backup.name}")
        if result.error is not None:
            print("ended early:", result.error)
            return False
        vehicle = await client.component(
            result.system, result.component
        )  # the file may set another system id
        state = await plan(vehicle, wanted)
        print("the vehicle matches the file" if state.complete else "the vehicle does NOT match the file")
        return state.complete


async def show(vehicle: Component, wanted: ParamSet) -> bool:
    """Print the plan; return whether `apply` accepts the file."""
    planned = await plan(vehicle, wanted)
    for stage in planned.stages:
        print(f"{stage.purpose}:")
        for row in stage.rows:
            print(f"  {row}{' (takes effect after a reboot)' if row.needs_reboot else ''}")
    for row in planned.rows.values():
        if row.reason:
            print(row)
    return not planned.problems


def show_progress(progress: ApplyProgress) -> None:
    if progress.row is not None:
        print(f"{progress.done}/{progress.total} {progress.row}")
    elif progress.phase == "rebooting":
        print("the vehicle reboots")


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
