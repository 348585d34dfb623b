"""Simulated vehicles as links, and on links.

`SimLink` runs a vehicle inside the program: no socket, no port, the real clock. `serve_endpoint` runs a
vehicle on a real link, for other programs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import anyio
import anyio.abc
import anyio.lowlevel

from paramclient.errors import UsageError
from paramclient.links.link import BaseLink, Link, Peer
from paramclient.links.names import VEHICLE_OPTIONS, LinkSpec

if TYPE_CHECKING:
    from paramclient.sim import Endpoint

SIM_PEER: Final = "sim"
"""The only peer of a `SimLink`."""

LISTEN_TIME_MIN: Final = 0.001
"""Seconds for which `serve_endpoint` listens at least, also when the vehicle is behind schedule."""


class SimLink(BaseLink):
    """A link whose remote end is an object in this process.

    Args:
        endpoint: a vehicle or an `Air` of `paramclient.sim`, or any object with the same four methods. Runs
            on the event loop's clock, and keeps its state when the link is opened again.
        name: the link's name; the cache uses it to identify vehicles without a hardware id.
    """

    reconnects = False

    def __init__(self, endpoint: Endpoint, name: str = "sim:custom") -> None:
        super().__init__(name)
        self.endpoint = endpoint
        self._wake = anyio.Event()

    @property
    def has_one_vehicle(self) -> bool:
        """Whether the remote end is certain to be a single vehicle, so that looking for others is useless."""
        return getattr(self.endpoint, "vehicle_count", None) == 1

    async def receive(self) -> list[tuple[Peer, bytes]]:
        """See `Link.receive`."""
        while True:
            await anyio.lowlevel.checkpoint()
            self._opened()
            wait = _work(self.endpoint)
            data = self.endpoint.data_to_send()
            if data:
                return [(SIM_PEER, datagram) for datagram in data]
            self._wake = anyio.Event()
            with anyio.move_on_after(wait):
                await self._wake.wait()

    async def send(self, data: bytes, peer: Peer | None) -> None:
        """See `Link.send`."""
        await anyio.lowlevel.checkpoint()
        self._opened()
        if peer in (None, SIM_PEER):
            self.endpoint.receive(data, anyio.current_time())
            self._wake.set()

    async def _open(self, opening: int) -> None:
        await anyio.lowlevel.checkpoint()
        self.endpoint.tick(anyio.current_time())

    async def _release(self) -> None:
        self._wake.set()


async def serve_endpoint(
    endpoint: Endpoint,
    link: Link,
    *,
    task_status: anyio.abc.TaskStatus[Link] = anyio.TASK_STATUS_IGNORED,
) -> None:
    """Run a simulated vehicle on a link until cancelled. Opens the link, and closes it at the end.

    Data of the vehicle goes to every peer: on `udpout` from the start, on `udpin` and `tcpin` after the first
    peer has sent data or connected. With `await task_group.start(serve_endpoint, vehicle, link)`, the link is
    open on return, and its address is known.

    Raises:
        LinkError: the link cannot be opened, or dropped.
    """
    try:
        await link.open()
        task_status.started(link)
        while True:
            wait = _work(endpoint)
            for datagram in endpoint.data_to_send():
                await link.send(datagram, None)
            with anyio.move_on_after(None if wait is None else max(wait, LISTEN_TIME_MIN)):
                for _, data in await link.receive():
                    endpoint.receive(data, anyio.current_time())
    finally:
        await link.close()


def simulated(spec: LinkSpec, **options: Any) -> SimLink:
    """Return the vehicle of a `sim:` name, behind a faulty link with the faults of its options.

    Args:
        spec: the parsed name.
        options: further options of the vehicle.
    """
    from paramclient import sim  # imported here: loads parameter tables

    kinds = {"px4": sim.PX4Vehicle, "ardupilot": sim.ArduPilotVehicle, "camera": sim.Camera}
    faults: dict[str, Any] = dict(spec.options)
    options |= {key: faults.pop(key) for key in VEHICLE_OPTIONS if key in faults}
    if "metadata" in options and spec.host != "px4":
        raise UsageError(f"{spec}: option metadata is for sim:px4; other vehicles describe no parameters")
    vehicle = kinds[spec.host](**options)
    return SimLink(sim.Air.symmetric([vehicle], **faults) if faults else vehicle, spec.name)


def _work(endpoint: Endpoint) -> float | None:
    """Run the endpoint's due work; return the seconds until its next work, or None if it waits for bytes."""
    now = anyio.current_time()
    endpoint.tick(now)
    deadline = endpoint.next_deadline()
    return None if deadline is None else max(0.0, deadline - now)
