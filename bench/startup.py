"""Time from the start of the command's process to its first byte on the link, and time of a shell completion.

    python bench/startup.py [ROUNDS]

Prints the minimum and the median of several rounds in seconds. The targets are 0.4 s and 0.3 s.
"""

from __future__ import annotations

import os
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from paramclient.cli.completion import COMPLETION_VARIABLE

START_TIMEOUT = 30.0
"""Timeout of one round in seconds, after which nothing was sent."""


def main() -> None:
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 15
    with tempfile.TemporaryDirectory() as folder:
        times = [first_byte_after(Path(folder) / "cache.sqlite3") for _ in range(rounds)]
        completions = completion_times(Path(folder), rounds)
    print(
        f"first byte after {min(times):.3f} s at best, {statistics.median(times):.3f} s in the median "
        f"of {rounds} rounds (promised: 0.4 s)"
    )
    print(
        f"completion of a parameter name after {min(completions):.3f} s at best, "
        f"{statistics.median(completions):.3f} s in the median (promised: 0.3 s)"
    )


def first_byte_after(cache: Path) -> float:
    """Run `fetch` against a socket that only listens; return the seconds until the first datagram."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(START_TIMEOUT)
        url = f"udpout:127.0.0.1:{listener.getsockname()[1]}"
        command = [sys.executable, "-m", "paramclient", "fetch", url, "--json", "--cache", str(cache)]
        began = time.perf_counter()
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            try:
                listener.recv(1)
                return time.perf_counter() - began
            finally:
                process.terminate()


def completion_times(folder: Path, rounds: int) -> list[float]:
    """Complete a parameter name of a cached PX4 several times; return the seconds of each process."""
    cache = str(folder / "vehicles.sqlite3")
    command = [sys.executable, "-m", "paramclient"]
    subprocess.run([*command, "fetch", "sim:px4", "--cache", cache], stdout=subprocess.DEVNULL, check=True)
    words = [*command, "get", "udpin:0.0.0.0:14550", "--cache", cache, "MC_ROLL_P"]
    environment = os.environ | {COMPLETION_VARIABLE: "fish", "XDG_CACHE_HOME": str(folder)}
    times = []
    for _ in range(rounds + 1):
        began = time.perf_counter()
        done = subprocess.run(words, env=environment, stdout=subprocess.PIPE, encoding="utf-8", check=True)
        times.append(time.perf_counter() - began)
        if not done.stdout.startswith("MC_ROLL_P"):
            raise SystemExit(f"the completion printed {done.stdout!r}")
    return times[1:]  # the first one writes the table of options


if __name__ == "__main__":
    main()
