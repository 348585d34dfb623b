"""What is asked of a component, looked at before anything is sent: directly or over a service."""

from __future__ import annotations

from paramclient.errors import UsageError
from paramclient.protocol.wire import MOST_PARAMETERS
from paramclient.values import check_name

__all__ = ["check_accepted", "check_asked"]


def check_asked(name: str | int) -> None:
    """See that a parameter can have this name or this index.

    Raises:
        UsageError: it cannot.
    """
    if isinstance(name, str):
        check_name(name)
    elif not isinstance(name, int) or not 0 <= name < MOST_PARAMETERS:
        raise UsageError(f"parameter index {name}: indices are 0 to {MOST_PARAMETERS - 1}")


def check_accepted(accept: str, sample: int) -> None:
    """See that a fetch can accept this.

    Raises:
        UsageError: it cannot.
    """
    if accept not in ("verified", "sampled"):
        raise UsageError(f'accept is "verified" or "sampled", not {accept!r}')
    if sample < 1:
        raise UsageError(f"a sample has at least one parameter, not {sample}")
