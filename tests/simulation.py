"""Whole sessions in simulated time: a `Station` on one side of an `Air`, simulated vehicles on the other."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import TypedDict, TypeVar

from paramclient.errors import ParamClientError
from paramclient.model.values import Encoding, Param, ParamType, Trust, WireValue, encode_value
from paramclient.protocol import wire
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.events import Event
from paramclient.protocol.params.fetch import Fetch
from paramclient.protocol.params.fetch_result import FetchResult
from paramclient.protocol.params.table import Table
from paramclient.protocol.params.writes import SetResult
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.station import Station
from paramclient.protocol.wire import NO_INDEX, Framer, Message, ParamValue
from paramclient.sim import Air, ArduPilotVehicle, Endpoint

__all__ = ["Memory", "Simulation", "is_so", "known", "listing_ardupilot", "param_value"]

STEPS_MAX = 2000
"""Steps without any time passing that look like an endless loop."""
PEER = "the only peer"

listing_ardupilot = partial(ArduPilotVehicle, ftp=False)
"""An ArduPilot without MAVFTP, which gives its table by list alone."""

Message_ = TypeVar("Message_")
Result = TypeVar("Result")


def param_value(
    name: str,
    value: WireValue = 0.0,
    *,
    index: int = NO_INDEX,
    count: int = 10,
    kind: int = ParamType.REAL32,
    encoding: Encoding = Encoding.BYTEWISE,
) -> ParamValue:
    """A PARAM_VALUE as a component would send it."""
    return ParamValue(name, encode_value(value, kind, encoding), kind, count, index)


def known(
    name: str, value: int | float = 0.0, *, index: int | None = 0, kind: ParamType | None = None
) -> Param:
    """A parameter as the cache may have kept it: INT32 or REAL32 by its value, unless it is said."""
    if kind is None:
        kind = ParamType.INT32 if isinstance(value, int) else ParamType.REAL32
    raw = encode_value(value, kind, Encoding.BYTEWISE)[: kind.size]
    return Param(name, value, kind, index, int.from_bytes(raw, "little"), Trust.CACHED)


def listed(table: Table) -> list[Param]:
    """The parameters of a table that have an index."""
    return [param for param in table.params.values() if param.index is not None]


def is_so(claim: bool) -> bool:
    """The claim as it is; for attributes that change behind the type checker's back."""
    return claim


class Memory(TypedDict):
    """What a cache keeps of a table, as `ComponentMachine.use_cached` takes it."""

    params: Mapping[str, Param]
    count: int | None
    confirmed: int | None
    complete: bool
    volatile: frozenset[str]
    volatile_known: bool


class Simulation:
    """A station and vehicles, joined by an air, in a time that begins at 0 and passes as fast as it can.

    Args:
        vehicles: what is on the far side.
        air: the way there; None for a perfect one.
        station: our side; None for a usual one.

    Attributes:
        now: seconds.
        sent: everything that the station has sent, with the time.
        events: all reported events.
    """

    def __init__(self, *vehicles: Endpoint, air: Air | None = None, station: Station | None = None) -> None:
        self.air = Air(vehicles) if air is None else air
        self.station = Station(link="sim:test", is_stream=False) if station is None else station
        self.now = 0.0
        self.sent: list[tuple[float, Message]] = []
        self.events: list[Event] = []
        self._own = Framer(wire.DECODED_IDS, stream=False)
        self._others = 0
        self.air.tick(self.now)
        self.exchange()

    def memory(self) -> Memory:
        """What a cache would keep of 1/1."""
        table = self.machine.table
        return Memory(
            params={name: param.with_trust(Trust.CACHED) for name, param in table.params.items()},
            count=table.count,
            confirmed=table.hash if table.complete else None,
            complete=table.complete,
            volatile=table.volatile,
            volatile_known=table.volatile_known,
        )

    def next_session(self, station: Station | None = None) -> None:
        """Put a new station, which knows nothing, in the place of the one there was; the vehicles go on."""
        self.station = Station(link="sim:test", is_stream=False) if station is None else station
        self.sent.clear()
        self.events.clear()
        self.exchange()

    def exchange(self) -> None:
        """Do what is due at this moment, and hand over what either side has to send."""
        for _ in range(STEPS_MAX):
            for data in self.air.data_to_send():
                self.station.receive(data, PEER, self.now)
            self.station.tick(self.now)
            outgoing = self.station.data_to_send()
            for data, _peer in outgoing:
                for frame in self._own.receive(data):
                    message = wire.decode(frame)
                    assert message is not None
                    self.sent.append((self.now, message))
                self.air.receive(data, self.now)
            self.air.tick(self.now)
            self.events += self.station.events()
            if not outgoing and self.station.next_deadline() > self.now and self._air_deadline() > self.now:
                self.check_deadline()
                return
        raise AssertionError(f"{STEPS_MAX} steps at {self.now}, and something is still due")

    def check_deadline(self) -> None:
        """Check that the station is due as early as its only component: no change of a deadline was missed.

        With several components, the end of one's requests may let another one send earlier than it planned.
        """
        station, machines = self.station, list(self.station.components.values())
        if len(machines) == 1 and station.listening_since < math.inf and not station.is_log:
            assert station.next_deadline() <= machines[0].next_deadline()

    def run(self, seconds: float) -> None:
        """Let time pass."""
        end = self.now + seconds
        self.exchange()
        while (step := min(self.station.next_deadline(), self._air_deadline())) <= end:
            self.now = step
            self.air.tick(self.now)
            self.exchange()
        self.now = end
        self.air.tick(self.now)
        self.exchange()

    def until(self, condition: Callable[[], bool], limit: float = 120.0) -> None:
        """Let time pass until something is so; it is a failure if that takes longer than the limit."""
        end = self.now + limit
        self.exchange()
        while not condition():
            self.now = min(self.station.next_deadline(), self._air_deadline())
            assert self.now <= end, f"no result in {limit} s"
            self.air.tick(self.now)
            self.exchange()

    @property
    def machine(self) -> ComponentMachine:
        """The component 1/1."""
        return self.station.components[1, 1]

    def meet(self) -> ComponentMachine:
        """Wait until it is settled who 1/1 is."""
        self.until(lambda: (1, 1) in self.station.components and self.machine.identification.settled)
        return self.machine

    def outcome(self, operation: Operation[Result], limit: float = 120.0) -> Result:
        """Wait for the end of an operation; its result, or its error raised."""
        self.until(lambda: operation.done, limit)
        if operation.error is not None:
            raise operation.error
        assert operation.result is not None
        return operation.result

    def fetch(self, *, refresh: bool = False, limit: float = 120.0) -> FetchResult:
        """Fetch everything of 1/1."""
        machine = self.meet()
        fetch: Fetch = machine.begin_fetch(self.now, refresh=refresh)
        try:
            return self.outcome(fetch, limit)
        finally:
            machine.end_fetch(fetch, self.now)

    def get(self, key: str | int, limit: float = 120.0) -> Param:
        """Read one parameter of 1/1."""
        machine = self.meet()
        message = self.outcome(machine.read(key, self.now), limit)
        return machine.table.params[message.param_id]

    def set(self, name: str, value: WireValue, limit: float = 120.0) -> SetResult:
        """Write one parameter of 1/1."""
        return self.outcome(self.meet().write(name, value, self.now), limit)

    def error_of(self, call: Callable[[], object]) -> ParamClientError:
        """The error with which a call ends."""
        try:
            call()
        except ParamClientError as error:
            return error
        raise AssertionError("it did not fail")

    def other_station(self, message: Message, *, system: int = 254, component: int = 190) -> None:
        """Another ground station sends something to the vehicles; we do not hear it."""
        self._others = (self._others + 1) % 256
        data = wire.encode(message, system=system, component=component, sequence=self._others)
        self.air.receive(data, self.now)
        self.exchange()

    def sent_of(self, kind: type[Message_]) -> list[Message_]:
        """All messages of one kind that the station has sent, in order."""
        return [message for _, message in self.sent if isinstance(message, kind)]

    def _air_deadline(self) -> float:
        deadline = self.air.next_deadline()
        return math.inf if deadline is None else deadline
