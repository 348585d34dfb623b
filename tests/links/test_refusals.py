"""Why a link cannot be opened, and what to do about each cause."""

from __future__ import annotations

import errno
import os
import socket

import pytest

from paramclient.links.refusals import device_refusal, host_refusal, socket_refusal


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (TimeoutError(), "no response from a:5"),
        (ConnectionRefusedError(), "nothing listens there"),
        (OSError(errno.EADDRINUSE, "used"), "port 5 is in use"),
        (OSError(errno.EADDRNOTAVAIL, "no"), "a is not an address of this computer"),
        (OSError(errno.ENETUNREACH, "no"), "no route to a:5: no"),
        (PermissionError(errno.EACCES, "no"), "ports below 1024 need privileges"),
        (OSError(errno.EMFILE, os.strerror(errno.EMFILE)), "cannot open: Too many open files"),
    ],
)
def test_causes_of_sockets(error: OSError, text: str) -> None:
    assert text in socket_refusal(error, "a", 5, "a:5", is_stream=False)


@pytest.mark.parametrize(
    ("number", "text"),
    [
        (errno.ENOENT, "/dev/x does not exist. 'paramclient ports' lists"),
        (errno.EBUSY, "/dev/x is in use"),
        (errno.EACCES, "no permission to open /dev/x"),
        (errno.ENOTTY, "/dev/x is not a serial port"),
        (errno.EINVAL, "/dev/x cannot be set to 57600 baud"),
        (errno.EIO, "cannot open /dev/x: text"),
    ],
)
def test_causes_of_serial_ports(number: int, text: str) -> None:
    assert text in device_refusal("/dev/x", 57600, OSError(number, "text"))


def test_a_host_without_an_address() -> None:
    unknown = host_refusal("drnoe.local", socket.gaierror(socket.EAI_NONAME, "Name or service not known"))
    assert unknown.startswith("host drnoe.local not found: Name or service not known. Check the spelling")
