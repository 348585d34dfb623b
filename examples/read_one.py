"""Read parameters from a vehicle.

python examples/read_one.py [LINK [NAME ...]]
"""

from __future__ import annotations

import asyncio
import sys

from paramclient import ParamClient, UnknownParameter


async def main(link: str = "sim:px4", *names: str) -> None:
    async with ParamClient(link) as client:
        vehicle = await client.component()  # the first autopilot heard
        for name in names or ("MC_ROLL_P",):
            try:
                param = await vehicle.get(name)
            except UnknownParameter as error:
                print(error)
            else:
                print(f"{param}   (index {param.index}, bits {param.bits:08x})")


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
