"""The checks, in the order in which they are made."""

from __future__ import annotations

import multiprocessing
import os
import statistics
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager
from functools import partial
from typing import Final

import anyio

from paramclient import (
    Component,
    FetchResult,
    ParamClient,
)
from paramclient.client.client import Events
from paramclient.errors import (
    ParamClientError,
    Refused,
    UnknownParameter,
    UsageError,
    ValueNotApplied,
)
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import ParamType
from paramclient.protocol.commands import SAVING_TIME
from paramclient.provision import ApplyStatus, apply, restore
from tests.live.choice import another_value
from tests.live.journal import check_disarmed
from tests.live.relay import Conditions
from tests.live.session import Check, CheckFailed, Session, Skip

__all__ = ["checks"]

NO_SUCH_NAME: Final = "NO_SUCH_PARAM"
RESTORED: Final = 5
"""Parameters that are changed before an earlier state is brought back."""
READS: Final = 10
"""Single reads of which the median counts."""
SEEN_TIMEOUT: Final = 3.0
"""Seconds in which another session has to learn of a change, and this one of a group."""
PARAMETER_FILE: Final = "@PARAM/param.pck"
RADIO_RATE: Final = 5760.0
"""Bytes per second at 57600 baud."""
SLOWEST_FETCH: Final = 240.0
"""Seconds after which a fetch over a bad link is given up."""
KILLED_WITHIN: Final = 20.0
"""Seconds for another program to open the parameter file and to be killed."""

NOTICING_TIME: Final = 6.0
"""Seconds after a restart in which it shows, and in which it could show a second time."""

spawn = multiprocessing.get_context("spawn")


def checks(*, reboots: bool) -> Iterator[Check]:
    """Give every check in order.

    Args:
        reboots: whether the vehicle is restarted too.
    """
    yield Check("fetch, nothing known", fetch_cold, "every value right")
    yield Check(
        "fetch in a new session, cached",
        fetch_warm,
        "PX4: confirmed by its hash, nothing downloaded",
    )
    yield Check("get by name", partial(get_some, by_name=True), "the value in the table")
    yield Check("get by index", partial(get_some, by_name=False), "the value in the table")
    yield Check("get of an unknown name", get_unknown, "UnknownParameter")
    for number in (ParamType.INT8, ParamType.INT16, ParamType.INT32, ParamType.REAL32):
        yield Check(
            f"set, {ParamType(number).name}",
            partial(set_one, number=number),
            "accepted, and read back",
            writes=True,
        )
    yield Check(
        "set, a fraction for an integer",
        set_fraction,
        "ArduPilot: adjusted; PX4: UsageError, nothing sent",
        writes=True,
        kinds=("ardupilot", "px4"),
    )
    yield Check("set, refused", set_refused, "Refused with the reason", writes=True, kinds=("ardupilot",))
    yield Check(
        "30 sets at once",
        set_many,
        "each accepted, and read back",
        writes=True,
    )
    yield Check(
        "a group shown and hidden",
        show_group,
        "its members appear and disappear with the switch",
        writes=True,
        kinds=("ardupilot",),
    )
    yield Check(
        "apply, a group that is hidden",
        apply_hidden,
        "the switch and its members in one run",
        writes=True,
        kinds=("ardupilot",),
    )
    yield Check(
        "restore, the state before",
        restore_before,
        "complete, without what the vehicle measures",
        writes=True,
        kinds=("ardupilot", "px4"),
    )
    yield Check(
        "fetch after a program was killed in a transfer",
        fetch_after_kill,
        "by list at once, or by file when the session has ended",
        kinds=("ardupilot",),
    )
    yield Check("two sessions, fetch at the same time", fetch_in_two, "every value right in both")
    yield Check(
        "two sessions, a change in one",
        see_change,
        "the other one receives it",
        writes=True,
    )
    yield from lossy_checks()
    if reboots:
        yield Check(
            "reboot",
            reboot,
            "the same vehicle is back, with the value that was set; noticed once",
            writes=True,
        )


def lossy_checks() -> Iterator[Check]:
    """Give the checks behind a bad link."""
    for loss in (0.0, 0.05, 0.20):
        for trip in (0.02, 0.1):
            conditions = Conditions(loss=loss, round_trip=trip, seed=1)
            name = f"fetch, {loss:.0%} loss, {trip * 1000:.0f} ms"
            yield Check(name, partial(fetch_under, conditions=conditions), "every value right")
    for loss in (0.05, 0.20):
        conditions = Conditions(loss=loss, round_trip=0.1, seed=1, refuses_files=True)
        yield Check(
            f"fetch by list, {loss:.0%} loss, 100 ms",
            partial(fetch_under, conditions=conditions),
            "every value right",
            kinds=("ardupilot",),
        )
    radio = Conditions(rate=RADIO_RATE, drops_telemetry=True)
    yield Check("fetch, 57600 baud", partial(fetch_under, conditions=radio), "every value right")
    worst = Conditions(loss=0.20, round_trip=0.1, seed=2)
    yield Check(
        "10 sets, 20% loss, 100 ms",
        partial(set_under, conditions=worst),
        "each accepted, and read back",
        writes=True,
    )


# Fetching


async def fetch_cold(session: Session) -> str:
    async with session.client() as vehicle:
        return await fetch(session, vehicle)


async def fetch_warm(session: Session) -> str:
    cache = session.folder / "warm.sqlite3"
    async with session.client(cache=cache) as vehicle:
        await fetch(session, vehicle)
    async with session.client(cache=cache) as vehicle:
        return await fetch(session, vehicle)


async def fetch(session: Session, vehicle: Component, *, refresh: bool = False) -> str:
    """Fetch everything, and compare it with the state before."""
    result = await vehicle.fetch_all(refresh=refresh, timeout=SLOWEST_FETCH)
    await session.check_fetched(vehicle, result)
    return reported(result)


def reported(result: FetchResult) -> str:
    way = {"ftp": "by file", "stream": "by list", "cache": "from the cache"}[result.source]
    return f"{result.received} in {result.elapsed:.2f} s {way}"


async def fetch_under(session: Session, *, conditions: Conditions) -> str:
    async with session.under(conditions), session.client() as vehicle:
        return await fetch(session, vehicle)


async def fetch_after_kill(session: Session) -> str:
    process = spawn.Process(target=_open_file_and_die, args=(session.relay.link, session.system))
    process.start()
    with anyio.move_on_after(KILLED_WITHIN):
        while process.is_alive():  # noqa: ASYNC110 - no event reports its end
            await anyio.sleep(0.02)
    has_opened = process.exitcode == 0
    process.kill()
    process.join()
    if not has_opened:
        raise Skip("the vehicle serves no parameter file")
    async with session.client() as vehicle:
        return await fetch(session, vehicle)


def _open_file_and_die(link: str, system: int) -> None:
    """Begin to read the parameter file, and end without closing it. Exit code 0 after its first bytes."""

    def die(received: int, size: int | None) -> None:
        if received:
            os._exit(0)

    async def read() -> None:
        async with ParamClient(link, cache=False, component=192) as client:
            vehicle = await client.component(system)
            await vehicle.read_file(PARAMETER_FILE, progress=die)

    try:
        anyio.run(read)
    finally:
        os._exit(1)


# Single reads


async def get_some(session: Session, *, by_name: bool) -> str:
    listed = [param for param in session.journal.before.values() if param.index is not None]
    chosen = listed[:: max(1, len(listed) // READS)][:READS]
    seconds: list[float] = []
    async with session.client() as vehicle:
        for param in chosen:
            assert param.index is not None
            began = time.monotonic()
            held = await vehicle.get(param.name if by_name else param.index)
            seconds.append(time.monotonic() - began)
            if held.name != param.name or not (
                held.same_value(param) or session.journal.moves_by_itself(param.name)
            ):
                raise CheckFailed(f"{param} was received as {held}")
    middle = statistics.median(seconds)
    return f"{middle * 1000:.0f} ms, slowest of {len(seconds)} {max(seconds) * 1000:.0f} ms"


async def get_unknown(session: Session) -> str:
    async with session.client() as vehicle:
        await vehicle.get(0)  # what follows is not about who the vehicle is
        return await expect(UnknownParameter, lambda: vehicle.get(NO_SUCH_NAME))


async def expect(error: type[ParamClientError], call: Callable[[], Awaitable[object]]) -> str:
    """Call, and see that it ends with this error."""
    began = time.monotonic()
    try:
        made = await call()
    except error as raised:
        seconds = time.monotonic() - began
        return f"{type(raised).__name__} after {seconds:.2f} s"
    raise CheckFailed(f"no error, but {made}")


# Single writes


async def set_one(session: Session, *, number: ParamType) -> str:
    name = session.choice.by_type.get(number)
    if name is None:
        raise Skip(f"no harmless parameter of type {ParamType(number).name}")
    async with session.client() as vehicle:
        param = await vehicle.get(name)
        value = another_value(param)
        began = time.monotonic()
        done = await session.journal.set(vehicle, name, value)
        seconds = time.monotonic() - began
        held = await vehicle.get(name)
        await put_back(session, vehicle)
    if done.adjusted or held.value != value:
        raise CheckFailed(f"{name} set to {value} is {held.value!r}, {done.status}")
    return f"{name} {param.value!r} to {value} in {seconds * 1000:.0f} ms"


async def set_fraction(session: Session) -> str:
    types = (ParamType.INT16, ParamType.INT32)
    name = next((session.choice.by_type[each] for each in types if each in session.choice.by_type), None)
    if name is None:
        raise Skip("no harmless integer parameter")
    async with session.client() as vehicle:
        param = await vehicle.get(name)
        assert isinstance(param.value, int)
        wanted = another_value(param) + 0.7
        try:
            done = await session.journal.set(vehicle, name, wanted)
        except UsageError as error:
            if session.kind != "px4":
                raise CheckFailed(f"{name} to {wanted}: {error}") from error
            held = await vehicle.get(name)
            if not held.same_value(param):
                raise CheckFailed(f"refused before it was sent, and yet {name} is {held.value!r}") from error
            return f"{name} to {wanted}: UsageError"
        finally:
            await put_back(session, vehicle)
    if session.kind == "px4" or not done.adjusted or done.actual != int(wanted):
        raise CheckFailed(f"{name} set to {wanted} is {done.actual!r}, {done.status}")
    return f"{name} to {wanted} is adjusted to {done.actual!r}"


async def set_refused(session: Session) -> str:
    name = session.choice.read_only
    if name is None:
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
            await put_back(session, vehicle)
    raise Skip(f"this firmware lets {name} be changed")


# Many writes


async def set_many(session: Session) -> str:
    async with session.client() as vehicle:
        await vehicle.fetch_all(timeout=SLOWEST_FETCH)
        return await set_all(session, vehicle, session.choice.many)


async def set_under(session: Session, *, conditions: Conditions) -> str:
    async with session.under(conditions), session.client() as vehicle:
        return await set_all(session, vehicle, session.choice.many[:10])


async def set_all(session: Session, vehicle: Component, names: tuple[str, ...]) -> str:
    """Set parameters side by side, read them back, and put them back."""
    if not names:
        raise Skip("no harmless parameters")
    wanted = {name: another_value(session.journal.before[name]) for name in names}
    began = time.monotonic()
    async with anyio.create_task_group() as tasks:
        for name, value in wanted.items():
            tasks.start_soon(session.journal.set, vehicle, name, value)
    seconds = time.monotonic() - began
    wrong = [str(held) for name in names if (held := await vehicle.get(name)).value != wanted[name]]
    await put_back(session, vehicle)
    if wrong:
        raise CheckFailed(f"{len(wrong)} of {len(names)} have another value: {', '.join(wrong[:5])}")
    return f"{len(names)} in {seconds:.2f} s"


async def show_group(session: Session) -> str:
    tried: list[str] = []
    async with session.client() as vehicle:
        whole = await vehicle.fetch_all(timeout=SLOWEST_FETCH)
        for switch in session.choice.groups:
            await session.journal.set(vehicle, switch, 1)
            shown = await vehicle.fetch_all(refresh=True, timeout=SLOWEST_FETCH)
            await put_back(session, vehicle)
            members = shown.params.keys() - whole.params.keys()
            if not members:
                tried.append(switch)
                continue
            hidden = await vehicle.fetch_all(refresh=True, timeout=SLOWEST_FETCH)
            if not (whole.count + len(members) == shown.count and hidden.count == whole.count):
                counts = f"{whole.count}, {shown.count}, {hidden.count}"
                raise CheckFailed(f"{switch} shows {len(members)}, and the vehicle counts {counts}")
            await session.check_fetched(vehicle, hidden)
            return f"{switch}: {whole.count}, {shown.count}, {hidden.count} parameters"
    raise Skip(f"none of these shows a group: {', '.join(tried)}" if tried else "no switch of a group is off")


# Apply and restore


async def apply_hidden(session: Session) -> str:
    async with session.client() as vehicle:
        whole = await vehicle.fetch_all(timeout=SLOWEST_FETCH)
        for switch in session.choice.groups:
            await session.journal.set(vehicle, switch, 1)
            shown = await vehicle.fetch_all(refresh=True, timeout=SLOWEST_FETCH)
            await put_back(session, vehicle)
            members = [shown.params[name] for name in shown.params.keys() - whole.params.keys()]
            floats = sorted(
                each.name for each in members if each.type == ParamType.REAL32 and not each.is_raw
            )
            if not floats:
                continue
            member = shown.params[floats[0]]
            session.journal.note({switch: whole.params[switch], member.name: member})
            await check_disarmed(vehicle)
            values = {switch: 1, member.name: another_value(member)}
            wanted = ParamSet({name: WrittenParam(name, value) for name, value in values.items()})
            done = await apply(vehicle, wanted)
            back = await restore(vehicle, done.before)
            await put_back(session, vehicle)
            for result in (done, back):
                if not result.complete or result.counts[ApplyStatus.ACCEPTED] != len(values):
                    raise CheckFailed(f"{result}: {'; '.join(map(str, result.shown_rows))}")
            return f"{switch} and {member.name} in {done.elapsed:.2f} s"
    raise Skip("no switch of a group with a float is off")


async def restore_before(session: Session) -> str:
    names = session.choice.many[:RESTORED]
    if not names:
        raise Skip("no harmless parameters")
    async with session.client() as vehicle:
        await vehicle.fetch_all(timeout=SLOWEST_FETCH)
        state = ParamSet(session.journal.before, component=vehicle.component, identity=vehicle.identity)
        for name in names:
            await session.journal.set(vehicle, name, another_value(session.journal.before[name]))
        done = await restore(vehicle, state)
        left_out = [row.name for row in done.shown_rows if row.status is ApplyStatus.SKIPPED]
        await put_back(session, vehicle)
    if not done.complete or any(done.rows[name].status is not ApplyStatus.ACCEPTED for name in names):
        raise CheckFailed(f"{done}: {'; '.join(map(str, done.shown_rows[:5]))}")
    reported = f", left out {', '.join(left_out)}" if left_out else ""
    return f"{done.counts[ApplyStatus.ACCEPTED]} set in {done.elapsed:.2f} s{reported}"


async def put_back(session: Session, vehicle: Component) -> None:
    """Put back what this check has changed. What fails here is tried again at the end of the suite."""
    if problems := await session.journal.put_back(vehicle):
        raise CheckFailed("; ".join(problems))


# Files


# Two sessions


async def fetch_in_two(session: Session) -> str:
    results: list[str] = []

    async def fetch_in(vehicle: Component) -> None:
        results.append(await fetch(session, vehicle))

    async with (
        session.client() as first,
        second_client(session) as second,
        anyio.create_task_group() as tasks,
    ):
        tasks.start_soon(fetch_in, first)
        tasks.start_soon(fetch_in, second)
    return " and ".join(results)


async def see_change(session: Session) -> str:
    name = next(iter(session.choice.by_type.values()), None)
    if name is None:
        raise Skip("no harmless parameter")
    async with session.client() as first, second_client(session) as second:
        known = await first.get(name)
        await second.get(name)
        changes = second.changes()
        value = another_value(known)
        began = time.monotonic()
        await session.journal.set(first, name, value)
        seen = False
        with anyio.move_on_after(SEEN_TIMEOUT):
            async for change in changes:
                if change.name == name and change.new is not None and change.new.value == value:
                    seen = True
                    break
        seconds = time.monotonic() - began
        await put_back(session, first)
    if not seen:
        raise CheckFailed(f"the other session has not heard of {name} in {SEEN_TIMEOUT:.0f} s")
    return f"after {seconds * 1000:.0f} ms"


@asynccontextmanager
async def second_client(session: Session) -> AsyncIterator[Component]:
    """Open another session: on the second link where there is one, else behind the same relay."""
    async with session.client(link=session.second_link or "", component=191) as vehicle:
        yield vehicle


# A restart


async def reboot(session: Session) -> str:
    name = next(iter(session.choice.by_type.values()), None)
    if name is None:
        raise Skip("no harmless parameter")
    async with session.client_with_events() as (vehicle, listen):
        value = another_value(await vehicle.get(name))
        await session.journal.set(vehicle, name, value)
        await anyio.sleep(SAVING_TIME)
        events = listen()
        began = time.monotonic()
        vehicle = await vehicle.reboot()
        seconds = time.monotonic() - began
        held = await vehicle.get(name)
        noticed = await count_reboots(events)
        await put_back(session, vehicle)
    if held.value != value:
        raise CheckFailed(f"{name} was set to {value} before the restart, and is {held.value!r}")
    if noticed != 1:
        raise CheckFailed(f"one restart was noticed {noticed} times")
    return f"back after {seconds:.1f} s, {name} is {value}"


async def count_reboots(events: Events) -> int:
    """Return how often a restart is noticed until 6 s after now: ArduPilot sends its clock late."""
    count = 0
    with anyio.move_on_after(NOTICING_TIME):
        async for event in events:
            count += event.kind == "rebooted"
    return count
