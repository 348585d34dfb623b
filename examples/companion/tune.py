"""A program on the companion computer. It uses the vehicle over the service like over its own link.

    python examples/companion/tune.py http://127.0.0.1:8765 MC_ROLL_P 6.5

If the service requires a token, it is in the environment variable PARAMCLIENT_TOKEN.
"""

import asyncio
import sys

from paramclient import ParamClient


async def main(service: str, name: str, value: float) -> None:
    async with ParamClient(service) as client:
        vehicle = await client.only_component(timeout=30)
        result = await vehicle.fetch_all()
        print(f"{result.received} parameters, {len(result.missing)} missing")
        known = vehicle.params.get(name)
        changes = vehicle.changes()
        done = await vehicle.set(name, value)
        print(f"{done.status}: {name} = {done.actual!r}")
        if known is not None and known.value == done.actual:
            return  # the vehicle had the value already: nothing has changed
        async for change in changes:
            if change.name == name and change.new is not None:
                print(f"all clients receive: {name} = {change.new.value!r}, by {change.by}")
                break


if __name__ == "__main__":
    service, name, value = sys.argv[1:]
    asyncio.run(main(service, name, float(value)))
