"""Exit codes and messages of the command line, by error."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from paramclient.errors import (
    AmbiguousVehicle,
    CacheError,
    InvalidParameters,
    LinkError,
    NoReply,
    PackError,
    ParamClientError,
    UnknownParameter,
    UsageError,
    VehicleError,
)


class ExitCode(IntEnum):
    """The exit codes. If several apply, the highest one is used."""

    DONE = 0
    """The command succeeded."""
    INCOMPLETE = 1
    """The vehicle refused something, or some parameters are missing."""
    DIFFERENT = 1
    """The compared parameters differ."""
    USAGE = 2
    """The arguments are invalid."""
    NO_ANSWER = 3
    """No vehicle was heard, or it did not answer."""
    LINK = 4
    """The link failed."""
    CACHE = 5
    """The cache failed, or does not have the requested data."""


def code_of(error: ParamClientError) -> ExitCode:
    """Return the exit code for an error."""
    return next(code for kind, code in _CODES.items() if isinstance(error, kind))


def text_of(error: ParamClientError, *, takes_all: bool) -> str:
    """Return the message of an error for the command line, with options in place of Python arguments."""
    if isinstance(error, AmbiguousVehicle) and error.choose_by:
        address = error.vehicles[0].partition(" ")[0] if error.vehicles else "1/1"
        all_too = ", or all with --vehicle all" if takes_all and error.choose_by == "system" else ""
        return f"{error.summary} Choose one with --vehicle {address}{all_too}."
    if isinstance(error, InvalidParameters):
        return f"{error}\n--partial skips these, and writes the others"
    return str(error)


_CODES: Final = {
    UnknownParameter: ExitCode.USAGE,  # as everywhere for a name that does not exist
    VehicleError: ExitCode.INCOMPLETE,
    PackError: ExitCode.INCOMPLETE,
    UsageError: ExitCode.USAGE,
    NoReply: ExitCode.NO_ANSWER,
    LinkError: ExitCode.LINK,
    CacheError: ExitCode.CACHE,
}
"""Exit codes by class of error; the first class that matches applies."""
