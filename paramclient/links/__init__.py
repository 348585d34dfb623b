"""Links: UDP, TCP, serial ports, simulated vehicles in this process, and telemetry logs.

Link names follow pymavlink, MAVProxy and MAVSDK. `parse_link` parses a name, `create_link` makes the link.
All links implement `Link`; a program can provide its own implementation.

- `link`, `names`: the interface of links, and their names.
- `sockets`, `serial`, `sim`: links over UDP and TCP, over serial ports with their list, in this process.
- `tlog`: telemetry logs, also as links.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from paramclient.errors import UsageError
from paramclient.links.link import Link, Peer
from paramclient.links.names import FORMS, LinkKind, LinkSpec, parse_link
from paramclient.links.serial import SerialLink, SerialPort, list_ports
from paramclient.links.sim import SimLink, serve_endpoint, simulated
from paramclient.links.sockets import TcpIn, TcpOut, UdpIn, UdpOut
from paramclient.links.tlog import ReplayLink

if TYPE_CHECKING:
    from paramclient.sim import Endpoint

__all__ = [
    "FORMS",
    "Link",
    "LinkKind",
    "LinkSpec",
    "Peer",
    "ReplayLink",
    "SerialPort",
    "SimLink",
    "create_link",
    "list_ports",
    "parse_link",
    "serve_endpoint",
]


def create_link(link: str | LinkSpec | Link | Endpoint) -> Link:
    """Make a link, not yet opened.

    Args:
        link: a name, a parsed name, an endpoint of `paramclient.sim` (see `SimLink`), or a link, which is
            returned unchanged.

    Raises:
        UsageError: the argument is none of these; or it is a serial link, and the extra `serial` is not
            installed.
    """
    if isinstance(link, str):
        link = parse_link(link)
    if isinstance(link, LinkSpec):
        return _MAKERS[link.kind](link)
    if isinstance(link, Link):
        return link
    if hasattr(link, "data_to_send"):
        return SimLink(link)
    raise UsageError(f"a link is given as a name, not as {type(link).__name__}; accepted forms:\n{FORMS}")


_MAKERS: dict[LinkKind, Callable[[LinkSpec], Link]] = {
    LinkKind.UDPIN: UdpIn,
    LinkKind.UDPOUT: UdpOut,
    LinkKind.TCP: TcpOut,
    LinkKind.TCPIN: TcpIn,
    LinkKind.SERIAL: SerialLink,
    LinkKind.SIM: simulated,
    LinkKind.REPLAY: ReplayLink,
}
