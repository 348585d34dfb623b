"""Tracebacks of errors that the caller has caused, without the frames inside paramclient."""

from __future__ import annotations

from typing import Final, TypeVar

from paramclient.errors import ParamClientError

__all__ = ["shortened"]

Error = TypeVar("Error", bound=Exception)

INNER_PACKAGES: Final = frozenset({"paramclient", "anyio"})
"""Packages whose frames say nothing to a caller: the type, text and attributes of the error say it."""


def shortened(error: Error) -> Error:
    """Return a ParamClientError without its traceback, which then begins at the `raise` of the caller.

    A traceback with frames of other code, such as a callback of the user, is kept, and so is that of any
    other exception. Of a cause from the operating system, type and text are kept.
    """
    if not isinstance(error, ParamClientError):
        return error
    trace = error.__traceback__
    while trace is not None:
        module = trace.tb_frame.f_globals.get("__name__", "")
        if str(module).partition(".")[0] not in INNER_PACKAGES:
            return error
        trace = trace.tb_next
    if isinstance(error.__cause__, OSError):
        error.__cause__.__traceback__ = None
    error.__traceback__ = None
    return error
