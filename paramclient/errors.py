"""Exceptions of paramclient.

The tree shows the cause of each error::

    ParamClientError
    ├── UsageError(ValueError)        the caller: an invalid name, value, link name or argument
    │   ├── FileError                 a file of parameters or of metadata that cannot be read or written
    │   ├── InvalidParameters         invalid values or unknown names
    │   ├── AlreadyRestored           the state before the last apply was already restored
    │   ├── UnknownVehicle            no vehicle in the cache matches the given name
    │   └── AmbiguousVehicle          several vehicles match, on the link or in the cache
    ├── VehicleError                  the vehicle responded with an error or another value
    │   ├── UnknownParameter          the vehicle has no parameter of that name or index
    │   ├── Refused                   the vehicle gave a reason: PARAM_ERROR, or ArduPilot's text
    │   │   ├── CommandRefused        the vehicle refused a command: MAV_RESULT
    │   │   └── ExtSetRefused         the component did not set an extended parameter: PARAM_EXT_ACK
    │   │       ├── ValueUnsupported  it does not support the value, or has no such parameter
    │   │       └── SetFailed         it could not set the value
    │   ├── TypeMismatch              the parameter's type changed, or the vehicle reports TYPE_MISMATCH
    │   ├── ValueNotApplied           the vehicle kept another value and gave no reason
    │   ├── VehicleArmed              the vehicle is armed, and setting while armed was not allowed
    │   ├── FileTransferError         the vehicle refused an operation on a file
    │   └── AnotherVehicle            another vehicle than the expected one responded
    ├── NoReply(TimeoutError)         no response before the deadline
    ├── LinkError(OSError)            the socket or the device failed
    │   └── ClientClosed              the client was closed during a call, or is not open
    ├── PackError                     an invalid packed parameter file
    └── CacheError                    the cache on disk
        ├── NotInCache                the cache has no such table, snapshot or state
        └── NotDurable                the vehicle accepted a value, and the disk did not

Each exception has its data as attributes, so that programs need not parse its text.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import IntEnum
from typing import Final

__all__ = [
    "AlreadyRestored",
    "AmbiguousVehicle",
    "AnotherVehicle",
    "CacheError",
    "ClientClosed",
    "CommandRefused",
    "CommandResult",
    "ExtAckResult",
    "ExtSetRefused",
    "FileError",
    "FileErrorCode",
    "FileTransferError",
    "InvalidParameters",
    "LinkError",
    "NoReply",
    "NotDurable",
    "NotInCache",
    "PackError",
    "ParamClientError",
    "ParamErrorCode",
    "Refused",
    "SetFailed",
    "TypeMismatch",
    "UnknownParameter",
    "UnknownVehicle",
    "UsageError",
    "ValueNotApplied",
    "ValueUnsupported",
    "VehicleArmed",
    "VehicleError",
]


PROBLEMS_SHOWN_MAX: Final = 20
"""Problems that the text of an error lists: in a file of another vehicle, every name may be one."""


class ParamErrorCode(IntEnum):
    """MAV_PARAM_ERROR: the reasons in a PARAM_ERROR message (MAVLink common message set)."""

    NO_ERROR = 0
    DOES_NOT_EXIST = 1
    VALUE_OUT_OF_RANGE = 2
    PERMISSION_DENIED = 3
    COMPONENT_NOT_FOUND = 4
    READ_ONLY = 5
    TYPE_UNSUPPORTED = 6
    TYPE_MISMATCH = 7
    READ_FAIL = 8

    @staticmethod
    def name_of(code: int) -> str:
        """Return the code in words; an unknown code as its number."""
        try:
            return ParamErrorCode(code).name.lower().replace("_", " ")
        except ValueError:
            return f"error code {code}"


class CommandResult(IntEnum):
    """MAV_RESULT: the results in a COMMAND_ACK (MAVLink common message set)."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4
    IN_PROGRESS = 5
    CANCELLED = 6
    COMMAND_LONG_ONLY = 7
    COMMAND_INT_ONLY = 8
    COMMAND_UNSUPPORTED_MAV_FRAME = 9
    NOT_IN_CONTROL = 10

    @staticmethod
    def name_of(code: int) -> str:
        """Return the result in words; an unknown result as its number."""
        try:
            return CommandResult(code).name.lower().replace("_", " ")
        except ValueError:
            return f"result {code}"


class ExtAckResult(IntEnum):
    """PARAM_ACK: the results in a PARAM_EXT_ACK (MAVLink common message set)."""

    ACCEPTED = 0
    VALUE_UNSUPPORTED = 1
    FAILED = 2
    IN_PROGRESS = 3

    @staticmethod
    def name_of(code: int) -> str:
        """Return the result in words; an unknown result as its number."""
        try:
            return ExtAckResult(code).name.lower().replace("_", " ")
        except ValueError:
            return f"result {code}"


class FileErrorCode(IntEnum):
    """MAV_FTP_ERR: the reasons in a NAK of MAVFTP (MAVLink guide, "File Transfer Protocol")."""

    NONE = 0
    FAIL = 1
    FAIL_ERRNO = 2
    INVALID_DATA_SIZE = 3
    INVALID_SESSION = 4
    NO_SESSIONS_AVAILABLE = 5
    EOF = 6
    UNKNOWN_COMMAND = 7
    FILE_EXISTS = 8
    FILE_PROTECTED = 9
    FILE_NOT_FOUND = 10

    @staticmethod
    def name_of(code: int) -> str:
        """Return the code in words; an unknown code as its number."""
        try:
            return FileErrorCode(code).name.lower().replace("_", " ")
        except ValueError:
            return f"error code {code}"


class ParamClientError(Exception):
    """Base class of all exceptions that paramclient raises."""


class UsageError(ParamClientError, ValueError):
    """The caller gave an invalid argument. Nothing was sent."""


class InvalidParameters(UsageError):
    """Some values are invalid, or some names are not on the vehicle. Nothing was sent.

    Attributes:
        problems: by parameter name, the problem with its value, as a sentence.
    """

    def __init__(self, problems: Mapping[str, str]) -> None:
        lines = [f"{name}: {problem}" for name, problem in problems.items()]
        if (further := len(lines) - PROBLEMS_SHOWN_MAX) > 0:
            lines[PROBLEMS_SHOWN_MAX:] = [f"and {further} more"]
        super().__init__("nothing was sent, because of these parameters:\n" + "\n".join(lines))
        self.problems = problems


class FileError(UsageError):
    """A file of parameters or of metadata cannot be read or written. An existing file at the target path is
    unchanged.

    The text has one line for each bad line of the file, `quad.param:17: expected …, found …`.

    Attributes:
        source: the file's name as given, or the address of metadata; "" for bytes without a name.
        line: the first bad line, from 1; None if the error concerns no single line.
        reason: the first line of the text, without the file's name and line number.
    """

    def __init__(
        self, message: str, *, source: str = "", line: int | None = None, more: tuple[str, ...] = ()
    ) -> None:
        place = source if line is None else f"{source}:{line}" if source else f"line {line}"
        super().__init__("\n".join((f"{place}: {message}" if place else message, *more)))
        self.source = source
        self.line = line
        self.reason = message


class AlreadyRestored(UsageError):
    """A restore ran after the last `apply`, so the state before that `apply` must be named. Nothing was sent.

    Restoring it again would also undo later changes.

    Attributes:
        before_apply: number of the snapshot from before the `apply`: the state that was restored. To restore
            it again, also after an interruption, name this number.
        before_restore: number of the snapshot from before the latest restore.
        restored_at: time of that restore, in unix seconds.
    """

    def __init__(self, summary: str, *, before_apply: int, before_restore: int, restored_at: float) -> None:
        super().__init__(
            f"{summary}; name the state to restore: snapshot {before_apply} for the state before that apply, "
            f"also to continue that restore; snapshot {before_restore} for the state before that restore; or "
            "a time"
        )
        self.before_apply = before_apply
        self.before_restore = before_restore
        self.restored_at = restored_at


class UnknownVehicle(UsageError):
    """No vehicle in the cache matches the given name, system id or component. Nothing was done.

    Attributes:
        vehicles: the vehicles in the cache, in words.
    """

    def __init__(self, message: str, *, vehicles: Sequence[str]) -> None:
        super().__init__(message)
        self.vehicles = tuple(vehicles)


class AmbiguousVehicle(UsageError):
    """Several vehicles match, on the link or in the cache. Nothing was done.

    Attributes:
        vehicles: the matching vehicles, in words: `1/1 PX4 quadrotor` on a link.
        choose_by: the argument that selects one of them, "system", "component" or "peer"; "" for vehicles in
            the cache, which have keys.
    """

    def __init__(self, message: str, *, vehicles: Sequence[str], choose_by: str = "") -> None:
        way = f" Choose one with the argument {choose_by}." if choose_by else ""
        super().__init__(message + way)
        self.vehicles = tuple(vehicles)
        self.choose_by = choose_by
        self.summary = message


class VehicleError(ParamClientError):
    """The vehicle responded with an error, or with another value than requested.

    Attributes:
        system, component: the component that responded.
        name: the parameter, or None if the request was by index.
        index: the requested index, or None.
    """

    def __init__(
        self, message: str, system: int, component: int, *, name: str | None = None, index: int | None = None
    ) -> None:
        super().__init__(message)
        self.system = system
        self.component = component
        self.name = name
        self.index = index


class UnknownParameter(VehicleError):
    """The vehicle has no such parameter: it said so, or left this read unanswered and answered others.

    Attributes:
        nearest: the most similar names that are known of the vehicle, most similar first. The text suggests
            them.
    """

    def __init__(
        self,
        message: str,
        system: int,
        component: int,
        *,
        name: str | None = None,
        index: int | None = None,
        nearest: Sequence[str] = (),
    ) -> None:
        super().__init__(message, system, component, name=name, index=index)
        self.nearest = tuple(nearest)


class Refused(VehicleError):
    """The vehicle refused a request and gave a reason.

    Attributes:
        code: the number in PARAM_ERROR, comparable with `ParamErrorCode`; READ_ONLY for ArduPilot's
            "Param write denied" text.
        reason: the code in words.
    """

    def __init__(
        self,
        message: str,
        system: int,
        component: int,
        *,
        code: int,
        name: str | None = None,
        index: int | None = None,
    ) -> None:
        super().__init__(message, system, component, name=name, index=index)
        self.code = code
        self.reason = ParamErrorCode.name_of(code)


class CommandRefused(Refused):
    """The vehicle refused a command with a COMMAND_ACK.

    Attributes:
        command: MAV_CMD.
        code: the number in COMMAND_ACK, comparable with `CommandResult`.
        reason: the code in words.
    """

    def __init__(self, system: int, component: int, command: int, code: int) -> None:
        reason = CommandResult.name_of(code)
        message = f"{system}/{component} refused command MAV_CMD {command}: {reason}"
        super().__init__(message, system, component, code=code)
        self.command = command
        self.reason = reason


class ExtSetRefused(Refused):
    """The component refused to set an extended parameter with a PARAM_EXT_ACK.

    Attributes:
        code: the number in PARAM_EXT_ACK, comparable with `ExtAckResult`.
        reason: the code in words.
    """

    def __init__(self, message: str, system: int, component: int, *, code: int, name: str) -> None:
        super().__init__(message, system, component, code=code, name=name)
        self.reason = ExtAckResult.name_of(code)


class ValueUnsupported(ExtSetRefused):
    """The component does not support the value, or the parameter: PARAM_ACK_VALUE_UNSUPPORTED."""


class SetFailed(ExtSetRefused):
    """The component could not set the value: PARAM_ACK_FAILED."""


class TypeMismatch(VehicleError):
    """The parameter's type changed during a write, or the vehicle answered PARAM_ERROR with TYPE_MISMATCH.

    A value that does not fit the known type is a `UsageError`, and is not sent.
    """


class ValueNotApplied(VehicleError):
    """The vehicle responded to a write with another value and no reason.

    Attributes:
        requested: the value of the write.
        actual: the value that the vehicle reports.
    """

    def __init__(
        self,
        message: str,
        system: int,
        component: int,
        *,
        name: str,
        requested: float | int | str | bytes,
        actual: float | int | str | bytes,
    ) -> None:
        super().__init__(message, system, component, name=name)
        self.requested = requested
        self.actual = actual


class VehicleArmed(VehicleError):
    """The vehicle is armed or its state is unknown, and setting parameters while armed was not allowed."""


class FileTransferError(VehicleError):
    """The vehicle refused an operation on a file.

    Attributes:
        path: the file or directory.
        code: the number in the NAK, comparable with `FileErrorCode`.
        errno: the error number of the vehicle's operating system, or 0 if the NAK has none.
        reason: the code in words.
    """

    def __init__(
        self, message: str, system: int, component: int, *, path: str, code: int, errno: int = 0
    ) -> None:
        super().__init__(message, system, component)
        self.path = path
        self.code = code
        self.errno = errno
        self.reason = FileErrorCode.name_of(code)


class AnotherVehicle(VehicleError):
    """Another vehicle than the expected one responded with the system id.

    Attributes:
        expected, found: the two vehicles, in words, with the hardware id if known.
    """

    def __init__(self, system: int, component: int, expected: str, found: str) -> None:
        message = f"another vehicle answers as {system}/{component}: expected {expected}, found {found}"
        super().__init__(message, system, component)
        self.expected = expected
        self.found = found


class NoReply(ParamClientError, TimeoutError):
    """No response arrived before the deadline.

    Attributes:
        awaited: the expected response, in words.
        attempts: the number of requests sent (0 if there is no request for it).
        waited: seconds from the first request to giving up.
        hint: what was received instead and the likely cause, in sentences, which end the message; or "".
    """

    def __init__(self, awaited: str, *, attempts: int, waited: float, hint: str = "") -> None:
        tries = f" after {attempts} {'try' if attempts == 1 else 'tries'}" if attempts else ""
        when = f"in {waited:.1f} s" if waited >= 0.05 else "in time"
        super().__init__(f"no reply: {awaited}{tries} {when}{'. ' if hint else ''}{hint}")
        self.awaited = awaited
        self.attempts = attempts
        self.waited = waited
        self.hint = hint

    def with_hint(self, hint: str) -> NoReply:
        """Return the error with a hint; the error itself if it has one already, or there is none to add."""
        if self.hint or not hint:
            return self
        return NoReply(self.awaited, attempts=self.attempts, waited=self.waited, hint=hint)


class LinkError(ParamClientError, OSError):
    """The link failed. `__cause__` is the operating system's error, if there is one.

    Attributes:
        link: the link's name as given.
    """

    def __init__(self, message: str, *, link: str) -> None:
        super().__init__(message)
        self.link = link


class ClientClosed(LinkError):
    """The client was closed during the call, or has not been opened."""


class PackError(ParamClientError):
    """Bytes are not a valid packed parameter file (param.pck).

    Attributes:
        offset: the position of the first invalid byte.
    """

    def __init__(self, message: str, *, offset: int) -> None:
        super().__init__(f"{message} (byte {offset})")
        self.offset = offset


class CacheError(ParamClientError):
    """Reading or writing the cache on disk failed."""


class NotInCache(CacheError):
    """The cache does not contain the requested table, snapshot or state."""


class NotDurable(CacheError):
    """The vehicle accepted a write with `durable`, but it is not on disk: a crash may lose it."""
