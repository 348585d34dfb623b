"""Write parameters, and handle every possible outcome.

python examples/set_and_prove.py [LINK [NAME VALUE ...]]
"""

from __future__ import annotations

import asyncio
import sys

from paramclient import LinkError, NoReply, ParamClient, UsageError, VehicleError

EXAMPLES = ["MC_ROLL_P", "7.0", "COM_DISARM_LAND", "3", "SYS_AUTOSTART", "1.5", "NO_SUCH", "1"]


async def main(link: str, pairs: list[str]) -> None:
    async with ParamClient(link) as client:
        vehicle = await client.only_component()
        for name, text in zip(pairs[::2], pairs[1::2], strict=True):
            try:
                done = await vehicle.set(name, int(text) if text.lstrip("-").isdecimal() else float(text))
            except UsageError as error:  # the value is invalid; nothing was sent
                print("wrong:  ", error)
            except VehicleError as error:  # the vehicle refused the value
                print("refused:", error)
            except NoReply as error:  # the vehicle may have accepted the value or not
                print("silent: ", error)
            else:
                print("done:   ", done)


if __name__ == "__main__":
    try:
        asyncio.run(main(sys.argv[1] if len(sys.argv) > 1 else "sim:px4", sys.argv[2:] or EXAMPLES))
    except LinkError as error:
        sys.exit(str(error))
