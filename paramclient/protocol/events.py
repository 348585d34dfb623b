"""Events of the components of a link, and the observer that makes them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.params.change import Change
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
    "EventMaker",
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


class EventMaker:
    """Makes an event of everything that a component reports; see `ComponentObserver`.

    Args:
        emit: takes each event.
    """

    def __init__(self, emit: Callable[[Event], None]) -> None:
        self._emit = emit

    def heard(self, machine: ComponentMachine) -> None:
        """Report a new component."""
        self._emit(ComponentHeard(machine))

    def forgotten(self, machine: ComponentMachine) -> None:
        """Report that a component is not followed any more."""
        self._emit(ComponentForgotten(machine))

    def identified(self, machine: ComponentMachine) -> None:
        """See `ComponentObserver`."""
        self._emit(ComponentIdentified(machine))

    def lost(self, machine: ComponentMachine, silence: float) -> None:
        """See `ComponentObserver`."""
        self._emit(ComponentLost(machine, silence))

    def found(self, machine: ComponentMachine, silence: float) -> None:
        """See `ComponentObserver`."""
        self._emit(ComponentFound(machine, silence))

    def rebooted(self, machine: ComponentMachine) -> None:
        """See `ComponentObserver`."""
        self._emit(ComponentRebooted(machine))

    def replaced(self, machine: ComponentMachine) -> None:
        """See `ComponentObserver`."""
        self._emit(ComponentReplaced(machine))

    def contested(self, machine: ComponentMachine, contest: Contest) -> None:
        """See `ComponentObserver`."""
        self._emit(ComponentContested(machine, contest))

    def uncontested(self, machine: ComponentMachine) -> None:
        """See `ComponentObserver`."""
        self._emit(ComponentUncontested(machine))

    def changed(self, machine: ComponentMachine, change: Change) -> None:
        """See `ComponentObserver`."""
        self._emit(ParamChanged(machine, change))

    def moved(self, machine: ComponentMachine) -> None:
        """See `ComponentObserver`."""
        self._emit(ParamsMoved(machine))

    def fetched(self, machine: ComponentMachine, result: FetchResult) -> None:
        """See `ComponentObserver`."""
        self._emit(Fetched(machine, result))

    def resynced(self, machine: ComponentMachine, changed: tuple[str, ...], confirmed: int | None) -> None:
        """See `ComponentObserver`."""
        self._emit(TableResynced(machine, changed, confirmed))
