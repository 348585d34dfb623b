"""Link names: parsing the spellings of pymavlink, MAVProxy and MAVSDK into one canonical form.

Where the three programs disagree, a name has the meaning that most of them share: `udp:` listens, as in
pymavlink and MAVSDK; `HOST:PORT` alone listens too, as in MAVProxy.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from enum import StrEnum
from ipaddress import AddressValueError, IPv4Address, IPv6Address
from typing import Final
from urllib.parse import parse_qsl

from paramclient.errors import UsageError

FORMS: Final = """\
  udpin:HOST:PORT     listen for vehicles; also udp:HOST:PORT, udpin:PORT, HOST:PORT
  udpout:HOST:PORT    send to one address
  tcp:HOST:PORT       connect; also tcpout:HOST:PORT
  tcpin:HOST:PORT     accept connections of vehicles; also tcpin:PORT
  serial:DEVICE:BAUD  a serial port; also /dev/ttyACM0,57600 and COM5:115200
  sim:px4             a simulated vehicle in this process; also sim:ardupilot, sim:px4?loss=0.05&seed=1
  sim:camera          a simulated camera with extended parameters, component 100
  replay:FILE         a telemetry log (.tlog); also replay:FILE?speed=10, and speed=0 for full speed
  udpin://HOST:PORT   // may follow the first colon of each; write an IPv6 address in brackets"""
"""The accepted forms of a link name, for messages."""

SIMULATED: Final = ("px4", "ardupilot", "camera")
"""What a `sim:` link simulates."""
VEHICLE_OPTIONS: Final = ("system", "param_error", "metadata")
"""Options of a `sim:` link that are arguments of the vehicle."""
SIM_OPTIONS: Final = (
    *("loss", "loss_burst", "delay", "jitter", "duplicate", "reorder", "bit_errors", "rate", "queue", "seed"),
    *VEHICLE_OPTIONS,
)
"""The options of `sim:` links. `paramclient.sim.FaultyLink` has the ranges of those for the link."""

DEFAULT_BAUD: Final = 57600
"""Baud rate of a serial device without one: that of telemetry radios, and MAVSDK's and MAVProxy's default. A
device that is itself USB ignores it."""

BAUD_MIN: Final = 300
"""Smallest baud rate in a name. Lower numbers are ArduPilot's abbreviations, such as 57 for 57600."""
BAUD_MAX: Final = 20_000_000
"""Largest baud rate in a name: more than full-speed USB carries."""


class LinkKind(StrEnum):
    """The transport of a link."""

    UDPIN = "udpin"
    UDPOUT = "udpout"
    TCP = "tcp"
    TCPIN = "tcpin"
    SERIAL = "serial"
    SIM = "sim"
    REPLAY = "replay"


@dataclass(frozen=True, slots=True)
class LinkSpec:
    """A parsed link name.

    Attributes:
        kind: the transport.
        host: a host name or an address without brackets; the device of a serial link; the autopilot of a
            simulated link; the file of a log.
        port: 1 to 65535; 0 if a listening link lets the operating system choose; the baud rate of a serial
            link.
        options: options of a simulated link or a log, sorted by name.
    """

    kind: LinkKind
    host: str
    port: int = 0
    options: tuple[tuple[str, int | float], ...] = ()

    @property
    def name(self) -> str:
        """The canonical spelling; `parse_link` returns an equal object for it."""
        if self.kind in (LinkKind.SIM, LinkKind.REPLAY):
            query = "&".join(f"{key}={value}" for key, value in self.options)
            return f"{self.kind}:{self.host}?{query}" if query else f"{self.kind}:{self.host}"
        host = f"[{self.host}]" if ":" in self.host and self.kind is not LinkKind.SERIAL else self.host
        return f"{self.kind}:{host}:{self.port}"

    def __str__(self) -> str:
        return self.name


def parse_link(text: str) -> LinkSpec:
    """Parse a link name.

    Raises:
        UsageError: the name has none of the accepted forms; the error lists them.
    """
    name = text.strip()
    try:
        return _parse(name)
    except UsageError as problem:
        shown = name if len(name) <= 80 else name[:80] + "…"
        raise UsageError(f"link name {shown!r}: {problem}\naccepted forms:\n{FORMS}") from None


_SCHEMES = {kind.value: kind for kind in LinkKind} | {"udp": LinkKind.UDPIN, "tcpout": LinkKind.TCP}
_LISTENING = frozenset({LinkKind.UDPIN, LinkKind.TCPIN})

_SERVICE = re.compile(r"https?://", re.IGNORECASE)
_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*):(.*)")
_HOST_PORT = re.compile(r"(?:(?:\[([^\[\]]+)\]|([^:\[\]]*)):)?([0-9]{1,5})")
_LABEL = "[A-Za-z0-9_](?:[A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?"
_HOST = re.compile(rf"(?=.{{1,253}}$)(?![0-9.]+$){_LABEL}(?:\.{_LABEL})*\.?")
_DEVICE = re.compile(r"(/[!-~]+?|COM[0-9]{1,3})(?:[:,]([0-9]{1,8}))?", re.IGNORECASE)
_BARE_DEVICE = re.compile(r"/dev/|COM[0-9]", re.IGNORECASE)


def _parse(name: str) -> LinkSpec:
    if _BARE_DEVICE.match(name):
        return _serial(name)
    if _SERVICE.match(name):
        raise UsageError(
            "this is an HTTP address, not a link. Connect to the vehicle's own link, or use the HTTP API of"
            " the service with an HTTP client"
        )
    scheme = _SCHEME.fullmatch(name)
    kind = _SCHEMES.get(scheme[1].lower()) if scheme else None
    if scheme is None or kind is None:
        if "/" in name or ":" not in name or not _HOST_PORT.fullmatch(name):
            missing = "the kind of link is missing; a file, or a vehicle in the cache, is no link"
            raise UsageError(f"{scheme[1]!r} is not a kind of link" if scheme else missing)
        return _network(LinkKind.UDPIN, name)
    rest = scheme[2].removeprefix("//")
    return _PARSERS[kind](rest) if kind in _PARSERS else _network(kind, rest)


def _network(kind: LinkKind, rest: str) -> LinkSpec:
    is_listening = kind in _LISTENING
    parts = _HOST_PORT.fullmatch(rest)
    bracketed, host, port = parts.groups() if parts else (None, None, "-1")
    host = host or ("0.0.0.0" if is_listening else "")
    if not (0 if is_listening else 1) <= int(port) <= 65535 or not (bracketed or host):
        raise UsageError("expected HOST:PORT, with an IPv6 address in brackets, and a port up to 65535")
    try:
        host = str(IPv6Address(bracketed) if bracketed else IPv4Address(host))
    except AddressValueError:
        if bracketed or not _HOST.fullmatch(host):
            raise UsageError(f"{bracketed or host!r} is not a host name or an address") from None
    return LinkSpec(kind, host.lower(), int(port))


def _serial(rest: str) -> LinkSpec:
    parts = _DEVICE.fullmatch(rest)
    if parts is None:
        raise UsageError("a serial link is a device and a baud rate")
    device, digits = parts.groups()
    baud = int(digits) if digits else DEFAULT_BAUD
    if not BAUD_MIN <= baud <= BAUD_MAX:
        raise UsageError(f"a baud rate is from {BAUD_MIN} to {BAUD_MAX}, such as 57600, not {baud}")
    return LinkSpec(LinkKind.SERIAL, device if device.startswith("/") else device.upper(), baud)


def _sim(rest: str) -> LinkSpec:
    autopilot, _, query = rest.partition("?")
    if autopilot.lower() not in SIMULATED:
        raise UsageError("simulated vehicles are px4, ardupilot and camera")
    options: dict[str, int | float] = {}
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=True, max_num_fields=32)
    except ValueError:
        raise UsageError("options are written as NAME=VALUE with & between them") from None
    for key, value in pairs:
        if key not in SIM_OPTIONS:
            raise UsageError(
                f"{key!r} is not an option of a simulated link; the options are {', '.join(SIM_OPTIONS)}"
            )
        if key in options:
            raise UsageError(f"option {key} is given twice")
        options[key] = _number(key, value)
    return LinkSpec(LinkKind.SIM, autopilot.lower(), options=tuple(sorted(options.items())))


def _replay(rest: str) -> LinkSpec:
    path, mark, speed = rest.partition("?speed=")
    if not path:
        raise UsageError("the file is missing")
    number = 0.0 if speed == "inf" else _number("speed", speed) if mark else 1.0
    if number < 0:
        raise UsageError(f"option speed is 0 or more, not {number}")
    return LinkSpec(LinkKind.REPLAY, path, options=(("speed", number),) if mark else ())


def _number(key: str, text: str) -> int | float:
    """Return the number of an option."""
    try:
        value = int(text) if text.isascii() and text.isdigit() else float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise UsageError(f"option {key} must be a number, not {text!r}")
    return abs(value) if value == 0 else value  # −0.0 is 0.0


_PARSERS = {LinkKind.SERIAL: _serial, LinkKind.SIM: _sim, LinkKind.REPLAY: _replay}
"""The parsers of links that are not those of a network."""
