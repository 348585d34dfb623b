"""Defaults and checks of the arguments of calls, the same over a link and over a service."""

from __future__ import annotations

from typing import Final

from paramclient.errors import UsageError
from paramclient.model.values import check_name, is_portable_name
from paramclient.protocol.wire import PARAMETERS_MAX

__all__ = [
    "HEARING_PATIENCE",
    "PROGRESS_INTERVAL",
    "SETTLE_MAX",
    "address_in_words",
    "check_accepted",
    "check_asked",
    "check_asked_name",
    "check_settle",
]

HEARING_PATIENCE: Final = 10.0
"""Seconds to wait for a first component, unless the caller says otherwise."""
PROGRESS_INTERVAL: Final = 0.1
"""Seconds between two calls of a progress callback."""
SETTLE_MAX: Final = 60.0
"""Seconds for which a written value can be watched, at the most: a write to the same name waits meanwhile."""


def check_asked(name: str | int) -> None:
    """See that a parameter can have this name or this index.

    Raises:
        UsageError: it cannot.
    """
    if isinstance(name, str):
        check_asked_name(name)
    elif not isinstance(name, int) or not 0 <= name < PARAMETERS_MAX:
        raise UsageError(f"parameter index {name}: indices are 0 to {PARAMETERS_MAX - 1}")


def check_asked_name(name: str) -> str:
    """Give a name back under which a vehicle can have a parameter.

    Raises:
        UsageError: it is no param_id, or one that no parameter file can hold: of a vehicle it is not taken.
    """
    if not is_portable_name(check_name(name)):
        raise UsageError(
            f"parameter name {name!r}: no parameter file can hold it, so a vehicle's is not taken; a name has"
            " a letter, no space and none of # , ; = ; it begins with neither @ nor / and does not end with :"
        )
    return name


def check_accepted(accept: str, sample: int) -> None:
    """See that a fetch can accept this.

    Raises:
        UsageError: it cannot.
    """
    if accept not in ("verified", "sampled"):
        raise UsageError(f'accept is "verified" or "sampled", not {accept!r}')
    if sample < 1:
        raise UsageError(f"a sample has at least one parameter, not {sample}")


def check_settle(settle: float) -> float:
    """See that a value can be watched for so many seconds after it was written.

    Raises:
        UsageError: it cannot.
    """
    if not 0.0 <= settle <= SETTLE_MAX:
        raise UsageError(f"settle is a number of seconds from 0 to {SETTLE_MAX:g}, not {settle}")
    return float(settle)


def address_in_words(system: int | None, component: int | None, peer: str | None = None) -> str:
    """Return what a call looks for on a link, in words."""
    at = "" if peer is None else f" at {peer}"
    if component is None:
        return f"an autopilot{at}" if system is None else f"an autopilot with system id {system}{at}"
    return f"component {'*' if system is None else system}/{component}{at}"
