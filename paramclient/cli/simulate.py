"""The subcommand sim: runs a simulated vehicle for other programs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from anyio.abc import TaskStatus

from paramclient.cli.output import print_line
from paramclient.client.signing import read_key, timestamp_now
from paramclient.errors import UsageError
from paramclient.links import Link, LinkKind, LinkSpec, create_link, parse_link, serve_endpoint
from paramclient.links.sim import simulated
from paramclient.links.sockets import TcpIn, UdpIn


async def sim(
    vehicle: str, /, *, link: str = "udpout:127.0.0.1:14550", signing_key: Path | None = None
) -> None:
    """Run a simulated vehicle for other programs, until Ctrl-C.

    Args:
        vehicle: px4, ardupilot or camera, with the options of a simulated link, such as
            "px4?system=2&loss=0.05&seed=1".
        link: The link to send to or to listen on. With port 0, the system chooses the port, which is printed.
        signing_key: A file with the signing key: the vehicle signs its frames and requires signed ones.
    """
    kind, spec = parse_link(f"sim:{vehicle.removeprefix('sim:')}"), parse_link(link)
    if spec.kind is LinkKind.SIM:
        raise UsageError(
            f"{spec.name} is itself a simulated vehicle; sim needs a link to other programs, such as "
            "udpout:127.0.0.1:14550"
        )
    real = create_link(spec)
    options: dict[str, Any] = {"stream": real.is_stream}
    if signing_key is not None:
        options |= {"signing_key": read_key(signing_key), "signing_timestamp": timestamp_now()}
    await serve_endpoint(simulated(kind, **options).endpoint, real, task_status=_Announcement(vehicle, spec))


class _Announcement(TaskStatus[Link]):
    """Prints the link of the vehicle as soon as it is open."""

    def __init__(self, vehicle: str, spec: LinkSpec) -> None:
        self._vehicle, self._spec = vehicle, spec

    def started(self, value: Link | None = None) -> None:
        """Print the link, with the port that the system chose."""
        where = f"speaks to {self._spec}"
        if isinstance(value, UdpIn | TcpIn) and value.address is not None:
            where = f"listens on {replace(self._spec, port=value.address[1])}"
        print_line(f"{self._vehicle} {where}; Ctrl-C ends it")
