"""Every exception of paramclient.

The tree says who is to blame::

    ParamClientError
    ├── UsageError(ValueError)        the caller: a name, value, link name or argument that cannot be right
    │   ├── FileError                 a parameter file that cannot be read or written
    │   ├── InvalidParameters         values that are to be set, and cannot be right
    │   ├── MetadataError             a description of parameters that is none
    │   ├── UnknownVehicle            no vehicle in the cache has the name that was given
    │   └── AmbiguousVehicle          several vehicles fit, on the link or in the cache, and one must be named
    ├── VehicleError                  the vehicle answered, and the answer is no
    │   ├── UnknownParameter          it has no parameter of that name or index
    │   ├── Refused                   it gave a reason: PARAM_ERROR, or ArduPilot's text
    │   │   └── CommandRefused        the same for a command: MAV_RESULT
    │   ├── TypeMismatch              it holds the parameter in a type that the value cannot take
    │   ├── ValueNotApplied           it kept another value and gave no reason
    │   ├── VehicleArmed              it is armed, and nothing is set then unless told otherwise
    │   ├── FileTransferError         it did not do what was asked with a file
    │   ├── AnotherVehicle            it is not the one that was meant
    │   └── ContestedAddress          several vehicles have its address, and none of them is asked
    ├── NoReply(TimeoutError)         nobody answered in time
    ├── LinkError(OSError)            the socket or the device
    │   └── ClientClosed              the client was closed while a call waited, or is not open
    ├── PackError                     a packed parameter file that is none
    └── CacheError                    the cache on disk
        ├── NotInCache                it can be read, and does not have what was asked for
        └── NotDurable                the vehicle has taken a value, and the disk has not

Each carries what is known as attributes, so that a program need not read its text.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import IntEnum

__all__ = [
    "AmbiguousVehicle",
    "AnotherVehicle",
    "CacheError",
    "ClientClosed",
    "CommandRefused",
    "CommandResult",
    "ContestedAddress",
    "FileError",
    "FileErrorCode",
    "FileTransferError",
    "InvalidParameters",
    "LinkError",
    "MetadataError",
    "NoReply",
    "NotDurable",
    "NotInCache",
    "PackError",
    "ParamClientError",
    "ParamErrorCode",
    "Refused",
    "TypeMismatch",
    "UnknownParameter",
    "UnknownVehicle",
    "UsageError",
    "ValueNotApplied",
    "VehicleArmed",
    "VehicleError",
]


class ParamErrorCode(IntEnum):
    """MAV_PARAM_ERROR: the reasons that a PARAM_ERROR message can give (MAVLink common message set)."""

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
        """The code in words; a code that this version does not know is kept as its number."""
        try:
            return ParamErrorCode(code).name.lower().replace("_", " ")
        except ValueError:
            return f"error code {code}"


class CommandResult(IntEnum):
    """MAV_RESULT: what a COMMAND_ACK can say (MAVLink common message set)."""

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
        """The result in words; one that this version does not know is kept as its number."""
        try:
            return CommandResult(code).name.lower().replace("_", " ")
        except ValueError:
            return f"result {code}"


class FileErrorCode(IntEnum):
    """MAV_FTP_ERR: the reasons that a NAK of MAVFTP can give (MAVLink guide, "File Transfer Protocol")."""

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
        """The code in words; a code that this version does not know is kept as its number."""
        try:
            return FileErrorCode(code).name.lower().replace("_", " ")
        except ValueError:
            return f"error code {code}"


class ParamClientError(Exception):
    """The base of everything that paramclient raises on purpose."""


class UsageError(ParamClientError, ValueError):
    """The caller asked for something that cannot be right. Nothing was sent."""


class InvalidParameters(UsageError):
    """Values that are to be set cannot be right.

    Attributes:
        problems: by parameter name, what is wrong with its value, as a sentence.
    """

    def __init__(self, problems: Mapping[str, str]) -> None:
        lines = [f"{name}: {problem}" for name, problem in problems.items()]
        super().__init__("nothing was sent, as values cannot be right:\n" + "\n".join(lines))
        self.problems = problems


class FileError(UsageError):
    """A parameter file cannot be read or written; a file that was to be replaced is as it was before.

    Its text has a line for each bad line of the file, `quad.param:17: expected …, found …`.

    Attributes:
        source: the file's name as it was given; "" for bytes without one.
        line: the first bad line, from 1; None where it is not about a line.
        expected: what should have stood there, in words; None where it is not about a line.
        reason: the first of its lines, without the place.
    """

    def __init__(
        self,
        message: str,
        *,
        source: str = "",
        line: int | None = None,
        expected: str | None = None,
        more: tuple[str, ...] = (),
    ) -> None:
        if line is not None:
            place = f"{source}:{line}: " if source else f"line {line}: "
        else:
            place = f"{source}: " if source else ""
        super().__init__("\n".join((f"{place}{message}", *more)))
        self.source = source
        self.line = line
        self.expected = expected
        self.reason = message
        self._more = more

    def with_more(self, text: str) -> FileError:
        """The same with another line of text."""
        more = (*self._more, text)
        return FileError(self.reason, source=self.source, line=self.line, expected=self.expected, more=more)


class MetadataError(UsageError):
    """A file that should describe parameters does not, or lies where it is not fetched from.

    Attributes:
        source: the file or the place, in words.
    """

    def __init__(self, message: str, *, source: str) -> None:
        super().__init__(message)
        self.source = source


class UnknownVehicle(UsageError):
    """No vehicle in the cache has the name, system id or component that was given. Nothing was done.

    Attributes:
        vehicles: the vehicles that the cache holds, in words.
    """

    def __init__(self, message: str, *, vehicles: Sequence[str]) -> None:
        super().__init__(message)
        self.vehicles = tuple(vehicles)


class AmbiguousVehicle(UsageError):
    """Several vehicles fit, on the link or in the cache, and none of them was chosen. Nothing was done.

    Attributes:
        vehicles: the vehicles that fit, in words: `1/1 PX4 quadrotor` on a link.
        choose_by: the argument that chooses one of them, "system", "component" or "peer"; "link" where only
            the link of a service tells them apart; "" for vehicles in the cache, which have keys.
        summary: the text of the error without what to do next.
    """

    def __init__(self, message: str, *, vehicles: Sequence[str], choose_by: str = "") -> None:
        ways = {
            "": "",
            "link": " Name its link in the address of the service: http://HOST:PORT?link=NAME.",
        }
        super().__init__(message + ways.get(choose_by, f" Choose one with the argument {choose_by}."))
        self.vehicles = tuple(vehicles)
        self.choose_by = choose_by
        self.summary = message


class VehicleError(ParamClientError):
    """The vehicle answered, and the answer is no.

    Attributes:
        system, component: who answered.
        name: the parameter, or None where it was asked for by index.
        index: the index that was asked for, or None.
    """

    def __init__(
        self, message: str, *, system: int, component: int, name: str | None = None, index: int | None = None
    ) -> None:
        super().__init__(message)
        self.system = system
        self.component = component
        self.name = name
        self.index = index


class UnknownParameter(VehicleError):
    """The vehicle has no such parameter: it said so, or kept silent on it while it answered other reads."""


class Refused(VehicleError):
    """The vehicle gave a reason for not doing it.

    Attributes:
        code: the number in PARAM_ERROR, to compare with `ParamErrorCode`; READ_ONLY for ArduPilot's
            "Param write denied" text.
        reason: the same in words.
    """

    def __init__(
        self,
        message: str,
        *,
        system: int,
        component: int,
        code: int,
        name: str | None = None,
        index: int | None = None,
    ) -> None:
        super().__init__(message, system=system, component=component, name=name, index=index)
        self.code = code
        self.reason = ParamErrorCode.name_of(code)


class CommandRefused(Refused):
    """The vehicle does not obey a command, and says so.

    Attributes:
        command: MAV_CMD.
        code: the number in its COMMAND_ACK, to compare with `CommandResult`.
        reason: the same in words.
    """

    def __init__(self, system: int, component: int, command: int, code: int) -> None:
        reason = CommandResult.name_of(code)
        message = f"command {command} was refused by {system}/{component}: {reason}"
        super().__init__(message, system=system, component=component, code=code)
        self.command = command
        self.reason = reason


class TypeMismatch(VehicleError):
    """The vehicle holds the parameter in another type than the one that was sent."""


class ValueNotApplied(VehicleError):
    """The vehicle was asked, answers, and keeps another value without a reason.

    Attributes:
        requested: the value that was to be written.
        actual: the value that the vehicle reports.
    """

    def __init__(
        self,
        message: str,
        *,
        system: int,
        component: int,
        name: str,
        requested: float | int | bytes,
        actual: float | int | bytes,
    ) -> None:
        super().__init__(message, system=system, component=component, name=name)
        self.requested = requested
        self.actual = actual


class VehicleArmed(VehicleError):
    """The vehicle is armed, or does not say that it is not. Nothing is set then unless told otherwise."""


class FileTransferError(VehicleError):
    """The vehicle did not do what was asked with a file.

    Attributes:
        path: the file or directory.
        code: the number in its NAK, to compare with `FileErrorCode`.
        errno: the error number of the vehicle's own system, where it gave one; else 0.
        reason: the code in words.
    """

    def __init__(
        self, message: str, *, system: int, component: int, path: str, code: int, errno: int = 0
    ) -> None:
        super().__init__(message, system=system, component=component)
        self.path = path
        self.code = code
        self.errno = errno
        self.reason = FileErrorCode.name_of(code)

    @property
    def is_not_found(self) -> bool:
        """Whether there is no such file; servers say so in two ways (ENOENT is 2 on all of them)."""
        return self.code == FileErrorCode.FILE_NOT_FOUND or (
            self.code == FileErrorCode.FAIL_ERRNO and self.errno == 2
        )


class AnotherVehicle(VehicleError):
    """Another vehicle than the one that was meant answers under the system id.

    Attributes:
        expected, found: the two vehicles, in words: the hardware id where there is one.
    """

    def __init__(self, system: int, component: int, expected: str, found: str) -> None:
        message = f"another vehicle answers as {system}/{component}: it is {found}, and was to be {expected}"
        super().__init__(message, system=system, component=component)
        self.expected = expected
        self.found = found


class ContestedAddress(VehicleError):
    """Several vehicles have the system and component id, and it is open which one would be meant.

    Nothing is read from them or written to them until all but one have been silent for the heartbeat timeout.
    What was sent before that is not known to have been taken.

    Attributes:
        claimants: the peers with the address, in words, and what each says.
        difference: what tells them apart, in words.
    """

    def __init__(self, system: int, component: int, claimants: Sequence[str], difference: str) -> None:
        message = (
            f"{system}/{component} is contested, so nothing is read, written or cached. Several vehicles "
            f"have the address: {'; '.join(claimants)}. What tells them apart: {difference}. Give each "
            "its own system id, or switch one off."
        )
        super().__init__(message, system=system, component=component)
        self.claimants = tuple(claimants)
        self.difference = difference


class NoReply(ParamClientError, TimeoutError):
    """Nobody answered in time.

    Attributes:
        awaited: what was awaited, in words.
        attempts: how many times it was asked for (0 where there was nothing to ask).
        waited: seconds from the first request to giving up.
    """

    def __init__(self, awaited: str, *, attempts: int, waited: float) -> None:
        tries = f" after {attempts} {'try' if attempts == 1 else 'tries'}" if attempts else ""
        super().__init__(f"no reply: {awaited}{tries} in {waited:.1f} s")
        self.awaited = awaited
        self.attempts = attempts
        self.waited = waited


class LinkError(ParamClientError, OSError):
    """The link failed; `__cause__` is the operating system's error where there is one.

    Attributes:
        link: the link's name as it was given.
    """

    def __init__(self, message: str, *, link: str) -> None:
        super().__init__(message)
        self.link = link


class ClientClosed(LinkError):
    """The client was closed while the call waited, or had not been opened."""


class PackError(ParamClientError):
    """Bytes that should be a packed parameter file (param.pck) are none.

    Attributes:
        offset: the byte at which that showed.
    """

    def __init__(self, message: str, *, offset: int) -> None:
        super().__init__(f"{message} (byte {offset})")
        self.offset = offset


class CacheError(ParamClientError):
    """The cache on disk could not do what was asked of it."""


class NotInCache(CacheError):
    """The cache can be read, and does not have the table, the snapshot or the state that was asked for."""


class NotDurable(CacheError):
    """The vehicle has taken what was written with `durable`, and the disk has not: a crash may lose it."""
