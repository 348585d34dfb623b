"""Fetch the tables of two vehicles on one link concurrently, and print the differences.

python examples/two_vehicles.py [LINK [SYSTEM SYSTEM]]

Without a link: two simulated PX4 vehicles on one radio, with different tuning.
"""

from __future__ import annotations

import asyncio
import sys

from paramclient import ParamClient
from paramclient.sim import Air, PX4Vehicle


def simulated() -> Air:
    tuned = PX4Vehicle(system=2)
    tuned.set_param("MC_ROLL_P", 8.0)
    tuned.set_param("MC_YAW_P", 2.0)
    return Air([PX4Vehicle(system=1), tuned])


async def main(link: str | None = None, first: str = "1", second: str = "2") -> None:
    async with ParamClient(link or simulated()) as client:
        one, two = await asyncio.gather(client.component(int(first)), client.component(int(second)))
        fetched = await client.fetch_all()
        for result in fetched.results.values():
            print(result)
        for name in sorted(one.params.keys() & two.params.keys()):
            if not one.params[name].same_value(two.params[name]):
                print(f"{one.params[name]} on {one.system}, {two.params[name]} on {two.system}")


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
