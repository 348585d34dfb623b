"""Look at a vehicle's parameters when there is no vehicle: the cache has what was heard last.

python examples/offline.py [LINK]

First a visit to the vehicle, which fills the cache; then everything from the disk alone.
"""

from __future__ import annotations

import asyncio
import sys
import time

from paramclient import ParamCache, ParamClient


async def visit(link: str) -> str:
    """Fetch everything; give the name under which the cache keeps the vehicle."""
    async with ParamClient(link) as client:
        vehicle = await client.only_component()
        print("visit:", await vehicle.fetch_all())
        if link == "sim:px4":  # leave a trace in the history; a real vehicle is only looked at
            await vehicle.set("MC_ROLL_P", 7.0)
        return vehicle.identity.key


def look(key: str) -> None:
    """Everything below works with no link."""
    with ParamCache() as cache:
        for known in cache.vehicles():
            print("known:", known)
        table = cache.component(key)
        print("table:", table)
        for name in list(table.params)[:5]:
            age = time.time() - table.heard_at[name]
            print(f"  {table.params[name]}, heard {age:.0f} s ago")
        for entry in table.history(limit=5):
            print(f"  {entry.old} -> {entry.new}, by {entry.by}")


if __name__ == "__main__":
    look(asyncio.run(visit(sys.argv[1] if len(sys.argv) > 1 else "sim:px4")))
