"""What happens on a link, for those who follow it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from paramclient.protocol.params.change import Change

if TYPE_CHECKING:
    from paramclient.protocol.component import ComponentMachine
    from paramclient.protocol.params.fetch_result import FetchResult
    from paramclient.protocol.vehicle.peers import Contest

__all__ = [
    "ComponentContested",
    "ComponentForgotten",
    "ComponentFound",
    "ComponentHeard",
    "ComponentIdentified",
    "ComponentLost",
    "ComponentRebooted",
    "ComponentReplaced",
    "ComponentUncontested",
    "Event",
    "Fetched",
    "ParamChanged",
    "ParamsMoved",
    "TableResynced",
]


@dataclass(frozen=True, slots=True)
class ComponentHeard:
    """A component was heard for the first time."""

    machine: ComponentMachine


@dataclass(frozen=True, slots=True)
class ComponentIdentified:
    """It is settled who the component is, as far as it ever will be; its cached table can be looked for."""

    machine: ComponentMachine


@dataclass(frozen=True, slots=True)
class ComponentLost:
    """Nothing has come from it for too long: `silence` seconds."""

    machine: ComponentMachine
    silence: float


@dataclass(frozen=True, slots=True)
class ComponentFound:
    """One that was lost is heard again, after `silence` seconds."""

    machine: ComponentMachine
    silence: float


@dataclass(frozen=True, slots=True)
class ComponentRebooted:
    """The vehicle has started again."""

    machine: ComponentMachine


@dataclass(frozen=True, slots=True)
class ComponentReplaced:
    """Another vehicle has its address: nothing that was known is about that one."""

    machine: ComponentMachine


@dataclass(frozen=True, slots=True)
class ComponentContested:
    """Several vehicles have its address: nothing is taken from them, and nothing is asked of them."""

    machine: ComponentMachine
    contest: Contest


@dataclass(frozen=True, slots=True)
class ComponentUncontested:
    """One vehicle alone has its address again, or the peers are proven to be one vehicle. It is asked who it
    is.
    """

    machine: ComponentMachine


@dataclass(frozen=True, slots=True)
class ComponentForgotten:
    """It is not followed any more, as it was lost and others want to be heard. Should it speak, it is new."""

    machine: ComponentMachine


class ParamChanged(NamedTuple):
    """A parameter appeared, changed or went away. A named tuple: each first value makes one."""

    machine: ComponentMachine
    change: Change


@dataclass(frozen=True, slots=True)
class ParamsMoved:
    """Parameters have changed of which nobody wants to be told one by one."""

    machine: ComponentMachine


@dataclass(frozen=True, slots=True)
class Fetched:
    """A fetch has ended with a result."""

    machine: ComponentMachine
    result: FetchResult


@dataclass(frozen=True, slots=True)
class TableResynced:
    """The table had fallen behind the vehicle's, or might have, and agrees with it again.

    Attributes:
        changed: names of what had moved, in the order in which that was found out; empty where the vehicle's
            hash showed that nothing had.
        hash: the hash that confirms it, or None for a vehicle without one.
    """

    machine: ComponentMachine
    changed: tuple[str, ...]
    hash: int | None


Event: TypeAlias = (
    ComponentHeard
    | ComponentIdentified
    | ComponentLost
    | ComponentFound
    | ComponentRebooted
    | ComponentReplaced
    | ComponentContested
    | ComponentUncontested
    | ComponentForgotten
    | ParamChanged
    | ParamsMoved
    | Fetched
    | TableResynced
)
