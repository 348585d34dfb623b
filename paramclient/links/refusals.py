"""Reasons why a link cannot be opened, as sentences with the cause and the remedy."""

from __future__ import annotations

import errno
import os
import socket
import stat
import sys
from contextlib import suppress
from pathlib import Path
from typing import Final

from paramclient.errors import UsageError
from paramclient.links.port_users import THIS_PROGRAM, user_of_device, user_of_port
from paramclient.links.ports import list_ports

__all__ = ["device_refusal", "host_refusal", "is_port_in_use", "port_in_use", "reason", "socket_refusal"]

PORTS_LISTED_MAX: Final = 8
"""Serial ports that a message lists; it gives the number of further ones."""
PRIVILEGED_PORTS: Final = 1024
"""Ports below this number need privileges on POSIX systems."""

_NO_ROUTE: Final = {errno.ENETUNREACH, errno.EHOSTUNREACH, errno.ENETDOWN}


def reason(error: OSError) -> str:
    """Return the operating system's text for an error, without its number."""
    return error.strerror or str(error)


# Sockets


def is_port_in_use(error: OSError) -> bool:
    """Return whether a socket cannot be bound because another one has the port."""
    return error.errno == errno.EADDRINUSE or (sys.platform == "win32" and error.errno == errno.EACCES)


def port_in_use(port: int, *, is_tcp: bool) -> str:
    """Return that a port is in use, and by which program. Reads the open files of all processes."""
    user = user_of_port(port, is_tcp=is_tcp) or "another program"
    if user == THIS_PROGRAM:
        return f"port {port} is in use by {user}, on another link"
    if is_tcp:
        return f"port {port} is in use by {user}. Close that program, or choose another port"
    return (
        f"port {port} is in use by {user}. Close that program, or choose another port and let it, the "
        "vehicle or a MAVLink router send there too. If it is the vehicle or its simulator, use "
        f"udpout:127.0.0.1:{port}"
    )


def socket_refusal(error: OSError, host: str, port: int, target: str) -> str:
    """Return why a socket cannot be opened.

    Args:
        error: the operating system's error; not of a port in use.
        host, port: of the link.
        target: both in words.
    """
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
    if error.errno == socket.EAI_AGAIN:
        return (
            f"host {host} not found: no name server answers ({reason(error)}). Is this computer online? An "
            "IP address needs no name server"
        )
    return f"host {host} not found: {reason(error)}. Check the spelling, or use the IP address"


# Serial ports


def device_refusal(device: str, baud: int, error: OSError) -> str:
    """Return why a serial port cannot be opened. May read the open files of all processes."""
    if error.errno in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
        return f"{device} does not exist. {_ports_in_words()}"
    if error.errno == errno.EBUSY or (sys.platform == "win32" and error.errno == errno.EACCES):
        return _device_in_use(device)
    if error.errno in (errno.EACCES, errno.EPERM):
        return f"no permission to open {device}{_group_hint(device)}"
    if error.errno in (errno.ENOTTY, errno.EISDIR):
        return f"{device} is not a serial port. {_ports_in_words()}"
    if error.errno == errno.EINVAL:
        return f"{device} cannot be set to {baud} baud"
    return f"cannot open {device}: {reason(error)}"


def _ports_in_words() -> str:
    """Return the serial ports of this computer as a sentence."""
    try:
        ports = list_ports()
    except (OSError, UsageError):
        return "'paramclient ports' lists the serial ports"
    if not ports:
        return "This computer has no serial ports: is the device plugged in and switched on?"
    words = []
    for each in ports[:PORTS_LISTED_MAX]:
        kind = each.autopilot or each.product
        words.append(f"{each.device} ({kind})" if kind else each.device)
    more = len(ports) - len(words)
    return f"The serial ports are {', '.join(words)}{f' and {more} more' if more > 0 else ''}"


def _device_in_use(device: str) -> str:
    user = user_of_device(device)
    if user is None:
        return f"{device} is in use by another program. Close that program"
    if user == THIS_PROGRAM:
        return f"{device} is in use by {user}, on another link"
    if user.startswith("ModemManager "):
        return (
            f"{device} is in use by {user}, which looks for modems on new ports. Wait 30 s, or stop it: sudo "
            "systemctl stop ModemManager"
        )
    return f"{device} is in use by {user}. Close that program, or let it forward MAVLink"


def _group_hint(device: str) -> str:
    """Return a hint on joining the port's group, if the user is not in it; else ""."""
    if sys.platform != "win32":
        import grp  # imported here: POSIX only
        import pwd

        with suppress(OSError, KeyError):
            info = Path(device).stat()
            group = grp.getgrgid(info.st_gid)
            if info.st_mode & stat.S_IWGRP and info.st_gid not in (0, *os.getgroups()):
                needs = f", which needs the group {group.gr_name}"
                with suppress(KeyError):
                    if pwd.getpwuid(os.getuid()).pw_name in group.gr_mem:
                        return f"{needs}. The user is in it since the last login: log out and in again"
                return f"{needs}: {_join(group.gr_name)}, then log in again"
            if not info.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
                return ": only its owner may open it. A udev rule can give it to a group"
    return ""


def _join(group: str) -> str:
    """Return the command that adds the user to a group."""
    command = next(
        (each for system, each in _JOIN.items() if sys.platform.startswith(system)), _JOIN["linux"]
    )
    return command.format(group=group)


_JOIN: Final = {
    "linux": "sudo usermod -aG {group} $USER",
    "darwin": "sudo dseditgroup -o edit -a $USER -t user {group}",
    "freebsd": "sudo pw groupmod {group} -m $USER",
}
"""Commands that add the user to a group, by the beginning of `sys.platform`."""
