"""How a command ends: exit codes, and the words for what became of a set."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from paramclient.errors import (
    AmbiguousVehicle,
    AnotherVehicle,
    CacheError,
    ContestedAddress,
    FileTransferError,
    LinkError,
    NoReply,
    NotDurable,
    PackError,
    ParamClientError,
    Refused,
    TypeMismatch,
    UnknownParameter,
    UsageError,
    ValueNotApplied,
    VehicleArmed,
    VehicleError,
)

__all__ = ["ExitCode", "code_of", "status_of", "text_of"]


class ExitCode(IntEnum):
    """Of several that apply, the highest counts."""

    DONE = 0
    INCOMPLETE = 1
    """The vehicle refused something, or did not give everything."""
    DIFFERENT = 1
    """What was compared is not the same."""
    USAGE = 2
    """Something was asked for that cannot be right."""
    NO_ANSWER = 3
    """No vehicle was heard, or it did not answer."""
    LINK = 4
    CACHE = 5


def code_of(error: ParamClientError) -> ExitCode:
    """The exit code for an error."""
    return next(code for kind, code in _CODES.items() if isinstance(error, kind))


def text_of(error: ParamClientError) -> str:
    """The text of an error for users of the command, who choose by options in the place of arguments."""
    if isinstance(error, AmbiguousVehicle) and error.choose_by in ("system", "component", "peer"):
        return f"{error.summary} Choose one with --{error.choose_by}."
    return str(error)


def status_of(error: ParamClientError) -> str:
    """What became of a set that ended with this error, in a word."""
    return next(status for kind, status in _STATUSES.items() if isinstance(error, kind))


_CODES: Final = {
    VehicleError: ExitCode.INCOMPLETE,
    PackError: ExitCode.INCOMPLETE,
    UsageError: ExitCode.USAGE,
    NoReply: ExitCode.NO_ANSWER,
    LinkError: ExitCode.LINK,
    CacheError: ExitCode.CACHE,
}
_STATUSES: Final = {
    Refused: "refused",
    FileTransferError: "refused",
    UnknownParameter: "unknown",
    TypeMismatch: "mismatch",
    ValueNotApplied: "not-applied",
    AnotherVehicle: "another",
    VehicleArmed: "armed",
    ContestedAddress: "contested",
    NoReply: "no-reply",
    UsageError: "invalid",
    NotDurable: "not-durable",
    CacheError: "cache",
    LinkError: "link",
}
