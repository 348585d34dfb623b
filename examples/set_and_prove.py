"""Write parameters, and handle everything that can become of it.

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
            except UsageError as error:  # it cannot be right; nothing was sent
                print("wrong:  ", error)
            except VehicleError as error:  # the vehicle answered, and the answer is no
                print("refused:", error)
            except NoReply as error:  # whether it has taken the value is not known
                print("silent: ", error)
            else:
                print("done:   ", done)


if __name__ == "__main__":
    try:
        asyncio.run(main(sys.argv[1] if len(sys.argv) > 1 else "sim:px4", sys.argv[2:] or EXAMPLES))
    except LinkError as error:
        sys.exit(str(error))
