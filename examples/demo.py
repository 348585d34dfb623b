"""Fetch, cache and set parameters of a simulated PX4 vehicle, over real UDP on loopback: `make demo`.

Fetches every parameter, fetches again from the cache, and sets one parameter; prints the time and bytes of
each step. The cache is temporary, and the system chooses the port.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import anyio
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as ProgressBar
from rich.table import Table

from paramclient import Component, FetchResult, ParamClient, Progress
from paramclient.links import parse_link, serve_endpoint
from paramclient.links.sockets import UdpIn
from paramclient.sim import PX4Vehicle

NAME, WANTED = "MC_ROLL_P", 7.25

console = Console(highlight=False, soft_wrap=True)


async def main(cache: Path) -> bool:
    """Serve a simulated vehicle on UDP and run the demo against it; return whether every step succeeded."""
    px4 = PX4Vehicle()
    far_end = UdpIn(parse_link("udpin:127.0.0.1:0"))
    async with anyio.create_task_group() as tasks:
        await tasks.start(serve_endpoint, px4, far_end)
        assert far_end.address is not None
        host, port = far_end.address
        console.print(f"A simulated PX4 vehicle listens on {host}:{port}. The cache is empty.\n")
        is_good = await run(px4, f"udpout:{host}:{port}", cache)
        tasks.cancel_scope.cancel()
    return is_good


async def run(px4: PX4Vehicle, url: str, cache: Path) -> bool:
    """Run the three steps of the demo; return whether every step succeeded."""
    costs = Table("", "seconds", "bytes received", "bytes sent", box=None, pad_edge=False)
    for column in costs.columns[1:]:
        column.justify = "right"

    console.print("[bold]1. A cold fetch[/bold] of every parameter")
    async with ParamClient(url, cache=cache) as client:
        meter = Meter(client, costs)
        await meter.wait_for_heartbeat()
        vehicle = await client.component()
        cold = await fetch_with_bar(vehicle)
        meter.lap("cold fetch")
    console.print(f"   {cold.received} parameters, {len(cold.missing)} missing, hash {cold.hash or 0:08x}\n")

    console.print("[bold]2. A second run[/bold]: a new client, the same cache")
    async with ParamClient(url, cache=cache) as client:
        meter = Meter(client, costs)
        await meter.wait_for_heartbeat()
        vehicle = await client.component()
        warm = await vehicle.fetch_all()
        meter.lap("second run, from the cache")
        is_equal = {name: param.value for name, param in vehicle.params.items()} == px4.values
        console.print(
            f"   {warm.received} parameters from the {warm.source}, confirmed by the vehicle's hash"
        )
        console.print(f"   equal to the vehicle's own table: {'yes' if is_equal else 'NO'}\n")

        console.print("[bold]3. One set[/bold], confirmed by the value that the vehicle reports")
        vehicle = await client.only_component()
        meter.reset()
        done = await vehicle.set(NAME, WANTED)
        meter.lap("one set, confirmed")
    on_board = px4.param(NAME).value
    console.print(f"   {done.status}: {done}; on board: {on_board!r}\n")

    console.print(costs)
    return cold.complete and warm.source == "cache" and is_equal and on_board == WANTED


async def fetch_with_bar(vehicle: Component) -> FetchResult:
    rate = TextColumn("{task.fields[rate]:.0f} a second")
    columns = (TextColumn(" "), BarColumn(40), MofNCompleteColumn(), rate, TimeRemainingColumn())
    with ProgressBar(*columns, console=console) as bar:
        task = bar.add_task("", total=None, rate=0.0)

        def show(progress: Progress) -> None:
            bar.update(task, completed=progress.received, total=progress.total, rate=progress.rate)

        return await vehicle.fetch_all(progress=show)


class Meter:
    """Measures seconds and bytes between two lines of the table."""

    def __init__(self, client: ParamClient, costs: Table) -> None:
        self._client = client
        self._costs = costs
        self.reset()

    def reset(self) -> None:
        """Start a new measurement."""
        self._began = time.perf_counter()
        self._received, self._sent = self._client.bytes_received, self._client.bytes_sent

    async def wait_for_heartbeat(self) -> None:
        """Wait for the first heartbeat; its wait of up to 1 s is not counted, its bytes are."""
        while not self._client.components:  # noqa: ASYNC110 - component() waits for more than that
            await anyio.sleep(0.001)
        self._began = time.perf_counter()

    def lap(self, step: str) -> None:
        """Add a line to the table."""
        seconds = time.perf_counter() - self._began
        received, sent = self._client.bytes_received - self._received, self._client.bytes_sent - self._sent
        self._costs.add_row(step, f"{seconds:.4f}", f"{received:,}", f"{sent:,}")
        self.reset()


if __name__ == "__main__":
    with tempfile.TemporaryDirectory(prefix="paramclient-demo-") as folder:
        try:
            is_good = anyio.run(main, Path(folder, "parameters.sqlite3"))
        except* SystemExit:  # rich's, if the reader of the output has ended, as in `make demo | head`
            is_good = True
        sys.exit(not is_good)
