"""Argument defaults and checks of the calls of a client."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final

from paramclient.errors import UsageError
from paramclient.model.ext_values import check_ext_value
from paramclient.model.values import Settable, WireValue, check_name, check_value, is_portable_name
from paramclient.wire.messages import HASH_CHECK, PARAMETERS_MAX

__all__ = [
    "COMPONENT_TIMEOUT",
    "SETTLE_MAX",
    "address_in_words",
    "check_requested_name",
    "check_portable_name",
    "check_settle",
    "check_writes",
]

COMPONENT_TIMEOUT: Final = 10.0
"""Default timeout in seconds for the first component on a link."""
AUTHOR_LENGTH_MAX: Final = 128
"""Characters of an author's name: enough for a name with an address, and a program's own description."""
SETTLE_MAX: Final = 60.0
"""Maximum `settle` in seconds: further writes to the same name wait for it."""


def check_requested_name(name: str | int) -> None:
    """Check that a parameter can have this name or index.

    Raises:
        UsageError: the name is not portable, or the index is out of range.
    """
    if isinstance(name, str):
        check_portable_name(name)
    elif not isinstance(name, int) or not 0 <= name < PARAMETERS_MAX:
        raise UsageError(f"parameter index {name}: indices are 0 to {PARAMETERS_MAX - 1}")


def check_portable_name(name: str) -> str:
    """Check and return a parameter name.

    Raises:
        UsageError: the name is not a valid param_id, or no parameter file can hold it. The client ignores
            such names when a vehicle sends them.
    """
    if not is_portable_name(check_name(name)):
        raise UsageError(
            f"parameter name {name!r}: no parameter file can hold it, so the client ignores it; a name has"
            " a letter, no space and none of # , ; = ; it begins with neither @ nor / and does not end with :"
        )
    return name


def check_author(author: str | None) -> str:
    """Check the author of a change, and return how the history names it.

    Raises:
        UsageError: it is empty, too long, or contains more than printable ASCII.
    """
    if author is None:
        return "us"
    if not 1 <= len(author) <= AUTHOR_LENGTH_MAX or not (author.isascii() and author.isprintable()):
        raise UsageError(
            f"author must have 1 to {AUTHOR_LENGTH_MAX} printable ASCII characters, not {author!r:.200}"
        )
    return f"us for {author}"


def check_writes(
    values: Mapping[str, Settable] | Iterable[tuple[str, Settable]], *, extended: bool = False
) -> list[tuple[str, WireValue]]:
    """Check names and values to write, and return them as pairs.

    Raises:
        UsageError: a name is not valid or is that of the hash, or a value is not valid.
    """
    pairs = values.items() if isinstance(values, Mapping) else values
    checked = []
    for name, value in pairs:
        if check_portable_name(name) == HASH_CHECK:
            raise UsageError(f"{HASH_CHECK} is read-only: it is the hash of the parameters, not a parameter")
        checked.append((name, check_ext_value(value) if extended else check_value(value)))
    return checked


def check_settle(settle: float) -> float:
    """Check and return `settle`, the seconds for which a value is watched after a write.

    Raises:
        UsageError: the number is outside 0 to `SETTLE_MAX`.
    """
    if not 0.0 <= settle <= SETTLE_MAX:
        raise UsageError(f"settle must be 0 to {SETTLE_MAX:g} seconds, not {settle}")
    return float(settle)


def address_in_words(system: int | None, component: int | None, peer: str | None = None) -> str:
    """Return the component that a call waits for, for messages."""
    at = "" if peer is None else f" at {peer}"
    if component is None:
        return f"an autopilot{at}" if system is None else f"an autopilot with system id {system}{at}"
    return f"component {'*' if system is None else system}/{component}{at}"
