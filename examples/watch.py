"""Print every change of a vehicle's parameters, by any source, until Ctrl-C.

python examples/watch.py [LINK]

Without a link, a simulated vehicle changes two values, and the example ends after them.
"""

from __future__ import annotations

import asyncio
import sys
from contextlib import suppress

from paramclient import ParamClient
from paramclient.sim import PX4Vehicle

ON_BOARD = {"MC_PITCH_P": 7.5, "MC_ROLL_P": 7.0}


async def main(link: str | None = None) -> None:
    simulated = PX4Vehicle()
    async with ParamClient(link or simulated) as client:
        vehicle = await client.component()
        await vehicle.fetch_all()
        print(vehicle)
        changes = vehicle.changes()  # all changes from here on are queued
        awaited = set(ON_BOARD)
        for name in awaited:
            simulated.set_param(name, ON_BOARD[name])
        async for change in changes:
            print(f"{change.old} -> {change.new}, by {change.by}")
            awaited.discard(change.name)
            if link is None and not awaited:
                break


if __name__ == "__main__":
    with suppress(KeyboardInterrupt):
        asyncio.run(main(*sys.argv[1:]))
