"""Reasons why a link cannot be opened, as sentences with the cause and the remedy."""

from __future__ import annotations

import errno
import socket
import sys
from typing import Final

PRIVILEGED_PORTS: Final = 1024
"""Ports below this number need privileges on POSIX systems."""
_NO_ROUTE: Final = {errno.ENETUNREACH, errno.EHOSTUNREACH, errno.ENETDOWN}


def reason(error: OSError) -> str:
    """Return the operating system's text for an error, without its number."""
    return error.strerror or str(error)


def socket_refusal(error: OSError, host: str, port: int, target: str, *, is_stream: bool) -> str:
    """Return why a socket cannot be opened.

    Args:
        error: the operating system's error.
        host, port: of the link.
        target: both in words.
        is_stream: whether the link uses TCP.
    """
    if error.errno == errno.EADDRINUSE or (sys.platform == "win32" and error.errno == errno.EACCES):
        close = f"port {port} is in use by another link or program. Close it, or choose another port"
        return close if is_stream else f"{close} and let the vehicle or a MAVLink router send there too"
    if isinstance(error, TimeoutError):
        return f"no response from {target}. Check the address, the network and firewalls"
    if isinstance(error, ConnectionRefusedError):
        return f"connection refused by {target}: nothing listens there. Is the vehicle or simulator running?"
    if error.errno == errno.EADDRNOTAVAIL:
        return f"{host} is not an address of this computer; 0.0.0.0 listens on all of them"
    if error.errno in _NO_ROUTE:
        return f"no route to {target}: {reason(error)}. Is this computer in the network of the vehicle?"
    if error.errno in (errno.EACCES, errno.EPERM) and 0 < port < PRIVILEGED_PORTS:
        return f"no permission to use port {port}: ports below {PRIVILEGED_PORTS} need privileges"
    return f"cannot open: {reason(error)}"


def host_refusal(host: str, error: socket.gaierror) -> str:
    """Return why the addresses of a host are not known."""
    return (
        f"host {host} not found: {reason(error)}. Check the spelling and the network, or use the IP address"
    )


def device_refusal(device: str, baud: int, error: OSError) -> str:
    """Return why a serial port cannot be opened."""
    ports = "'paramclient ports' lists the serial ports"
    if error.errno in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
        return f"{device} does not exist. {ports}"
    if error.errno == errno.EBUSY or (sys.platform == "win32" and error.errno == errno.EACCES):
        return f"{device} is in use by another link or program, such as a ground station or ModemManager"
    if error.errno in (errno.EACCES, errno.EPERM):
        return f"no permission to open {device}. Is the user in the group of the port (dialout or uucp)?"
    if error.errno in (errno.ENOTTY, errno.EISDIR):
        return f"{device} is not a serial port. {ports}"
    if error.errno == errno.EINVAL:
        return f"{device} cannot be set to {baud} baud"
    return f"cannot open {device}: {reason(error)}"
