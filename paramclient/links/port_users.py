"""The programs that use a network port or a device, as far as the operating system reports them: /proc on
Linux."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

__all__ = ["THIS_PROGRAM", "user_of_device", "user_of_port"]

PROC: Final = Path("/proc")
"""The process file system of Linux; on other systems nothing is found there."""
THIS_PROGRAM: Final = "this program itself"
"""The user of a port that this process has open."""
LISTENING: Final = "0A"
"""The state of a listening TCP socket in /proc/net/tcp (TCP_LISTEN of the kernel's tcp_states.h)."""


def user_of_port(port: int, *, is_tcp: bool, proc: Path = PROC) -> str | None:
    """Return the program that has bound a port, in words: `QGroundControl (process 1234)`.

    Reads /proc/net and the open files of all processes, which takes some milliseconds. The files of other
    users' processes cannot be read: then the words are `a program of the user root`.

    Args:
        port: the local port.
        is_tcp: whether it is a listening TCP port; otherwise it is a UDP port.
        proc: the process file system.

    Returns:
        None if the operating system does not report it.
    """
    users: dict[str, int] = {}
    for name in ("tcp", "tcp6") if is_tcp else ("udp", "udp6"):
        for fields in _rows(proc / "net" / name):
            is_bound = fields[3] == LISTENING or not is_tcp
            if is_bound and int(fields[1].rpartition(":")[2], 16) == port:
                users[f"socket:[{fields[9]}]"] = int(fields[7])
    if not users:
        return None
    return _process_with(users, proc) or _someone(next(iter(users.values())))


def user_of_device(path: str, *, proc: Path = PROC) -> str | None:
    """Return the program that has opened a device, in words; None if the operating system does not report
    it."""
    return _process_with([os.path.realpath(path)], proc)


def _rows(path: Path) -> Iterator[list[str]]:
    """Yield the fields of each socket in a table of /proc/net."""
    with suppress(OSError):
        for line in path.read_text(encoding="ascii", errors="replace").splitlines()[1:]:
            fields = line.split()
            if len(fields) > 9:
                yield fields


def _process_with(files: Iterable[str], proc: Path) -> str | None:
    """Return the first process that has one of these files open, in words; None if none is readable."""
    wanted = frozenset(files)
    with suppress(OSError):
        for each in sorted(proc.iterdir()):
            if each.name.isdecimal() and not wanted.isdisjoint(_open_files(each)):
                if int(each.name) == os.getpid():
                    return THIS_PROGRAM
                return f"{_name(each)} (process {each.name})"
    return None


def _open_files(process: Path) -> Iterator[str]:
    with suppress(OSError):  # of another user, or ended meanwhile
        for each in (process / "fd").iterdir():
            with suppress(OSError):
                yield str(each.readlink())


def _name(process: Path) -> str:
    """Return the name of a program; of a script, its file."""
    with suppress(OSError):
        words = (process / "cmdline").read_bytes().decode(errors="replace").split("\0")
        names = [Path(word).name for word in words[:2]]
        if len(names) == 2 and names[1] and _INTERPRETER.fullmatch(names[0]) and words[1][0] != "-":
            return names[1]
        if names[0]:
            return names[0]
    with suppress(OSError):
        return (process / "comm").read_text(errors="replace").strip()
    return "a program"


def _someone(uid: int) -> str:
    """Return a program of a user in words."""
    if sys.platform != "win32":
        import pwd  # imported here: POSIX only

        with suppress(KeyError):
            return f"a program of the user {pwd.getpwuid(uid).pw_name}"
    return f"a program of the user {uid}"


_INTERPRETER: Final = re.compile(r"python[0-9.]*|node|java|ruby|perl")
