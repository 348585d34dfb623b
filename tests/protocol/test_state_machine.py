"""Station, simulated vehicles and faulty link, driven by hypothesis: whatever happens, it ends right."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TypedDict, Unpack

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.params.fetch import Fetch
from paramclient.protocol.params.list_download import REQUESTED_INDICES_MAX
from paramclient.protocol.params.reads import Read, ValueRead
from paramclient.protocol.params.sync import SyncSettings
from paramclient.protocol.params.write_batch import WriteBatch
from paramclient.protocol.params.writes import Write
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.requests.write_window import WRITES_IN_FLIGHT_MAX

from paramclient.errors import NoReply, ParamClientError
from paramclient.model.values import Encoding, Param, ParamType, encode_value
from paramclient.protocol.fetch import FetchResult, Policy
from paramclient.protocol.set_results import SetOutcome, SetStatus
from paramclient.protocol.station import Station
from paramclient.sim import (
    Air,
    ArduPilotVehicle,
    FaultyLink,
    GenericVehicle,
    OtherStation,
    PX4Vehicle,
    SimParam,
)
from paramclient.wire import messages
from paramclient.wire.messages import HASH_CHECK
from tests.simulation import Simulation

LIMIT = 300.0
"""Simulated seconds within which everything must have ended once the link is good or dead."""
SETTLING = 10.0
"""Simulated seconds after which a change has arrived everywhere, also by a vehicle that was off meanwhile."""
LOOK = 20.0
"""Simulated seconds that a look at the hash takes, with the download that follows from it, on a good link."""

INTEGERS = [f"INT_{number:02d}" for number in range(20)]
FLOATS = [f"REAL_{number:02d}" for number in range(20)]
SWITCH = "ZZ_ENABLE"
LATE = "ZZ_LATE"
VOLATILE = ("CAL_MAG0_XOFF", "COM_FLIGHT_UUID", "LND_FLIGHT_T_LO")
GROUP = [f"ZY_{number}" for number in range(5)]
"""What an ArduPilot shows when the switch is on."""
CAMERA = 100

Vehicle = PX4Vehicle | ArduPilotVehicle | GenericVehicle


def table_of(size: int) -> list[SimParam]:
    rows = [SimParam(name, ParamType.INT32, 100 + at) for at, name in enumerate(INTEGERS[:size])]
    rows += [SimParam(name, ParamType.REAL32, at / 4) for at, name in enumerate(FLOATS[:size])]
    rows += [SimParam(name, ParamType.INT32, 5, volatile=True) for name in VOLATILE]
    return [*rows, SimParam(SWITCH, ParamType.INT32, 0)]


class Options(TypedDict):
    """What every vehicle here is given."""

    boot_time: float
    dead: frozenset[int]
    list_stops_at: int | None
    list_stops: float


def px4(size: int, **options: Unpack[Options]) -> Vehicle:
    late = SimParam(LATE, ParamType.INT32, 1)
    early = SimParam("A_LATE", ParamType.REAL32, 2.0)
    late_use = {SWITCH: [LATE, "A_LATE"]}
    return PX4Vehicle(table=[*table_of(size), late, early], late_use=late_use, **options)


def px4_without_hash(size: int, **options: Unpack[Options]) -> Vehicle:
    return PX4Vehicle(table=table_of(size), hash_check=False, **options)


def px4_of_newest_main(size: int, **options: Unpack[Options]) -> Vehicle:
    return PX4Vehicle(table=table_of(size), param_error=True, **options)


def px4_with_unknown_volatile(size: int, **options: Unpack[Options]) -> Vehicle:
    rows = [SimParam(row.name, row.type, row.value, row.name in INTEGERS[:3]) for row in table_of(size)]
    return PX4Vehicle(table=rows, **options)


def ardupilot(size: int, **options: Unpack[Options]) -> Vehicle:
    group = {name: float(number) for number, name in enumerate(GROUP)}
    return ArduPilotVehicle(ftp=False, table=table_of(size), groups={SWITCH: group}, live=(), **options)


def newer_ardupilot(size: int, **options: Unpack[Options]) -> Vehicle:
    return ArduPilotVehicle(
        table=table_of(size), read_only=INTEGERS[:1], live=(), param_error=True, **options
    )


def generic(size: int, **options: Unpack[Options]) -> Vehicle:
    return GenericVehicle(table_of(size), autopilot=0, **options)


class Link(TypedDict):
    """What a link does, as `FaultyLink` takes it."""

    loss: float
    loss_burst: float
    delay: float
    jitter: float
    duplicate: float
    reorder: float
    rate: float | None
    queue: int | None


GOOD = Link(
    loss=0.0, loss_burst=1.0, delay=0.02, jitter=0.0, duplicate=0.0, reorder=0.0, rate=None, queue=None
)


@st.composite
def links(draw: st.DrawFn) -> Link:
    loses = draw(st.booleans())
    rate = draw(st.sampled_from([None, None, 1200.0, 5760.0])) if loses else None
    return Link(
        loss=draw(st.sampled_from([0.0, 0.05, 0.2, 0.4])) if loses else 0.0,
        loss_burst=draw(st.sampled_from([1.0, 1.0, 4.0, 20.0])),
        delay=draw(st.sampled_from([0.0, 0.02, 0.3])),
        jitter=draw(st.sampled_from([0.0, 0.05, 0.3])),
        duplicate=draw(st.sampled_from([0.0, 0.2])),
        reorder=draw(st.sampled_from([0.0, 0.2])),
        rate=rate,
        queue=None if rate is None else draw(st.sampled_from([300, 1024])),
    )


@dataclass
class Misfortunes:
    """What a vehicle does from the beginning; `is_plain` without any of it."""

    boot_time: float
    dead: frozenset[int]
    list_stops_at: int | None
    list_stops: float
    list_every: float

    @property
    def is_plain(self) -> bool:
        return not (self.boot_time or self.dead or self.list_stops_at or self.list_every < math.inf)


MISFORTUNES = st.builds(
    Misfortunes,
    boot_time=st.sampled_from([0.0, 0.0, 0.0, 5.0]),
    dead=st.one_of(
        st.just(frozenset[int]()),
        st.just(frozenset[int]()),
        st.frozensets(st.integers(0, 43), min_size=1, max_size=3),
    ),
    list_stops_at=st.sampled_from([None, None, None, 1, 10]),
    list_stops=st.sampled_from([1, 3, math.inf]),
    list_every=st.sampled_from([math.inf, math.inf, math.inf, 0.5, 3.0]),
)
UPKEEPS = st.builds(
    SyncSettings,
    interval=st.sampled_from([math.inf, 5.0, 30.0]),
    without_hash=st.booleans(),
    policy=st.sampled_from([Policy.AUTO] * 6 + [Policy.HASH_ONLY, Policy.CACHE_ONLY]),
)


class Subject:
    """A vehicle, and what is known of its changes."""

    def __init__(self, vehicle: Vehicle) -> None:
        self.vehicle = vehicle
        self.address = (vehicle.system, vehicle.component)
        self.changes = 0  # how often anything was changed, by anyone
        self.changed_at = -math.inf
        self.acts = 0  # how often anything else than one batch of writes may have changed a value
        self.is_written = False
        self.seen: FetchResult | None = None  # the last one that was looked at
        self.proved: int | None = None  # how much had been changed when the table was last seen to be right

    def changed(self, now: float) -> None:
        self.changes += 1
        self.changed_at = now


@dataclass
class Begun:
    """An operation and what is known of the time when it began."""

    operation: Operation[object]
    subject: Subject
    changes: int | None
    """How much had been changed; None when something was still on the move."""
    acts: int | None = None
    """Of a batch: `Subject.acts` when it began; None if other writes were open."""
    pairs: Sequence[tuple[str, int]] = ()
    """Of a batch: what was to be written."""


SWITCH_ON: dict[str, Any] = {
    "make": st.sampled_from(
        [
            px4,
            px4,
            px4_without_hash,
            px4_of_newest_main,
            px4_with_unknown_volatile,
            ardupilot,
            newer_ardupilot,
            generic,
        ]
    ),
    "size": st.integers(1, 20),
    "link": links(),
    "seed": st.integers(0, 1000),
    "misfortunes": st.one_of(st.just(Misfortunes(0.0, frozenset(), None, 1, math.inf)), MISFORTUNES),
    "sync_settings": UPKEEPS,
    "has_camera": st.sampled_from([False, False, True]),
    "uptime": st.sampled_from([0.0, 3.0, 12.0]),
    "begins_with_fetch": st.sampled_from([True, True, False]),
}
"""What a session begins with."""


class Sessions(RuleBasedStateMachine):
    """One station, a vehicle and perhaps its camera; their link may become anything, also dead for good."""

    begun_sessions: ClassVar[int] = 0

    @initialize(**SWITCH_ON)
    def switch_on(
        self,
        make: Callable[..., Vehicle],
        size: int,
        link: Link,
        seed: int,
        misfortunes: Misfortunes,
        sync_settings: SyncSettings,
        has_camera: bool,
        uptime: float,
        begins_with_fetch: bool,
    ) -> None:
        Sessions.begun_sessions += 1
        self.vehicle = make(
            size,
            boot_time=misfortunes.boot_time,
            dead=misfortunes.dead,
            list_stops_at=misfortunes.list_stops_at,
            list_stops=misfortunes.list_stops,
        )
        self.subject = Subject(self.vehicle)
        self.subjects = [self.subject]
        if has_camera:
            table = {name: 1000 + at for at, name in enumerate(INTEGERS[:size])}
            self.subjects.append(Subject(GenericVehicle(table, component=CAMERA, autopilot=8)))
        others = (
            [OtherStation(list_every=misfortunes.list_every)] if misfortunes.list_every < math.inf else []
        )
        vehicles = [subject.vehicle for subject in self.subjects]
        air = Air.symmetric(vehicles, others=others, seed=seed, **link)
        self.misfortunes = misfortunes
        self.sync_settings = sync_settings
        self.is_bad = self.is_never_good(link)  # whether the link can be to blame
        self.may_overtake = link["reorder"] > 0 or link["duplicate"] > 0  # an old PARAM_SET may arrive late
        self.world = Simulation(air=air, station=self.new_station())
        self.names = [*INTEGERS[:size], *FLOATS[:size], *VOLATILE, SWITCH]
        self.open: list[Begun] = []
        self.looked_at = 0.0
        self.is_dead = False
        self.back_at = 0.0  # when the vehicle is on again
        self.world.run(uptime)
        if begins_with_fetch and self.is_known:
            self.fetch_all_there_is()

    # what happens

    @rule(seconds=st.sampled_from([0.001, 0.03, 0.25, 1.0, 5.0, 20.0]))
    def time_passes(self, seconds: float) -> None:
        self.world.run(seconds)

    @rule(link=links())
    def the_link_changes(self, link: Link) -> None:
        self.become(link)

    @rule(seconds=st.sampled_from([0.1, 3.0, 8.0, 30.0]))
    def the_link_is_dead_for_a_while(self, seconds: float) -> None:
        self.stay_silent(seconds)

    @precondition(lambda self: self.is_known)
    @rule(refresh=st.booleans(), of_camera=st.sampled_from([False, False, True]))
    def fetch(self, refresh: bool, of_camera: bool) -> None:
        subject = self.pick(of_camera)
        machine = self.machine_of(subject)
        self.begin(subject, lambda: machine.begin_fetch(self.world.now, refresh=refresh))

    @precondition(lambda self: self.is_known)
    @rule(refresh=st.booleans())
    def fetch_together(self, refresh: bool) -> None:
        subjects = [subject for subject in self.subjects if self.is_received(subject)]
        if any(self.machine_of(subject).presence.is_lost for subject in subjects):
            return
        machines = [self.machine_of(subject) for subject in subjects]
        fetches = self.world.station.begin_fetches(machines, self.world.now, refresh=refresh)
        for subject, fetch in zip(subjects, fetches, strict=True):
            self.begun(subject, fetch)
        self.world.exchange()

    @precondition(lambda self: self.is_known)
    @rule(data=st.data(), name=st.sampled_from([*VOLATILE, SWITCH, INTEGERS[0], FLOATS[0], "NOT_THERE"]))
    def get(self, data: st.DataObject, name: str) -> None:
        key: str | int = data.draw(st.one_of(st.just(name), st.integers(0, len(self.names) + 2)))
        subject = self.pick(data.draw(st.sampled_from([False, False, True])))
        self.begin(subject, lambda: self.machine_of(subject).read(key, self.world.now))

    @precondition(lambda self: self.is_known)
    @rule(data=st.data(), number=st.integers(0, 50))
    def set(self, data: st.DataObject, number: int) -> None:
        name = data.draw(st.sampled_from([*self.names, "NOT_THERE"]))
        subject = self.pick(data.draw(st.sampled_from([False, False, True])))
        subject.changed(self.world.now)
        subject.acts += 1
        self.begin(subject, lambda: self.machine_of(subject).write(name, number, self.world.now))

    @precondition(lambda self: self.is_known)
    @rule(data=st.data(), size=st.integers(1, 40))
    def set_many(self, data: st.DataObject, size: int) -> None:
        """Write many values, among them those of a group, and the switch that shows or hides it."""
        some = st.sampled_from([*self.names, SWITCH, *GROUP, "NOT_THERE"])
        pairs = data.draw(st.lists(st.tuples(some, st.integers(0, 50)), min_size=1, max_size=size))
        subject = self.pick(data.draw(st.sampled_from([False, False, True])))
        machine = self.machine_of(subject)
        is_alone = not len(machine.writes)
        subject.changed(self.world.now)
        subject.acts += 1
        acts = subject.acts if is_alone else None
        self.begin(subject, lambda: machine.write_many(pairs, self.world.now), acts=acts, pairs=pairs)

    @precondition(lambda self: self.open)
    @rule(data=st.data())
    def cancel(self, data: st.DataObject) -> None:
        at = data.draw(st.integers(0, len(self.open) - 1))
        self.cancel_one(self.open.pop(at))
        self.world.exchange()

    @rule(data=st.data(), number=st.integers(60, 90))
    def a_value_changes_on_board(self, data: st.DataObject, number: int) -> None:
        name = data.draw(st.sampled_from(self.names))
        self.changed()
        self.vehicle.set_param(name, float(number) if name in FLOATS else number)
        if data.draw(st.booleans()):
            self.stay_silent(0.1)
        self.world.exchange()

    @rule(data=st.data(), number=st.integers(60, 90), is_received=st.booleans())
    def another_station_sets(self, data: st.DataObject, number: int, is_received: bool) -> None:
        name = data.draw(st.sampled_from(self.names))
        self.changed()
        encoding = Encoding.C_CAST if isinstance(self.vehicle, ArduPilotVehicle) else Encoding.BYTEWISE
        kind = ParamType.REAL32 if name in FLOATS else ParamType.INT32
        raw = encode_value(float(number) if name in FLOATS else number, kind, encoding)
        self.another_sends(messages.ParamSet(1, 1, name, raw, kind), is_received)

    @rule(is_received=st.booleans(), component=st.sampled_from([0, 1]))
    def another_station_lists(self, is_received: bool, component: int) -> None:
        self.another_sends(messages.ParamRequestList(1, component), is_received)

    @rule()
    def a_group_comes_or_goes(self) -> None:
        self.changed()
        self.toggle()
        self.world.exchange()

    @rule(
        after=st.integers(1, 40),
        what=st.sampled_from(["group", "reboot", "value"]),
        refresh=st.booleans(),
        then=st.sampled_from([0.0, 1.0, 20.0]),
    )
    def something_happens_in_mid_stream(self, after: int, what: str, refresh: bool, then: float) -> None:
        def happen() -> None:
            self.changed()
            if what == "group":
                self.toggle()
            elif what == "value":
                self.vehicle.set_param(SWITCH, 3)
            elif not self.is_dead:
                self.vehicle.reboot(down=3.0)

        self.vehicle.when_listed(after, happen)
        if refresh and self.is_known:
            machine = self.world.machine
            self.begin(self.subject, lambda: machine.begin_fetch(self.world.now, refresh=True))
            self.world.run(then)

    @precondition(lambda self: not self.is_dead)
    @rule(down=st.sampled_from([0.0, 0.5, 8.0, 25.0]), data=st.data())
    def reboot(self, down: float, data: st.DataObject) -> None:
        """It may return with other values: they were not saved, or its memory card is another one."""
        for name in data.draw(st.lists(st.sampled_from(self.names), max_size=3)):
            entry = self.vehicle._entry(name)
            entry.store(entry.bits ^ 1)
        self.changed()
        self.vehicle.reboot(self.world.now, down=down)
        self.back_at = self.world.now + down
        self.world.exchange()

    @rule()
    def a_satellite_link_begins_or_ends(self) -> None:
        self.is_bad = True
        self.vehicle.high_latency = not self.vehicle.high_latency
        self.world.exchange()

    @precondition(lambda self: self.is_known and not self.is_dead)
    @rule(after=st.sampled_from([0.0, 3.0]))
    def the_next_session(self, after: float) -> None:
        """End the session, keep the table; another station may change a value before the next one."""
        for begun in self.open:
            self.cancel_one(begun)
        self.open.clear()
        self.world.run(after)
        memory = self.world.memory()
        self.world.next_session(self.new_station())
        for subject in self.subjects:
            subject.seen = subject.proved = None
            if subject.is_written:
                subject.changed(self.world.now)
        self.world.run(3.0)
        if self.is_known:
            self.world.machine.use_cached(now=self.world.now, **memory)

    @precondition(lambda self: not self.is_dead)
    @rule(is_over=st.sampled_from([False] * 20 + [True]))
    def the_vehicle_dies(self, is_over: bool) -> None:
        if not is_over:
            return
        self.changed()
        self.vehicle.reboot(self.world.now, down=math.inf)
        self.is_dead = True

    @precondition(lambda self: self.is_known)
    @rule(change_silently=st.sampled_from(["", "value", "group", "reboot"]))
    def all_is_calm_for_a_while(self, change_silently: str) -> None:
        """The link is good and nothing changes: after one interval, a table that is kept up is the vehicle's.

        That goes for a change of which nothing was received too.
        """
        self.become_calm()
        self.kept_up_is_true()
        if change_silently and not self.is_dead:
            self.changed()
            if change_silently == "value":
                self.vehicle.set_param(INTEGERS[0], 777)
            elif change_silently == "group":
                self.toggle()
            else:
                self.vehicle.reboot(self.world.now)
            self.stay_silent(0.5)
            self.become_calm()
            self.kept_up_is_true()

    # what must hold

    @invariant()
    def what_ended_is_right(self) -> None:
        for begun in [each for each in getattr(self, "open", []) if each.operation.done]:
            self.open.remove(begun)
            self.check(begun)
            machine = self.machine_of(begun.subject)
            if isinstance(begun.operation, Fetch):
                machine.end_fetch(begun.operation, self.world.now)
            elif isinstance(begun.operation, ValueRead):
                machine.reads.release(begun.operation)
            elif isinstance(begun.operation, WriteBatch):
                machine.write_batches.end(begun.operation, self.world.now)

    @invariant()
    def synced_is_true(self) -> None:
        """A table that calls itself synced is right, unless a change of it can have been lost.

        That it cannot where the link loses nothing, and not for as long as nothing changes after a download.
        """
        for subject in getattr(self, "subjects", []):
            if self.is_received(subject):
                self.look(subject)
        if hasattr(self, "world"):
            self.looked_at = self.world.now

    @invariant()
    def memory_is_bounded(self) -> None:
        if not self.is_known:
            return
        mine = len(self.open)
        batches = sum(isinstance(begun.operation, WriteBatch) for begun in self.open)
        most = len(self.names) + 10
        for machine in self.world.station.components.values():
            assert len(machine.reads) <= REQUESTED_INDICES_MAX + mine + 3 * most
            assert len(machine.writes) <= mine + batches * WRITES_IN_FLIGHT_MAX
            assert len(machine.write_batches) <= batches
            assert len(machine.table.params) <= most
            assert len(machine.table.dirty) <= most
            assert len(machine.sync._changed_names) <= most
            assert len(machine._authors._changed_at) <= most
            assert len(machine._authors._doubts) <= most
        known = {subject.address for subject in self.subjects} | {
            (other.system, other.component) for other in self.world.air.others
        }
        assert self.world.station.components.keys() <= known

    def teardown(self) -> None:
        if not hasattr(self, "world"):
            return
        self.become_calm()
        for begun in self.open:
            assert begun.operation.done, f"{begun.operation!r} has not ended"
        self.what_ended_is_right()
        self.synced_is_true()
        self.kept_up_is_true()
        for subject in self.subjects:
            if self.is_received(subject):
                self.the_end_of(subject)
        self.requests_end()

    def the_end_of(self, subject: Subject) -> None:
        machine = self.machine_of(subject)
        assert len(machine.reads) == 0
        assert len(machine.writes) == 0
        assert len(machine.write_batches) == 0
        assert machine.fetch is None
        if self.sync_settings.policy is Policy.AUTO and not (self.is_dead and subject is self.subject):
            fetch = machine.begin_fetch(self.world.now, refresh=True)
            result = self.world.outcome(fetch, LIMIT)
            machine.end_fetch(fetch, self.world.now)
            dead = self.misfortunes.dead if subject is self.subject else frozenset()
            silent = {index for index in dead if index < result.count}
            assert set(result.missing) == (set() if result.source == "ftp" else silent), "a file has them all"
            self.compare(subject, result)

    def requests_end(self) -> None:
        world = self.world
        if self.sync_settings.interval == math.inf:
            world.run(SETTLING)
            world.sent.clear()
            world.run(2 * SETTLING)
            # beside frames for another station the numbers may look begun anew: then the clock is requested
            allowed = {messages.Heartbeat, messages.CommandLong} if world.air.others else {messages.Heartbeat}
            assert {type(message) for _, message in world.sent} <= allowed

    # tools

    def new_station(self) -> Station:
        return Station(link="sim:test", is_stream=False, sync_settings=self.sync_settings)

    @property
    def is_known(self) -> bool:
        return hasattr(self, "world") and self.is_received(self.subject)

    def is_received(self, subject: Subject) -> bool:
        return subject.address in self.world.station.components

    def machine_of(self, subject: Subject) -> ComponentMachine:
        return self.world.station.components[subject.address]

    def pick(self, of_camera: bool) -> Subject:
        last = self.subjects[-1]
        return last if of_camera and self.is_received(last) else self.subject

    def is_never_good(self, link: Link) -> bool:
        return link["loss"] > 0 or link["rate"] is not None

    def become(self, link: Link) -> None:
        """The link is another from now on; what is on its way arrives."""
        self.is_bad |= self.is_never_good(link)
        self.may_overtake |= link["reorder"] > 0 or link["duplicate"] > 0
        for way in (self.world.air.uplink, self.world.air.downlink):
            FaultyLink(**link)  # such a link can be
            for what, value in link.items():
                setattr(way, f"_{what}", value)

    def stay_silent(self, seconds: float) -> None:
        self.is_bad = True
        air = self.world.air
        before = air.uplink._loss, air.downlink._loss
        air.uplink._loss = air.downlink._loss = 1.0
        self.world.run(seconds)
        air.uplink._loss, air.downlink._loss = before

    def fetch_all_there_is(self) -> None:
        subjects = [subject for subject in self.subjects if self.is_received(subject)]
        machines = [self.machine_of(subject) for subject in subjects]
        if any(machine.presence.is_lost for machine in machines):
            return
        for subject, fetch in zip(
            subjects, self.world.station.begin_fetches(machines, self.world.now), strict=True
        ):
            self.begun(subject, fetch)
        self.world.run(SETTLING)

    def become_calm(self) -> None:
        """The link is good and nothing changes any more; all ends, and one sync interval passes."""
        world = self.world
        self.become(GOOD)
        self.vehicle.high_latency = False
        self.vehicle._when_listed.clear()
        world.until(lambda: not world.station.is_waiting, LIMIT)
        world.run(max(0.0, self.back_at - world.now) + 2 * SETTLING)
        world.until(lambda: not world.station.is_waiting, LIMIT)
        if self.sync_settings.interval < math.inf:
            world.run(self.sync_settings.interval + LOOK)
            world.until(lambda: not world.station.is_waiting, LIMIT)

    def another_sends(self, message: messages.Message, is_received: bool) -> None:
        world = self.world
        data = messages.encode(message, system=253, component=190, sequence=0)
        world.air.receive(data, world.now)
        if is_received:
            world.air.downlink.send(data, world.now)
        world.exchange()

    def toggle(self) -> None:
        self.vehicle.set_param(SWITCH, 1 - min(int(self.vehicle.param(SWITCH).bits), 1))

    def changed(self) -> None:
        self.subject.changed(self.world.now)
        self.subject.acts += 1

    def begin(
        self,
        subject: Subject,
        call: Callable[[], Read | Write | WriteBatch | Fetch],
        *,
        acts: int | None = None,
        pairs: Sequence[tuple[str, int]] = (),
    ) -> None:
        """Begin something; of a component that is lost, nothing can be requested."""
        try:
            operation = call()
        except NoReply:
            assert self.machine_of(subject).presence.is_lost
            return
        self.begun(subject, operation, acts=acts, pairs=pairs)
        self.world.exchange()

    def begun(
        self,
        subject: Subject,
        operation: Read | Write | WriteBatch | Fetch,
        *,
        acts: int | None = None,
        pairs: Sequence[tuple[str, int]] = (),
    ) -> None:
        settled_at = max(subject.changed_at, self.back_at) + SETTLING
        is_moving = self.world.now < settled_at or len(self.machine_of(subject).writes)
        changes = None if is_moving else subject.changes
        begun = Begun(operation, subject, changes, acts, pairs)  # type: ignore[arg-type]  # only its end counts
        self.open.append(begun)

    def cancel_one(self, begun: Begun) -> None:
        machine = self.machine_of(begun.subject)
        operation = begun.operation
        if isinstance(operation, Write):
            machine.writes.cancel(operation, self.world.now)
            begun.subject.changed(self.world.now)
            begun.subject.acts += 1
        elif isinstance(operation, WriteBatch):
            machine.write_batches.end(operation, self.world.now)
            begun.subject.changed(self.world.now)
            begun.subject.acts += 1
        elif isinstance(operation, Fetch):
            machine.end_fetch(operation, self.world.now)
        elif isinstance(operation, ValueRead):
            machine.reads.release(operation)

    def check(self, begun: Begun) -> None:
        operation = begun.operation
        if operation.error is not None:
            assert isinstance(operation.error, ParamClientError)
            is_plain = self.misfortunes.is_plain and not self.is_bad and not self.subject.changes
            assert not (is_plain and isinstance(operation.error, NoReply)), operation.error
        elif isinstance(operation, Fetch) and operation.result is not None:
            result = operation.result
            is_moving = begun.changes != begun.subject.changes
            if result.complete and not is_moving and (result.source == "stream" or result.hash is not None):
                self.compare(begun.subject, result)

        elif isinstance(operation, WriteBatch) and operation.result is not None:
            self.check_batch(begun, operation.result)

    def check_batch(self, begun: Begun, outcomes: Sequence[SetOutcome]) -> None:
        """Each value has an outcome; what is set is what the vehicle has, unless it was changed since."""
        assert [(each.name, each.requested) for each in outcomes] == [*begun.pairs]
        vehicle = begun.subject.vehicle
        is_undisturbed = begun.acts == begun.subject.acts
        last = {each.name: each for each in outcomes}
        for each in outcomes:
            assert (each.error is None) == (each.result is not None) == each.is_set
            assert each.name != "NOT_THERE" or not each.is_set
        if is_undisturbed and not self.may_overtake and not vehicle.high_latency:
            later_unknown = {each.name for each in outcomes if each.status is SetStatus.UNKNOWN}
            for name, each in last.items():
                if each.result is not None and name not in later_unknown:
                    assert vehicle.values.get(name, each.result.actual) == each.result.actual, name
            if self.misfortunes.is_plain and not self.is_bad:
                assert not {each.status for each in outcomes} & {SetStatus.UNKNOWN, SetStatus.NOT_TRIED}

    def look(self, subject: Subject) -> None:
        machine = self.machine_of(subject)
        is_written = len(machine.writes) > 0
        if is_written or subject.is_written:
            subject.changed(self.world.now)
        subject.is_written = is_written
        result = machine.fetches.last
        if result is not None and result is not subject.seen:
            subject.seen = result
            began = self.looked_at - result.elapsed  # or later
            is_settled = began - max(subject.changed_at, self.back_at) > SETTLING
            if result.source == "stream" and result.complete and is_settled:
                subject.proved = subject.changes
        if machine.sync.synced and subject.proved == subject.changes:
            self.compare_table(subject, machine.table.params)
        # where nothing is lost, all that was pushed has arrived; the generic vehicle pushes nothing
        reports = subject is not self.subject or not isinstance(subject.vehicle, GenericVehicle)
        is_settled = self.world.now - max(subject.changed_at, self.back_at) > SETTLING
        if machine.sync.synced and not self.is_bad and reports and is_settled:
            self.compare_table(subject, machine.table.params)

    def kept_up_is_true(self) -> None:
        """Tables that are followed without requests are the vehicles' by now."""
        sync_settings = self.sync_settings
        if sync_settings.interval == math.inf or sync_settings.policy is not Policy.AUTO:
            return
        for subject in self.subjects:
            if not self.is_received(subject) or (
                subject is self.subject and (self.is_dead or self.is_incomplete)
            ):
                continue
            machine = self.machine_of(subject)
            is_looked_after = machine.sync.expects_hash or sync_settings.without_hash
            if machine.sync._was_synced and is_looked_after and not machine.sync.must_not_poll:
                assert machine.sync.synced, machine
                self.compare_table(subject, machine.table.params, is_volatile_old=machine.sync.expects_hash)

    @property
    def is_incomplete(self) -> bool:
        """Whether the vehicle has what cannot be in a table."""
        vehicle = self.vehicle
        return len(vehicle.params) < len(vehicle.listed) or any(
            index < len(vehicle.listed) for index in self.misfortunes.dead
        )

    def compare(self, subject: Subject, result: FetchResult) -> None:
        """Nothing has changed for a while: then what was fetched is what the vehicle has."""
        vehicle = subject.vehicle
        assert result.count == len(vehicle.listed)
        self.compare_table(subject, result.params, is_volatile_old=result.source == "cache")
        if isinstance(vehicle, PX4Vehicle) and result.hash is not None:
            assert result.hash == vehicle.announced_hash()

    def compare_table(self, subject: Subject, params: object, *, is_volatile_old: bool = False) -> None:
        assert isinstance(params, Mapping)
        vehicle = subject.vehicle
        true = vehicle.values
        held: dict[str, Param] = {name: param for name, param in params.items() if param.index is not None}
        skipped: set[str] = set()
        if subject is self.subject and self.is_incomplete:
            listed = vehicle.listed
            skipped = {listed[index].name for index in self.misfortunes.dead if index < len(listed)}
            skipped |= held.keys() - true.keys()
        assert held.keys() - skipped == true.keys() - skipped
        for name in held.keys() - skipped:
            if not (is_volatile_old and vehicle._entry(name).volatile):
                assert held[name].value == true[name], name
            assert held[name].index == vehicle.param(name).index, name
        assert HASH_CHECK not in params


SETTINGS = settings(
    max_examples=40,
    stateful_step_count=20,
    derandomize=True,
    deadline=None,
    print_blob=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
)
"""How many sessions each run of the tests has, and how long they are; `make soak` has more."""

TestSessions = Sessions.TestCase
TestSessions.settings = SETTINGS
