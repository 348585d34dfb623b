"""Events of the components of a link, and the observer that makes them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.ext.change import ExtChange
from paramclient.protocol.params.change import Change
from paramclient.protocol.params.fetch_result import FetchResult
from paramclient.protocol.vehicle.address_contest import Contest

__all__ = [
    "ComponentContested",
    "ComponentForgotten",
    "ComponentFound",
    "ComponentDiscovered",
    "ComponentIdentified",
    "ComponentLost",
    "ComponentRebooted",
    "ComponentReplaced",
    "ComponentUncontested",
    "Event",
    "EventMaker",
    "ExtParamChanged",
    "Fetched",
    "ParamChanged",
    "TableChanged",
    "TableResynced",
]


@dataclass(frozen=True, slots=True)
class ComponentDiscovered:
    """The first message of a component was received."""

    machine: ComponentMachine


@dataclass(frozen=True, slots=True)
class ComponentIdentified:
    """The identity of a component is as complete as it gets; its cached table can be looked up."""

    machine: ComponentMachine


@dataclass(frozen=True, slots=True)
class ComponentLost:
    """No message of the component was received for the heartbeat timeout; `silence` is in seconds."""

    machine: ComponentMachine
    silence: float


@dataclass(frozen=True, slots=True)
class ComponentFound:
    """Messages of a lost component are received again, after `silence` seconds."""

    machine: ComponentMachine
    silence: float


@dataclass(frozen=True, slots=True)
class ComponentRebooted:
    """The vehicle has rebooted."""

    machine: ComponentMachine


@dataclass(frozen=True, slots=True)
class ComponentReplaced:
    """Another vehicle uses the address: everything known is invalid."""

    machine: ComponentMachine


@dataclass(frozen=True, slots=True)
class ComponentContested:
    """Several vehicles use the address: their messages are ignored and nothing is requested of them."""

    machine: ComponentMachine
    contest: Contest


@dataclass(frozen=True, slots=True)
class ComponentUncontested:
    """Only one vehicle uses the address again, or the peers are proven to be one vehicle. It is identified
    again."""

    machine: ComponentMachine


@dataclass(frozen=True, slots=True)
class ComponentForgotten:
    """The component was removed: it was lost and others needed its place. Its next message adds it again."""

    machine: ComponentMachine


class ParamChanged(NamedTuple):
    """A parameter appeared, changed or was removed. A named tuple: each first value makes one."""

    machine: ComponentMachine
    change: Change


@dataclass(frozen=True, slots=True)
class ExtParamChanged:
    """An extended parameter appeared, changed or was removed."""

    machine: ComponentMachine
    change: ExtChange


@dataclass(frozen=True, slots=True)
class TableChanged:
    """Parameters have changed, without an event for each."""

    machine: ComponentMachine


@dataclass(frozen=True, slots=True)
class Fetched:
    """A fetch has ended with a result."""

    machine: ComponentMachine
    result: FetchResult


@dataclass(frozen=True, slots=True)
class TableResynced:
    """The table was, or might have been, out of sync with the vehicle's, and matches it again.

    Attributes:
        changed: names of changed parameters, in the order of detection; empty where the vehicle's hash showed
            no change.
        hash: the hash that confirms the table, or None for a vehicle without one.
    """

    machine: ComponentMachine
    changed: tuple[str, ...]
    hash: int | None


Event: TypeAlias = (
    ComponentDiscovered
    | ComponentIdentified
    | ComponentLost
    | ComponentFound
    | ComponentRebooted
    | ComponentReplaced
    | ComponentContested
    | ComponentUncontested
    | ComponentForgotten
    | ParamChanged
    | ExtParamChanged
    | TableChanged
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

    def discovered(self, machine: ComponentMachine) -> None:
        """Report a new component."""
        self._emit(ComponentDiscovered(machine))

    def forgotten(self, machine: ComponentMachine) -> None:
        """Report that a component was removed."""
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

    def ext_changed(self, machine: ComponentMachine, change: ExtChange) -> None:
        """See `ComponentObserver`."""
        self._emit(ExtParamChanged(machine, change))

    def params_changed(self, machine: ComponentMachine) -> None:
        """See `ComponentObserver`."""
        self._emit(TableChanged(machine))

    def fetched(self, machine: ComponentMachine, result: FetchResult) -> None:
        """See `ComponentObserver`."""
        self._emit(Fetched(machine, result))

    def resynced(self, machine: ComponentMachine, changed: tuple[str, ...], confirmed: int | None) -> None:
        """See `ComponentObserver`."""
        self._emit(TableResynced(machine, changed, confirmed))
