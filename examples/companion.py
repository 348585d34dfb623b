"""A companion computer: `paramclient serve` on a serial port, used by a program and a script concurrently.

    python examples/companion.py

The serial port is a pseudo-terminal of this computer with a simulated PX4 at the other end, at the rate of a
port with 115200 baud. The two programs in `examples/companion/` use it, as they would on board.
"""

import os
import pty
import re
import subprocess
import sys
import tempfile
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from paramclient.sim import PX4Vehicle

HERE = Path(__file__).parent / "companion"
COMMAND = [sys.executable, "-m", "paramclient"]
PORTION = 64
BYTES_A_SECOND = 11520


@contextmanager
def flight_controller() -> Iterator[str]:
    """Run a simulated PX4 on a serial port; yield the name of the port."""
    board, port = pty.openpty()
    tty.setraw(port)
    os.set_blocking(board, False)
    is_over = threading.Event()

    def fly() -> None:
        vehicle = PX4Vehicle(stream=True)
        waiting = b""
        while not is_over.wait(PORTION / BYTES_A_SECOND):
            now = time.monotonic()
            with suppress(BlockingIOError):
                vehicle.receive(os.read(board, PORTION), now)
            vehicle.tick(now)
            waiting += b"".join(vehicle.data_to_send())
            with suppress(BlockingIOError):
                waiting = waiting[os.write(board, waiting[:PORTION]) :]

    thread = threading.Thread(target=fly)
    thread.start()
    try:
        yield os.ttyname(port)
    finally:
        is_over.set()
        thread.join()
        os.close(board)
        os.close(port)


@contextmanager
def service(port: str, folder: Path) -> Iterator[tuple[str, str]]:
    """Run `paramclient serve` on that port; yield its URL and a token that allows writes."""
    tokens = folder / "tokens"
    token = subprocess.run(
        [*COMMAND, "token", "companion", "--file", tokens], check=True, capture_output=True, text=True
    ).stdout.strip()
    options: list[str | Path] = ["--listen", "127.0.0.1:0", "--tokens", tokens]
    options += ["--cache", folder / "cache.sqlite3"]
    command = [*COMMAND, "serve", f"serial:{port}:115200", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as serving:
        try:
            assert serving.stdout is not None
            found = re.search("http://[^ \n]+", serving.stdout.readline())
            assert found is not None, "the service did not start"
            yield found[0], token
        finally:
            serving.terminate()
            print(f"the service has ended with {serving.wait()}")


def main() -> None:
    with (
        tempfile.TemporaryDirectory() as folder,
        flight_controller() as port,
        service(port, Path(folder)) as (address, token),
    ):
        print(f"serving {port} on {address}", flush=True)
        both = [
            subprocess.Popen([*command, address, *arguments], env=os.environ | {"PARAMCLIENT_TOKEN": token})
            for command, arguments in (
                ([sys.executable, str(HERE / "tune.py")], ["MC_ROLL_P", "6.5"]),
                (["sh", str(HERE / "check.sh")], ["BAT1_N_CELLS", "6"]),
            )
        ]
        failed = sum(program.wait() != 0 for program in both)
        if failed:
            raise SystemExit(f"{failed} of the two programs failed")


if __name__ == "__main__":
    main()
