"""Station, simulated vehicle and faulty link, driven by hypothesis: whatever happens, it ends right."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from paramclient.errors import NoReply, ParamClientError
from paramclient.protocol.download import MOST_ASKED
from paramclient.protocol.fetch import Fetch
from paramclient.protocol.operation import Operation
from paramclient.protocol.reads import Read
from paramclient.protocol.result import FetchResult
from paramclient.protocol.wire import HASH_CHECK
from paramclient.protocol.writes import Write
from paramclient.sim import Air, ArduPilotVehicle, GenericVehicle, PX4Vehicle, SimParam
from paramclient.values import ParamType, Value
from tests.simulation import Simulation

LIMIT = 300.0
"""Simulated seconds within which everything must have ended once the link is good or dead."""
SETTLING = 10.0
"""Simulated seconds after which a change has arrived everywhere, also by a vehicle that was off meanwhile."""

INTEGERS = [f"INT_{number:02d}" for number in range(20)]
FLOATS = [f"REAL_{number:02d}" for number in range(20)]
SWITCH = "ZZ_ENABLE"
LATE = "ZZ_LATE"
VOLATILE = ("CAL_MAG0_XOFF", "COM_FLIGHT_UUID", "LND_FLIGHT_T_LO")

Vehicle = PX4Vehicle | ArduPilotVehicle | GenericVehicle


def table_of(size: int) -> list[SimParam]:
    rows = [SimParam(name, ParamType.INT32, 100 + at) for at, name in enumerate(INTEGERS[:size])]
    rows += [SimParam(name, ParamType.REAL32, at / 4) for at, name in enumerate(FLOATS[:size])]
    rows += [SimParam(name, ParamType.INT32, 5, volatile=True) for name in VOLATILE]
    return [*rows, SimParam(SWITCH, ParamType.INT32, 0)]


def px4(size: int) -> Vehicle:
    late = SimParam(LATE, ParamType.INT32, 1)
    early = SimParam("A_LATE", ParamType.REAL32, 2.0)
    return PX4Vehicle(table=[*table_of(size), late, early], late_use={SWITCH: [LATE, "A_LATE"]})


def px4_without_hash(size: int) -> Vehicle:
    return PX4Vehicle(table=table_of(size), hash_check=False)


def px4_of_newest_main(size: int) -> Vehicle:
    return PX4Vehicle(table=table_of(size), param_error=True)


def px4_with_unknown_volatile(size: int) -> Vehicle:
    rows = [SimParam(row.name, row.type, row.value, row.name in INTEGERS[:3]) for row in table_of(size)]
    return PX4Vehicle(table=rows)


def ardupilot(size: int) -> Vehicle:
    group = {f"ZY_{number}": float(number) for number in range(5)}
    return ArduPilotVehicle(table=table_of(size), groups={SWITCH: group}, live=())


def newer_ardupilot(size: int) -> Vehicle:
    return ArduPilotVehicle(table=table_of(size), read_only=INTEGERS[:1], live=(), param_error=True)


def generic(size: int) -> Vehicle:
    return GenericVehicle(table_of(size), autopilot=0)


@dataclass
class Begun:
    """An operation and what is known of the time when it began."""

    operation: Operation[object]
    changes: int | None
    """How much had been changed; None when something was still on the move."""


class Sessions(RuleBasedStateMachine):
    """One station and one vehicle; the link may lose nearly half, and may become good or dead for good."""

    @initialize(
        make=st.sampled_from(
            [
                px4,
                px4_without_hash,
                px4_of_newest_main,
                px4_with_unknown_volatile,
                ardupilot,
                newer_ardupilot,
                generic,
            ]
        ),
        size=st.integers(1, 20),
        loss=st.sampled_from([0.0, 0.0, 0.05, 0.2, 0.4]),
        delay=st.sampled_from([0.0, 0.02, 0.3]),
        jitter=st.sampled_from([0.0, 0.05]),
        duplicate=st.sampled_from([0.0, 0.2]),
        reorder=st.sampled_from([0.0, 0.2]),
        seed=st.integers(0, 1000),
    )
    def switch_on(
        self,
        make: object,
        size: int,
        loss: float,
        delay: float,
        jitter: float,
        duplicate: float,
        reorder: float,
        seed: int,
    ) -> None:
        assert callable(make)
        self.vehicle: Vehicle = make(size)
        air = Air.symmetric(
            [self.vehicle],
            loss=loss,
            delay=delay,
            jitter=jitter,
            duplicate=duplicate,
            reorder=reorder,
            seed=seed,
        )
        self.lossy = loss > 0
        self.world = Simulation(air=air)
        self.names = [*INTEGERS[:size], *FLOATS[:size], *VOLATILE, SWITCH]
        self.open: list[Begun] = []
        self.changes = 0  # how often anything was changed, by anyone
        self.changed_at = -math.inf
        self.is_dead = False

    # what happens

    @rule(seconds=st.sampled_from([0.001, 0.03, 0.25, 1.0, 5.0, 20.0]))
    def time_passes(self, seconds: float) -> None:
        self.world.run(seconds)

    @precondition(lambda self: self.is_known)
    @rule(refresh=st.booleans())
    def fetch(self, refresh: bool) -> None:
        self.begin(lambda: self.world.machine.begin_fetch(self.world.now, refresh=refresh))

    @precondition(lambda self: self.is_known)
    @rule(data=st.data(), name=st.sampled_from([*VOLATILE, SWITCH, INTEGERS[0], FLOATS[0], "NOT_THERE"]))
    def get(self, data: st.DataObject, name: str) -> None:
        key: str | int = data.draw(st.one_of(st.just(name), st.integers(0, len(self.names) + 2)))
        self.begin(lambda: self.world.machine.read(key, self.world.now))

    @precondition(lambda self: self.is_known)
    @rule(data=st.data(), number=st.integers(0, 50))
    def set(self, data: st.DataObject, number: int) -> None:
        name = data.draw(st.sampled_from([*self.names, "NOT_THERE"]))
        self.moved()
        self.begin(lambda: self.world.machine.write(name, number, self.world.now))

    @precondition(lambda self: self.open)
    @rule(data=st.data())
    def cancel(self, data: st.DataObject) -> None:
        at = data.draw(st.integers(0, len(self.open) - 1))
        self.cancel_one(self.open.pop(at).operation)
        self.world.exchange()

    @rule(data=st.data(), number=st.integers(60, 90))
    def another_station_sets(self, data: st.DataObject, number: int) -> None:
        name = data.draw(st.sampled_from(self.names))
        self.moved()
        self.vehicle.set_param(name, float(number) if name in FLOATS else number)
        self.world.exchange()

    @rule()
    def a_group_comes_or_goes(self) -> None:
        self.moved()
        self.vehicle.set_param(SWITCH, 1 - min(int(self.vehicle.param(SWITCH).bits), 1))
        self.world.exchange()

    @precondition(lambda self: not self.is_dead)
    @rule(down=st.sampled_from([0.0, 0.5, 8.0]))
    def reboot(self, down: float) -> None:
        self.moved()
        self.vehicle.reboot(self.world.now, down=down)
        self.world.exchange()

    @precondition(lambda self: self.is_known and not self.is_dead)
    @rule(after=st.sampled_from([0.0, 3.0]))
    def the_next_session(self, after: float) -> None:
        """All is let go, the table is kept, and somebody may change something before the next one."""
        for begun in self.open:
            self.cancel_one(begun.operation)
        self.open.clear()
        self.world.run(after)
        memory = self.world.memory()
        self.world.next_session()
        self.world.run(3.0)
        if self.is_known:
            self.world.machine.use_cached(now=self.world.now, **memory)

    @precondition(lambda self: not self.is_dead)
    @rule(how_likely=st.integers(0, 9))
    def the_vehicle_dies(self, how_likely: int) -> None:
        if how_likely < 9:
            return
        self.moved()
        self.vehicle.reboot(self.world.now, down=math.inf)
        self.is_dead = True

    # what must hold

    @invariant()
    def what_ended_is_right(self) -> None:
        for begun in [each for each in getattr(self, "open", []) if each.operation.done]:
            self.open.remove(begun)
            self.check(begun)
            if isinstance(begun.operation, Fetch):
                self.world.machine.end_fetch(begun.operation, self.world.now)
            elif isinstance(begun.operation, Read):
                self.world.machine.reads.release(begun.operation)

    @invariant()
    def memory_is_bounded(self) -> None:
        if not self.is_known:
            return
        machine = self.world.machine
        mine = len(self.open)
        assert len(machine.reads) <= MOST_ASKED + mine + 3 * len(self.names) + 10
        assert len(machine.writes) <= mine
        assert len(machine.table.params) <= len(self.names) + 10
        assert len(machine.table.dirty) <= len(self.names) + 10

    def teardown(self) -> None:
        if not hasattr(self, "world"):
            return
        world = self.world
        world.air.uplink._loss = world.air.downlink._loss = 0.0
        world.run(LIMIT)
        for begun in self.open:
            assert begun.operation.done, f"{begun.operation!r} has not ended"
            self.check(begun)
        self.open.clear()
        if not self.is_known:
            return
        machine = world.machine
        assert len(machine.reads) == 0
        assert len(machine.writes) == 0
        assert machine.fetch is None
        if not self.is_dead:
            result = world.fetch(refresh=True)
            assert result.complete
            self.compare(result)

    # tools

    @property
    def is_known(self) -> bool:
        return hasattr(self, "world") and (1, 1) in self.world.station.components

    def begin(self, call: Callable[[], Read | Write | Fetch]) -> None:
        """Begin something; of a component that is lost, nothing can be asked."""
        try:
            operation = call()
        except NoReply:
            assert self.world.machine.presence.is_lost
            return
        self.begun(operation)
        self.world.exchange()

    def begun(self, operation: Read | Write | Fetch) -> None:
        is_moving = self.world.now - self.changed_at < SETTLING or len(self.world.machine.writes)
        changes = None if is_moving else self.changes
        self.open.append(Begun(operation, changes))  # type: ignore[arg-type]  # only its end counts here

    def moved(self) -> None:
        self.changes += 1
        self.changed_at = self.world.now

    def cancel_one(self, operation: object) -> None:
        machine = self.world.machine
        if isinstance(operation, Write):
            machine.writes.cancel(operation, self.world.now)
            self.moved()
        elif isinstance(operation, Fetch):
            machine.end_fetch(operation, self.world.now)
        elif isinstance(operation, Read):
            machine.reads.release(operation)

    def check(self, begun: Begun) -> None:
        operation = begun.operation
        if operation.error is not None:
            assert isinstance(operation.error, ParamClientError)
            is_link_to_blame = self.lossy or self.changes or self.is_dead
            assert is_link_to_blame or not isinstance(operation.error, NoReply) or not self.is_listening
        elif isinstance(operation, Fetch) and operation.result is not None and operation.result.complete:
            self.compare(operation.result, begun)

    @property
    def is_listening(self) -> bool:
        return not self.is_dead

    def compare(self, result: FetchResult, begun: Begun | None = None) -> None:
        """Nothing has moved for a while: then what was fetched is what the vehicle has."""
        if begun is not None and begun.changes != self.changes:
            return
        true: dict[str, Value] = self.vehicle.values
        held = {name: param for name, param in result.params.items() if param.index is not None}
        assert result.count == len(true)
        assert held.keys() == true.keys()
        for name, param in held.items():
            is_volatile = self.vehicle._entry(name).volatile
            if not (is_volatile and result.source == "cache"):
                assert param.value == true[name], name
            assert param.index == self.vehicle.param(name).index, name
        if isinstance(self.vehicle, PX4Vehicle) and result.hash is not None:
            assert result.hash == self.vehicle.announced_hash()
        assert HASH_CHECK not in result.params


TestSessions = Sessions.TestCase
TestSessions.settings = settings(
    max_examples=50,
    stateful_step_count=30,
    deadline=None,
    print_blob=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
)
