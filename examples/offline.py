"""Read a vehicle's parameters from the cache, without a link.

python examples/offline.py [LINK]

First fetches the parameters from the vehicle, which fills the cache; then reads everything from the disk.
"""

from __future__ import annotations

import asyncio
import sys
import time

from paramclient import ParamCache, ParamClient


async def visit(link: str) -> str:
    """Fetch all parameters; return the key of the vehicle in the cache."""
    async with ParamClient(link) as client:
        vehicle = await client.only_component()
        print("visit:", await vehicle.fetch_all())
        if link == "sim:px4":  # adds a change to the history; a real vehicle is only read
            await vehicle.set("MC_ROLL_P", 7.0)
        return vehicle.identity.key


def look(key: str) -> None:
    """Print the cached table and its history. Needs no link."""
    with ParamCache() as cache:
        for known in cache.vehicles():
            print("known:", known)
        table = cache.component(key)
        print("table:", table)
        for name in list(table.params)[:5]:
            age = time.time() - table.heard_at[name]
            print(f"  {table.params[name]}, received {age:.0f} s ago")
        for entry in cache.history(table.key, table.component, limit=5):
            print(f"  {entry.old} -> {entry.new}, by {entry.by}")


if __name__ == "__main__":
    look(asyncio.run(visit(sys.argv[1] if len(sys.argv) > 1 else "sim:px4")))
