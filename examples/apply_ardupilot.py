"""Apply a shared file to ArduPilot vehicles and own values of each; restore a vehicle on failure.

python examples/apply_ardupilot.py [LINK [FILE]]
"""

from __future__ import annotations

import asyncio
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from paramclient import Component, ParamClient, ParamClientError, ParamSet, UsageError, read_file
from paramclient.provision import apply, for_each, plan, restore

FILE = Path(__file__).parent / "parameters/ardupilot/copter.param"

OWN: dict[int, dict[str, int | float]] = {
    1: {"BATT_CAPACITY": 5200},
    2: {"BATT_CAPACITY": 3300, "WPNAV_SPEED": 500.0},
}
"""Values of single vehicles, by system id."""


async def main(link: str, file: Path) -> bool:
    shared = read_file(file).choose()

    def wanted(vehicle: Component) -> ParamSet:
        return replace(shared, params=ParamSet({**shared.params, **OWN.get(vehicle.system, {})}))

    def backup(vehicle: Component) -> Path:
        return Path(tempfile.gettempdir()) / f"before-{vehicle.system}-{started}.json"

    started = time.strftime("%Y%m%dT%H%M%S")
    async with ParamClient(link) as client:
        vehicles = [each for each in await client.find_autopilots() if each.autopilot == "ardupilot"]
        if not vehicles:
            raise UsageError(f"{link} has no ArduPilot")
        applied = await for_each(
            vehicles, lambda each: apply(each, wanted(each), reboot=True, backup=backup(each))
        )
        for (system, _), error in applied.errors.items():
            print(f"{system}: nothing was written: {error}")
        for (system, component), result in applied.results.items():
            print(f"{system}: {result}")
            for row in result.rows.values():
                if row.reason:
                    print(f"{system}: {row}")
            if result.complete:
                continue
            vehicle = await client.component(result.system, component)
            back = await restore(vehicle, result.before, reboot=True)
            print(
                f"{system}: restored to its state before"
                if back.complete
                else f"{system}: NEITHER APPLIED NOR RESTORED: {back}"
            )
        verified = await for_each(vehicles, lambda each: plan(each, wanted(each)))
        for (system, _), planned in verified.results.items():
            print(f"{system}: {'as wanted' if planned.complete else 'NOT as wanted'}")
        return applied.complete and verified.complete


if __name__ == "__main__":
    try:
        is_done = asyncio.run(
            main(
                sys.argv[1] if len(sys.argv) > 1 else "sim:ardupilot",
                Path(sys.argv[2]) if len(sys.argv) > 2 else FILE,
            )
        )
    except ParamClientError as error:
        sys.exit(str(error))
    sys.exit(not is_done)
