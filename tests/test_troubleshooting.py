"""The page `troubleshooting.md` has the messages of the program, word by word, and all of them."""

from __future__ import annotations

import errno
import os
import pwd
import re
import socket
import stat
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from paramclient.client.signing import refused_in_words
from paramclient.errors import NoReply, UsageError
from paramclient.links import SerialPort, refusals
from paramclient.links.port_users import THIS_PROGRAM
from paramclient.protocol import wire
from paramclient.protocol.no_reply_hint import hint_of_component, hint_of_link
from paramclient.protocol.params.fetch_result import Policy
from paramclient.protocol.params.sync import SyncSettings
from paramclient.protocol.station import Station
from paramclient.protocol.wire import (
    MAV_AUTOPILOT_INVALID,
    MAV_AUTOPILOT_PX4,
    MAV_TYPE_GCS,
    Heartbeat,
    Message,
    Refusal,
    SigningPolicy,
    SigningReport,
    StatusText,
)

DOCS = Path(__file__).parent.parent / "docs"
FIRST_COLUMN = re.compile(r"^\| `([^`]+)` \|", re.MULTILINE)
LINK = "udpin:0.0.0.0:14550"
PX4 = Heartbeat(2, MAV_AUTOPILOT_PX4)
GCS = Heartbeat(MAV_TYPE_GCS, MAV_AUTOPILOT_INVALID)
TEXT = StatusText(6, "hello")


def messages_of(page: str, heading: str = "") -> list[str]:
    """Return the messages in the first columns of the tables of a page, or of one of its sections."""
    text = (DOCS / page).read_text(encoding="utf-8")
    if heading:
        text = text.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    return FIRST_COLUMN.findall(text)


def pattern_of(message: str) -> re.Pattern[str]:
    """Return what matches a message: `…` stands for any words, and numbers may differ."""
    words = re.escape(message).replace("…", ".*")
    return re.compile(re.sub(r"\d[\d,.]*\d|\d", r"\\d[\\d,.]*", words), re.DOTALL)


def station_on(link: str = LINK) -> Station:
    station = Station(link=link, is_stream=False)
    station.listening_since = 0.0
    return station


def hear(station: Station, message: Message, system: int, component: int = 1, now: float = 1.0) -> None:
    frame = wire.encode(message, system=system, component=component, sequence=0, version=2)
    station.receive(frame, "peer", now)


def silences() -> list[str]:
    """Return every sentence about a silent link or component."""
    links = [LINK, "udpout:192.168.1.20:14550", "tcp:127.0.0.1:5760", "tcpin:0.0.0.0:5760"]
    links.append("serial:/dev/ttyUSB0:57600")
    found = [hint_of_link(station_on(link), link) for link in links]
    for link in (links[0], links[-1]):
        noisy = station_on(link)
        noisy.receive(bytes(1500), "peer", 1.0)
        found.append(hint_of_link(noisy, link))
    received: list[list[tuple[Message, int, int]]] = [
        [(GCS, 252, 190)],
        [(GCS, 255, 190)],
        [(PX4, 3, 1), (GCS, 252, 190)],
        [(TEXT, 7, 1)],
    ]
    for frames in received:
        station = station_on()
        for message, system, component in frames:
            hear(station, message, system, component)
        found.append(hint_of_link(station, LINK))
    settings = SyncSettings.chosen(None, Policy.AUTO, listen_only=True, is_log=False)
    listening = Station(link=LINK, is_stream=False, sync_settings=settings)
    hear(listening, TEXT, 7)
    found.append(hint_of_link(listening, LINK))
    interrupted = station_on(links[2])
    interrupted.pause()
    return [*found, hint_of_link(interrupted, links[2]), *silences_of_components()]


def silences_of_components() -> list[str]:
    station = station_on()
    for second in range(6):
        hear(station, PX4, 3, now=float(second))
    machine = station.components[3, 1]
    found = [hint_of_component(station, machine, 1.0, 5.5)]
    machine.round_trip.smoothed = 0.1
    found.append(hint_of_component(station, machine, 1.0, 5.5))
    found.append(hint_of_component(station, machine, 7.0, 12.0))
    hear(station, GCS, 252, 190, now=11.5)
    found.append(hint_of_component(station, machine, 7.0, 12.0))
    without_heartbeats = station_on()
    hear(without_heartbeats, wire.ParamValue("A", bytes(4), 9, 1, 0), 3, now=2.0)
    machine = without_heartbeats.components[3, 1]
    return [*found, hint_of_component(without_heartbeats, machine, 1.0, 3.0)]


def refusals_of_sockets(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return every sentence about a socket that cannot be opened."""
    found = []
    for user, is_tcp in (("QGroundControl (process 1234)", False), (None, True), (THIS_PROGRAM, False)):
        monkeypatch.setattr(refusals, "user_of_port", lambda port, is_tcp, user=user: user)
        found.append(refusals.port_in_use(14550, is_tcp=is_tcp))
    errors = [
        (OSError(errno.EADDRNOTAVAIL, "no"), "10.9.9.9", 14550),
        (ConnectionRefusedError(errno.ECONNREFUSED, "no"), "127.0.0.1", 5760),
        (TimeoutError(), "10.0.0.5", 5760),
        (OSError(errno.EHOSTUNREACH, "No route to host"), "10.0.0.5", 5760),
        (PermissionError(errno.EACCES, "no"), "0.0.0.0", 80),
        (OSError(errno.EMFILE, "Too many open files"), "0.0.0.0", 14550),
    ]
    found += [refusals.socket_refusal(error, host, port, f"{host}:{port}") for error, host, port in errors]
    for code in (socket.EAI_NONAME, socket.EAI_AGAIN):
        found.append(refusals.host_refusal("drone.local", socket.gaierror(code, "not known")))
    return found


def refusals_of_devices(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return every sentence about a serial port that cannot be opened, except those about permissions."""
    port = "/dev/ttyACM0"

    def refused(code: int, device: str = port) -> str:
        return refusals.device_refusal(device, 57600, OSError(code, "Input/output error"))

    def fail() -> Any:
        raise UsageError("serialx is missing")

    pixhawk = SerialPort("/dev/ttyACM0", product="PX4 FMU v6X")
    found = []
    ports: list[Callable[[], Any]] = [lambda: [pixhawk, SerialPort("/dev/ttyS0")], list, fail]
    for listed in ports:
        monkeypatch.setattr(refusals, "list_ports", listed)
        found.append(refused(errno.ENOENT))
    monkeypatch.setattr(refusals, "list_ports", ports[0])
    found.append(refused(errno.ENOTTY, "/dev/null"))
    for user in ("ModemManager (process 5)", "QGroundControl (process 1234)", None, THIS_PROGRAM):
        monkeypatch.setattr(refusals, "user_of_device", lambda _, user=user: user)
        found.append(refused(errno.EBUSY))
    return [*found, refused(errno.EINVAL, "/dev/ttyS0"), refused(errno.EIO)]


def refused_permissions(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return every sentence about a serial port that the user may not open."""
    import grp

    found = []
    user = pwd.getpwuid(os.getuid()).pw_name
    for mode, members in ((0o660, []), (0o660, [user]), (0o600, [])):
        status = SimpleNamespace(st_gid=20, st_mode=stat.S_IFCHR | mode)
        group = SimpleNamespace(gr_name="dialout", gr_mem=members)
        with monkeypatch.context() as patched:
            patched.setattr(Path, "stat", lambda _, status=status: status)
            patched.setattr(grp, "getgrgid", lambda _, group=group: group)
            patched.setattr(os, "getgroups", list)
            error = PermissionError(errno.EACCES, "no")
            found.append(refusals.device_refusal("/dev/ttyACM0", 57600, error))
    return found


@pytest.fixture
def produced(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Every sentence of the program on a link that fails or is silent."""
    refused = {Refusal.UNSIGNED: 12}
    report = SigningReport("key", 0, SigningPolicy.SIGNED_ONLY, 0, 0, 0, {}, refused, ())
    unsigned = NoReply(f"an autopilot{refused_in_words(report)}", attempts=0, waited=10.0)
    return [
        *silences(),
        *refusals_of_sockets(monkeypatch),
        *refusals_of_devices(monkeypatch),
        *refused_permissions(monkeypatch),
        str(unsigned),
    ]


def test_each_message_of_the_page_is_one_of_the_program(produced: list[str]) -> None:
    shown = messages_of("troubleshooting.md")
    assert len(shown) > 30
    for message in shown:
        assert any(pattern_of(message).fullmatch(each) for each in produced), message


def test_each_message_of_the_program_is_on_the_page(produced: list[str]) -> None:
    text = (DOCS / "troubleshooting.md").read_text(encoding="utf-8")
    shown = [*messages_of("troubleshooting.md"), *re.findall(r"`(cannot open[^`]*)`", text)]
    for message in produced:
        assert any(pattern_of(each).fullmatch(message) for each in shown), message


def test_each_hint_of_the_page_on_errors_is_one_of_the_program(produced: list[str]) -> None:
    shown = messages_of("errors.md", "No reply")
    assert len(shown) == 10
    for message in shown:
        assert any(pattern_of(message).fullmatch(each) for each in produced), message
