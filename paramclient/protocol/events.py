"""What happens to a component and to its parameters, as subscribers see it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

from paramclient.model.values import Param

__all__ = ["Change", "ComponentEvent", "Found", "Identified", "Lost", "Rebooted", "Replaced", "Resynced"]


@dataclass(frozen=True, slots=True)
class Change:
    """One parameter that appeared, changed its value or type, or was removed.

    Attributes:
        name: param_id.
        old: the parameter before, or None for a new one.
        new: the parameter now, or None when the vehicle no longer has it.
        by: the author: "us" (a `set` of this client), "us for NAME" (a `set` on behalf of NAME), "vehicle",
            or the system and component of another station whose PARAM_SET was seen.
        kind: "changed"; "first" for a value of a table that was never complete; "added" for a parameter that
            a complete table lacked; "removed".
    """

    name: str
    old: Param | None
    new: Param | None
    by: str
    kind: Literal["changed", "first", "added", "removed"]


@dataclass(frozen=True, slots=True)
class Identified:
    """The identity of the component is as complete as it gets."""


@dataclass(frozen=True, slots=True)
class Lost:
    """No message was received for `silence` seconds."""

    silence: float


@dataclass(frozen=True, slots=True)
class Found:
    """Messages of a lost component are received again, after `silence` seconds."""

    silence: float


@dataclass(frozen=True, slots=True)
class Rebooted:
    """The vehicle has rebooted."""


@dataclass(frozen=True, slots=True)
class Replaced:
    """Another vehicle uses the address: everything known is invalid."""


@dataclass(frozen=True, slots=True)
class Resynced:
    """The table matches the vehicle's again, after it did not, or might not have.

    Attributes:
        changed: the names of parameters that had changed.
        hash: PX4's hash or ArduPilot's checksum that confirms the table, or None.
    """

    changed: tuple[str, ...]
    hash: int | None


ComponentEvent: TypeAlias = Identified | Lost | Found | Rebooted | Replaced | Resynced
