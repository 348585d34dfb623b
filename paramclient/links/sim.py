"""Simulated vehicles as links, and on links.

`SimLink` puts a vehicle into the program itself: no socket, no port, the real clock. `serve_endpoint` puts
one onto a real link, for other programs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import anyio
import anyio.abc
import anyio.lowlevel

from paramclient.errors import LinkError
from paramclient.links.names import LinkSpec

if TYPE_CHECKING:
    from paramclient.links.link import Link, Peer
    from paramclient.sim import Endpoint

__all__ = ["SimLink", "serve_endpoint", "simulated"]

SIM_PEER: Final = "sim"
"""The one peer of a `SimLink`."""

SHORTEST_WAIT: Final = 0.001
"""Seconds for which `serve_endpoint` listens at least, also when the vehicle is late with its own work."""


class SimLink:
    """A link whose far end is an object in this process.

    Args:
        endpoint: a vehicle or an `Air` of `paramclient.sim`, or anything with the same four methods. It
            lives on the event loop's clock, and goes on where it stood when the link is opened again.
        name: what the link is called; the cache tells vehicles without a hardware id apart by it.
    """

    is_stream = False
    reconnects = False

    def __init__(self, endpoint: Endpoint, name: str = "sim:custom") -> None:
        self.name = name
        self.endpoint = endpoint
        self._wake: anyio.Event | None = None

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name} {'closed' if self._wake is None else 'open'}>"

    @property
    def has_one_vehicle(self) -> bool:
        """Whether it is certain that there is one vehicle at the far end, and no second one to look for."""
        return getattr(self.endpoint, "vehicle_count", None) == 1

    async def open(self) -> None:
        """See `Link.open`; switches the vehicle on."""
        await anyio.lowlevel.checkpoint()
        self._wake = anyio.Event()
        self.endpoint.tick(anyio.current_time())

    async def receive(self) -> list[tuple[Peer, bytes]]:
        """See `Link.receive`."""
        while True:
            await anyio.lowlevel.checkpoint()
            if self._wake is None:
                raise self._not_open()
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
        if self._wake is None:
            raise self._not_open()
        if peer in (None, SIM_PEER):
            self.endpoint.receive(data, anyio.current_time())
            self._wake.set()

    async def close(self) -> None:
        """See `Link.close`."""
        if self._wake is not None:
            self._wake.set()
            self._wake = None

    def _not_open(self) -> LinkError:
        return LinkError(f"{self.name}: not open", link=self.name)


async def serve_endpoint(
    endpoint: Endpoint,
    link: Link,
    *,
    task_status: anyio.abc.TaskStatus[Link] = anyio.TASK_STATUS_IGNORED,
) -> None:
    """Run a simulated vehicle on a link until cancelled; the link is opened, and closed at the end.

    What the vehicle sends goes to every peer: on `udpout` from the start, on `udpin` and `tcpin` once
    somebody has spoken or connected. With `await task_group.start(serve_endpoint, vehicle, link)` the link
    is open on return, and its address known.

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
            with anyio.move_on_after(None if wait is None else max(wait, SHORTEST_WAIT)):
                for _, data in await link.receive():
                    endpoint.receive(data, anyio.current_time())
    finally:
        await link.close()


def simulated(spec: LinkSpec) -> SimLink:
    """The vehicle that a `sim:` name describes, behind the faulty link that its options ask for."""
    from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle  # only here: other links need no tables

    faults: dict[str, Any] = dict(spec.options)
    make = PX4Vehicle if spec.host == "px4" else ArduPilotVehicle
    vehicle = make(system=faults.pop("system", 1), param_error=bool(faults.pop("param_error", 0)))
    return SimLink(Air.symmetric([vehicle], **faults) if faults else vehicle, spec.name)


def _work(endpoint: Endpoint) -> float | None:
    """Let the endpoint do what is due; seconds until it wants to go on, None while it waits for bytes."""
    now = anyio.current_time()
    endpoint.tick(now)
    deadline = endpoint.next_deadline()
    return None if deadline is None else max(0.0, deadline - now)
