"""The checks, in the order in which they are made, and what each works with."""

from __future__ import annotations

import statistics
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeVar

import anyio

from paramclient import Component, FetchResult, ParamClient
from paramclient.errors import Refused, UnknownParameter, UsageError, ValueNotApplied
from paramclient.model.paramset import ParamSet
from paramclient.model.values import ParamType
from paramclient.protocol.commands import SAVING_TIME
from paramclient.provision import ApplyStatus, restore
from tests.live.choice import Choice, another_value
from tests.live.journal import Journal
from tests.live.relay import CLEAN, Conditions, Relay

T = TypeVar("T")

DISCOVERY_TIMEOUT: Final = 15.0
"""Seconds to wait for the vehicle's heartbeat at the beginning of a check."""
NAMES_SHOWN: Final = 5
"""Names that a failure lists at most."""
NO_SUCH_NAME: Final = "NO_SUCH_PARAM"
RESTORED: Final = 5
"""Parameters that are changed before an earlier state is brought back."""
READS: Final = 10
"""Single reads of which the median counts."""
SEEN_TIMEOUT: Final = 3.0
"""Seconds in which another session has to learn of a change."""
RADIO_RATE: Final = 5760.0
"""Bytes per second at 57600 baud."""
SLOWEST_FETCH: Final = 240.0
"""Seconds after which a fetch over a bad link is given up."""
NOTICING_TIME: Final = 6.0
"""Seconds after a restart in which it shows, and in which it could show a second time."""


class CheckFailed(Exception):
    """The client or the vehicle did something else than the documentation says."""


class Skip(Exception):
    """The check cannot be made on this vehicle or link; the text says why."""


@dataclass(frozen=True)
class Check:
    """One row of the table.

    Attributes:
        name: what is checked.
        run: does it, and returns what it has found, as it stands in the table.
        promise: what the documentation promises, in words.
        writes: whether it changes parameters, which an armed vehicle or `--read-only` forbids.
        kinds: the autopilots for which it has a meaning; None for all.
    """

    name: str
    run: Callable[[Session], Awaitable[str]]
    promise: str = ""
    writes: bool = False
    kinds: tuple[str, ...] | None = None


@dataclass
class Session:
    """One run of the suite on one vehicle.

    Attributes:
        relay: between the clients and the vehicle.
        folder: for the caches of this run.
        journal: the state before, and what was changed.
        system: the vehicle's system id.
        kind: "px4", "ardupilot" or another word of `Component.autopilot`.
        second_link: another link to the same vehicle, for the check of two sessions, or None.
        choice: the parameters that may be changed.
    """

    relay: Relay
    folder: Path
    journal: Journal
    system: int
    kind: str
    second_link: str | None
    choice: Choice

    @asynccontextmanager
    async def client(self, *, link: str | None = None, **options: Any) -> AsyncIterator[Component]:
        """Open a client behind the relay, without a cache unless one is given, and find the vehicle."""
        async with ParamClient(link or self.relay.link, **{"cache": False} | options) as client:
            yield await client.component(self.system, timeout=DISCOVERY_TIMEOUT)

    @asynccontextmanager
    async def two_clients(self) -> AsyncIterator[tuple[Component, Component]]:
        """Open two: the second on the second link where there is one, else behind the same relay."""
        async with self.client() as first, self.client(link=self.second_link, component=191) as second:
            yield first, second

    @contextmanager
    def under(self, conditions: Conditions) -> Iterator[None]:
        """Let the relay have these conditions, and none afterwards."""
        self.relay.change(conditions)
        try:
            yield
        finally:
            self.relay.change(CLEAN)

    async def fetch(self, vehicle: Component, *, refresh: bool = False) -> str:
        """Fetch everything, and check that each value is the vehicle's."""
        result = await vehicle.fetch_all(refresh=refresh, timeout=SLOWEST_FETCH)
        await self.check_fetched(vehicle, result)
        way = {"ftp": "by file", "stream": "by list", "cache": "from the cache"}[result.source]
        return f"{result.received} in {result.elapsed:.2f} s {way}"

    async def check_fetched(self, vehicle: Component, result: FetchResult) -> None:
        """Raise CheckFailed unless a fetch has brought every parameter with the vehicle's value.

        A value that differs from the state before is read again: it counts if the vehicle confirms it, since
        some values change by themselves.
        """
        if not result.complete:
            raise CheckFailed(f"{len(result.missing)} parameters are missing: {first(result.missing)}")
        before, journal = self.journal.before, self.journal
        listed = {name: param for name, param in result.params.items() if param.index is not None}
        moved = sorted(listed.keys() ^ before.keys())
        if moved := [name for name in moved if not journal.appears_and_disappears(name)]:
            raise CheckFailed(f"{len(moved)} names appeared or disappeared: {first(moved)}")
        wrong: list[str] = []
        for name, param in listed.items():
            if name in before and not before[name].same_value(param):
                if (held := await vehicle.get(name)).same_value(param):
                    before[name] = param
                elif not journal.moves_by_itself(name):
                    wrong.append(f"{param} (the vehicle holds {held.value!r})")
        if wrong:
            raise CheckFailed(f"{len(wrong)} wrong values: {first(wrong)}")

    async def put_back(self, vehicle: Component) -> None:
        """Put back what a check has changed. What fails here is tried again at the end of the suite."""
        if problems := await self.journal.put_back(vehicle):
            raise CheckFailed("; ".join(problems))

    def harmless(self, *types: ParamType) -> str:
        """Return a parameter of one of these types, or of any, that may be changed."""
        by_type = self.choice.by_type
        if not (names := [by_type[each] for each in types or by_type if each in by_type]):
            raise Skip(f"no harmless parameter {' or '.join(each.name for each in types)}".rstrip())
        return names[0]


def first(words: Any) -> str:
    """Return the first of some words."""
    return ", ".join(map(str, words[:NAMES_SHOWN]))


CHECKS: list[Check] = []


def check(
    name: str, promise: str, *, writes: bool = False, kinds: tuple[str, ...] | None = None, **options: Any
) -> Callable[[T], T]:
    """Make a check of a function that takes the session, and these options."""

    def add(function: T) -> T:
        assert callable(function)
        CHECKS.append(Check(name, partial(function, **options), promise, writes, kinds))
        return function

    return add


def checks(*, reboots: bool) -> Iterator[Check]:
    """Give every check in order.

    Args:
        reboots: whether the vehicle is restarted too.
    """
    return (each for each in CHECKS if reboots or each.name != "reboot")


@check("fetch, nothing known", "every value right")
async def fetch_cold(session: Session) -> str:
    async with session.client() as vehicle:
        return await session.fetch(vehicle)


@check("fetch in a new session, cached", "PX4: confirmed by its hash, nothing downloaded")
async def fetch_warm(session: Session) -> str:
    cache = session.folder / "warm.sqlite3"
    async with session.client(cache=cache) as vehicle:
        await session.fetch(vehicle)
    async with session.client(cache=cache) as vehicle:
        return await session.fetch(vehicle)


@check("get by index", "the value in the table", by_name=False)
@check("get by name", "the value in the table", by_name=True)
async def get_some(session: Session, *, by_name: bool) -> str:
    listed = [param for param in session.journal.before.values() if param.index is not None]
    seconds: list[float] = []
    async with session.client() as vehicle:
        for param in listed[:: max(1, len(listed) // READS)][:READS]:
            assert param.index is not None
            began = time.monotonic()
            held = await vehicle.get(param.name if by_name else param.index)
            seconds.append(time.monotonic() - began)
            is_right = held.same_value(param) or session.journal.moves_by_itself(param.name)
            if held.name != param.name or not is_right:
                raise CheckFailed(f"{param} was received as {held}")
    middle = statistics.median(seconds)
    return f"{middle * 1000:.0f} ms, slowest of {len(seconds)} {max(seconds) * 1000:.0f} ms"


@check("get of an unknown name", "UnknownParameter")
async def get_unknown(session: Session) -> str:
    async with session.client() as vehicle:
        await vehicle.get(0)  # what follows is not about who the vehicle is
        began = time.monotonic()
        try:
            held = await vehicle.get(NO_SUCH_NAME)
        except UnknownParameter:
            return f"UnknownParameter after {time.monotonic() - began:.2f} s"
    raise CheckFailed(f"no error, but {held}")


async def set_one(session: Session, *, kind: ParamType) -> str:
    name = session.harmless(kind)
    async with session.client() as vehicle:
        param = await vehicle.get(name)
        value = another_value(param)
        began = time.monotonic()
        done = await session.journal.set(vehicle, name, value)
        seconds = time.monotonic() - began
        held = await vehicle.get(name)
        await session.put_back(vehicle)
    if done.adjusted or held.value != value:
        raise CheckFailed(f"{name} set to {value} is {held.value!r}, {done.status}")
    return f"{name} {param.value!r} to {value} in {seconds * 1000:.0f} ms"


for each_type in (ParamType.INT8, ParamType.INT16, ParamType.INT32, ParamType.REAL32):
    check(f"set, {each_type.name}", "accepted, and read back", writes=True, kind=each_type)(set_one)


@check(
    "set, a fraction for an integer",
    "ArduPilot: adjusted; PX4: UsageError, nothing sent",
    writes=True,
    kinds=("ardupilot", "px4"),
)
async def set_fraction(session: Session) -> str:
    name = session.harmless(ParamType.INT16, ParamType.INT32)
    async with session.client() as vehicle:
        param = await vehicle.get(name)
        wanted = another_value(param) + 0.7
        try:
            done = await session.journal.set(vehicle, name, wanted)
        except UsageError as error:
            held = await vehicle.get(name)
            if session.kind != "px4" or not held.same_value(param):
                raise CheckFailed(f"{name} to {wanted}: {error}; it is {held.value!r}") from error
            return f"{name} to {wanted}: UsageError"
        finally:
            await session.put_back(vehicle)
    if session.kind == "px4" or not done.adjusted or done.actual != int(wanted):
        raise CheckFailed(f"{name} set to {wanted} is {done.actual!r}, {done.status}")
    return f"{name} to {wanted} is adjusted to {done.actual!r}"


@check("set, refused", "Refused with the reason", writes=True, kinds=("ardupilot",))
async def set_refused(session: Session) -> str:
    if (name := session.choice.read_only) is None:
        raise Skip("no parameter is known that the vehicle would refuse to change")
    async with session.client() as vehicle:
        param = await vehicle.get(name)
        began = time.monotonic()
        try:
            await session.journal.set(vehicle, name, another_value(param))
        except Refused as error:
            return f"{name}: {error.reason} after {time.monotonic() - began:.2f} s"
        except ValueNotApplied as error:
            raise CheckFailed(f"{name}: {error}") from error
        finally:
            await session.put_back(vehicle)
    raise Skip(f"this firmware lets {name} be changed")


@check("30 sets at once", "each accepted, and read back", writes=True)
async def set_many(session: Session, *, number: int = 30) -> str:
    """Set parameters side by side, read them back, and put them back."""
    if not (names := session.choice.many[:number]):
        raise Skip("no harmless parameters")
    wanted = {name: another_value(session.journal.before[name]) for name in names}
    async with session.client() as vehicle:
        began = time.monotonic()
        async with anyio.create_task_group() as tasks:
            for name, value in wanted.items():
                tasks.start_soon(session.journal.set, vehicle, name, value)
        seconds = time.monotonic() - began
        wrong = [str(held) for name in names if (held := await vehicle.get(name)).value != wanted[name]]
        await session.put_back(vehicle)
    if wrong:
        raise CheckFailed(f"{len(wrong)} of {len(names)} have another value: {first(wrong)}")
    return f"{len(names)} in {seconds:.2f} s"


@check(
    "a group shown and hidden",
    "its members appear and disappear with the switch",
    writes=True,
    kinds=("ardupilot",),
)
async def show_group(session: Session) -> str:
    async with session.client() as vehicle:
        whole = await vehicle.fetch_all(timeout=SLOWEST_FETCH)
        for switch in session.choice.groups:
            await session.journal.set(vehicle, switch, 1)
            shown = await vehicle.fetch_all(refresh=True, timeout=SLOWEST_FETCH)
            await session.put_back(vehicle)
            if members := shown.params.keys() - whole.params.keys():
                hidden = await vehicle.fetch_all(refresh=True, timeout=SLOWEST_FETCH)
                counts = [whole.count, shown.count, hidden.count]
                if counts != [counts[0], counts[0] + len(members), counts[0]]:
                    raise CheckFailed(f"{switch} shows {len(members)}, and the vehicle counts {counts}")
                await session.check_fetched(vehicle, hidden)
                return f"{switch}: {', '.join(map(str, counts))} parameters"
    raise Skip(f"none of these shows a group: {', '.join(session.choice.groups) or 'no switch is off'}")


@check(
    "restore, the state before",
    "complete, without what the vehicle measures",
    writes=True,
    kinds=("ardupilot", "px4"),
)
async def restore_before(session: Session) -> str:
    if not (names := session.choice.many[:RESTORED]):
        raise Skip("no harmless parameters")
    async with session.client() as vehicle:
        await vehicle.fetch_all(timeout=SLOWEST_FETCH)
        state = ParamSet(session.journal.before, component=vehicle.component, identity=vehicle.identity)
        for name in names:
            await session.journal.set(vehicle, name, another_value(session.journal.before[name]))
        done = await restore(vehicle, state)
        left_out = [row.name for row in done.shown_rows if row.status is ApplyStatus.SKIPPED]
        await session.put_back(vehicle)
    if not done.complete or any(done.rows[name].status is not ApplyStatus.ACCEPTED for name in names):
        raise CheckFailed(f"{done}: {first(done.shown_rows)}")
    reported = f", left out {', '.join(left_out)}" if left_out else ""
    return f"{done.counts[ApplyStatus.ACCEPTED]} set in {done.elapsed:.2f} s{reported}"


@check("two sessions, fetch at the same time", "every value right in both")
async def fetch_in_two(session: Session) -> str:
    results: list[str] = []

    async def fetch_in(vehicle: Component) -> None:
        results.append(await session.fetch(vehicle))

    async with session.two_clients() as both, anyio.create_task_group() as tasks:
        for vehicle in both:
            tasks.start_soon(fetch_in, vehicle)
    return " and ".join(results)


@check("two sessions, a change in one", "the other one receives it", writes=True)
async def see_change(session: Session) -> str:
    name = session.harmless()
    async with session.two_clients() as (one, other):
        value = another_value(await one.get(name))
        await other.get(name)
        changes = other.changes()
        began = time.monotonic()
        await session.journal.set(one, name, value)
        with anyio.move_on_after(SEEN_TIMEOUT) as waiting:
            async for change in changes:
                if change.name == name and change.new is not None and change.new.value == value:
                    break
        seconds = time.monotonic() - began
        await session.put_back(one)
    if waiting.cancelled_caught:
        raise CheckFailed(f"the other session has not heard of {name} in {SEEN_TIMEOUT:.0f} s")
    return f"after {seconds * 1000:.0f} ms"


# Behind a bad link


async def under(
    session: Session, *, conditions: Conditions, work: Callable[[Session], Awaitable[str]]
) -> str:
    with session.under(conditions):
        return await work(session)


def lossy(name: str, work: Any = fetch_cold, *, kinds: Any = None, **conditions: Any) -> None:
    """Make a check under these conditions."""
    is_fetch = work is fetch_cold
    promise = "every value right" if is_fetch else "each accepted, and read back"
    given = Conditions(**{"seed": 1} | conditions)
    check(name, promise, writes=not is_fetch, kinds=kinds, conditions=given, work=work)(under)


for loss in (0.0, 0.05, 0.20):
    for trip in (0.02, 0.1):
        lossy(f"fetch, {loss:.0%} loss, {trip * 1000:.0f} ms", loss=loss, round_trip=trip)
for loss in (0.05, 0.20):
    by_list: Any = {"refuses_files": True, "kinds": ("ardupilot",)}
    lossy(f"fetch by list, {loss:.0%} loss, 100 ms", loss=loss, round_trip=0.1, **by_list)
lossy("fetch, 57600 baud", rate=RADIO_RATE, drops_telemetry=True)
lossy("10 sets, 20% loss, 100 ms", partial(set_many, number=10), loss=0.2, round_trip=0.1, seed=2)


@check("reboot", "the same vehicle is back, with the value that was set; noticed once", writes=True)
async def reboot(session: Session) -> str:
    name = session.harmless()
    async with ParamClient(session.relay.link, cache=False) as client:
        vehicle = await client.component(session.system, timeout=DISCOVERY_TIMEOUT)
        value = another_value(await vehicle.get(name))
        await session.journal.set(vehicle, name, value)
        await anyio.sleep(SAVING_TIME)
        events = client.events()
        began = time.monotonic()
        vehicle = await vehicle.reboot()
        seconds = time.monotonic() - began
        held = await vehicle.get(name)
        noticed = 0
        with anyio.move_on_after(NOTICING_TIME):  # ArduPilot sends its clock late
            async for event in events:
                noticed += event.kind == "rebooted"
        await session.put_back(vehicle)
    if held.value != value:
        raise CheckFailed(f"{name} was set to {value} before the restart, and is {held.value!r}")
    if noticed != 1:
        raise CheckFailed(f"one restart was noticed {noticed} times")
    return f"back after {seconds:.1f} s, {name} is {value}"
