"""Nicknames of the vehicles in a cache, in a small file beside it."""

from __future__ import annotations

import json
import os
import re
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final

from paramclient.cache.lock import locked
from paramclient.errors import CacheError, UsageError

__all__ = ["Nicknames", "check_nickname"]

NICKNAMES_SIZE_MAX: Final = 1_000_000
"""Bytes of a file that is read; a nickname with its key takes about 60."""

_FORM: Final = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,31}")
_HARDWARE_ID: Final = re.compile(r"[0-9A-Fa-f]{4,}")
_RESERVED: Final = frozenset({"px4", "ardupilot", "all", "defaults", "cache", "uid", "system"})
"""Words that mean something else where a vehicle is named."""


class Nicknames:
    """Nicknames by vehicle: each vehicle has at most one, and each nickname names one vehicle.

    A file of JSON, replaced atomically and readable only by its owner. Several processes may use it. Upper
    and lower case do not matter in a nickname.

    Args:
        path: the file; created with the first nickname.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def beside(cls, cache: Path) -> Nicknames:
        """Return the nicknames of a cache: the file with its name and the suffix `.nicknames`."""
        return cls(cache.with_suffix(".nicknames"))

    def load(self) -> Mapping[str, str]:
        """Return the keys of vehicles by nickname.

        Raises:
            CacheError: the file cannot be read, or is damaged.
        """
        try:
            with self.path.open("rb") as file:
                content = json.loads(file.read(NICKNAMES_SIZE_MAX))
        except FileNotFoundError:
            return {}
        except (OSError, ValueError) as error:
            raise CacheError(f"cannot read the nicknames in {self.path}: {error}") from error
        if not isinstance(content, dict) or not all(isinstance(key, str) for key in content.values()):
            raise CacheError(f"the nicknames in {self.path} are damaged; delete the file to begin again")
        names: dict[str, str] = content
        return names

    def set(self, key: str, nickname: str) -> None:
        """Give a vehicle a nickname, in place of its previous one.

        Raises:
            UsageError: the nickname is not valid, or is that of another vehicle.
            CacheError: the file cannot be read or written.
        """
        check_nickname(nickname)

        def change(names: dict[str, str]) -> None:
            owner = next((each for name, each in names.items() if name.lower() == nickname.lower()), key)
            if owner != key:
                raise UsageError(f"{nickname} is the nickname of {owner}; remove it there first")
            _drop(names, key)
            names[nickname] = key

        self._change(change)

    def remove(self, key: str) -> None:
        """Remove the nickname of a vehicle, if it has one.

        Raises:
            CacheError: the file cannot be read or written.
        """
        self._change(lambda names: _drop(names, key))

    def _change(self, change: Callable[[dict[str, str]], None]) -> None:
        try:
            self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            with locked(self.path.parent):
                names = dict(self.load())
                change(names)
                self._write(json.dumps(names, indent=1, sort_keys=True))
        except OSError as error:
            raise CacheError(f"cannot write the nicknames in {self.path}: {error}") from error

    def _write(self, text: str) -> None:
        descriptor, name = tempfile.mkstemp(dir=self.path.parent, prefix=f"{self.path.name}.")
        try:
            with os.fdopen(descriptor, "w", encoding="utf-8") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            Path(name).replace(self.path)
        except BaseException:
            with suppress(OSError):
                Path(name).unlink()
            raise


def check_nickname(text: str) -> str:
    """Check and return a nickname: it must not be mistaken for an id, a kind or a key.

    Raises:
        UsageError: it is not valid.
    """
    if _FORM.fullmatch(text) is None:
        raise UsageError(
            f"nickname {text!r}: a nickname has 1 to 32 letters, digits, _ and -, and begins with a letter"
        )
    if _HARDWARE_ID.fullmatch(text):
        raise UsageError(f"nickname {text!r} could be a hardware id: add a letter beyond f")
    if text.lower() in _RESERVED:
        raise UsageError(f"nickname {text!r} means something else already")
    return text


def _drop(names: dict[str, str], key: str) -> None:
    for name in [name for name, owner in names.items() if owner == key]:
        del names[name]
