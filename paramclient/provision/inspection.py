"""See what a vehicle has of what is wanted, and what would have to be done; nothing is written."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Final, Self

import anyio

from paramclient.client.component import Component
from paramclient.client.local import local
from paramclient.errors import LinkError, NoReply, UsageError, VehicleError
from paramclient.model.params import copy_params
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import Param, ParamType, Trust, check_name
from paramclient.protocol.params.fetch_result import FetchResult
from paramclient.protocol.params.name_search import NameSearch
from paramclient.protocol.wire import HASH_CHECK
from paramclient.provision.cautions import cautions_for
from paramclient.provision.planning import ParamInfo, Plan, check_component, plan
from paramclient.provision.runner import Runner, run_here

__all__ = [
    "LOOKING_PACE",
    "Seen",
    "identified",
    "look",
    "look_again",
    "look_for",
    "plan_for",
    "prepare",
    "verify",
]

IDENTITY_PATIENCE: Final = 10.0
"""Seconds for a vehicle to say who it is. It is asked a few times, and mostly given up sooner."""
MOST_BESIDE: Final = 36
"""Names that are requested beside the table, at the most: two windows, 0.4 s of what ArduPilot answers."""
LOOKING_PACE: Final = 0.05
"""Seconds between two looks whether a vehicle has said something of itself."""
FIRST_READS: Final = 0.5
"""Seconds to allow for reads by name beside those that they take one after the other."""
READ_PACE: Final = 0.025
"""Seconds that one of many reads takes on a quick link: ArduPilot answers 49 per second (measured)."""
READ_SIZE: Final = 6.0
"""Bytes of a read and its answer, 73, over those of one parameter in ArduPilot's file, 13 (measured)."""


@dataclass(frozen=True, slots=True)
class Seen:
    """A vehicle's table, and what it has besides of what is wanted.

    Attributes:
        table: all of it, each value heard in this session or confirmed by the vehicle's hash.
        complete: whether these are all the parameters in its list.
        hash: the hash under which the vehicle has confirmed its list, or None.
        absent: names that it did not know, or would not tell, when it was asked.
        download_time: seconds that the download of the table has taken; 0 where there was none.
    """

    table: ParamSet
    complete: bool
    hash: int | None
    absent: frozenset[str]
    download_time: float

    def reads_are_quicker(self, count: int) -> bool:
        """Whether so many reads by name take less time than to look at the whole table again.

        Never with a hash, which confirms the table without a download.
        """
        if self.hash is not None:
            return False
        pace = max(READ_PACE, READ_SIZE * self.download_time / max(len(self.table), 1))
        return FIRST_READS + count * pace < self.download_time


async def look(
    component: Component,
    wanted: ParamSet,
    absent: frozenset[str] = frozenset(),
    *,
    whole: bool = False,
    run: Runner = run_here,
) -> Seen:
    """Bring the table up to date, and ask by name for what is wanted and not in it.

    Vehicles have parameters that are in no list: those that PX4 does not use yet, those of a group that
    ArduPilot hides. They can be read and set by name. So is asked what was heard earlier on this link and
    has not been told again: what the hash says nothing about, or an incomplete list has left out. What does
    not come then either counts as not there. Names that are probably hidden are requested beside the list.

    Args:
        component: the vehicle.
        wanted: what it is to have.
        absent: names that the vehicle is known not to have, unless they are in the list by now.
        whole: ask again for everything that has not been told again, not only for what is wanted.
        run: runs what takes long for a large table.

    Raises:
        NoReply: it did not answer.
        LinkError: the link failed, or the client was closed.
    """
    local(component).machine.sync.expire_hash()  # what was announced before may have moved
    before = copy_params(component.params)
    with _Search(component, _probably_hidden(component, wanted).difference(absent)) as search:
        fetched = await component.fetch_all()
        await component.refreshed()
        search.leave_out(component.params)
        await search.wait()
    shown, silent = search.result()
    after = copy_params(component.params)
    not_covered = frozenset(_not_covered(component, fetched))
    autopilot = component.autopilot

    def sort_out() -> tuple[dict[str, Param], bool, set[str], set[str], list[str]]:
        listed = {name: param for name, param in after.items() if param.index is not None}
        table = {name: param for name, param in listed.items() if param.trust is not Trust.CACHED}
        is_whole = fetched.complete and len(table) == len(listed)
        hidden = silent
        if is_whole and autopilot == "ardupilot":
            hidden = silent | _in_no_hidden_group(table, wanted).difference(after)
        missing = frozenset(fetched.missing)
        given_up = {name for name, param in table.items() if param.index in missing}
        heard = {name for name, param in before.items() if param.trust is Trust.LIVE}
        unsure = given_up | heard.intersection(table, not_covered)
        known = absent | hidden | shown.keys()
        asked = [name for name in wanted if name in unsure or (name not in table and name not in known)]
        if whole:
            asked += unsure.difference(asked)
        return table, is_whole, hidden, given_up, asked

    table, is_whole, silent, given_up, asked = await run(sort_out)
    asked_for, not_told = await _ask(component, asked, given_up)
    found, unknown = shown | asked_for, silent.difference(table) | not_told
    system, number, identity, at = component.system, component.component, component.identity, time.time()

    def take() -> ParamSet:
        return ParamSet.of(
            (param for name, param in (table | found).items() if name not in unknown),
            component=number,
            system=system,
            identity=identity,
            at=at,
            source=f"vehicle {system}/{number}",
        )

    return Seen(
        await run(take),
        is_whole,
        fetched.hash,
        (absent | unknown).difference(table),
        0.0 if fetched.source == "cache" else fetched.elapsed,
    )


async def look_for(component: Component, seen: Seen, names: Iterable[str]) -> Seen:
    """Ask by name for what may have appeared, and take what has been heard of the others meanwhile.

    Args:
        component: the vehicle.
        seen: what it had when it was looked at.
        names: param_ids.

    Raises:
        NoReply: it did not answer.
        LinkError: the link failed, or the client was closed.
    """
    found, unknown = await _ask(component, names, ())
    params = {**seen.table.params, **_heard(component, seen, found)}
    table = replace(seen.table, params=params, at=time.time())
    return replace(seen, table=table, absent=(seen.absent | unknown).difference(found))


async def look_again(component: Component, seen: Seen, names: Iterable[str]) -> Seen:
    """Read by name what the vehicle has, and take what has been heard of the others meanwhile.

    Args:
        component: the vehicle.
        seen: what it had when it was looked at.
        names: param_ids. One that the vehicle does not tell any more is not in the result.

    Raises:
        NoReply: it did not answer.
        LinkError: the link failed, or the client was closed.
    """
    names = frozenset(names)
    asked_at = anyio.current_time()
    found, unknown = await _ask(component, names, names)
    if names and not found:
        what = f"the values of {component.system}/{component.component}"
        raise NoReply(what, attempts=0, waited=anyio.current_time() - asked_at)
    params = {**seen.table.params, **_heard(component, seen, found)}
    told = {name: param for name, param in params.items() if name not in unknown}
    return replace(seen, table=replace(seen.table, params=told, at=time.time()))


async def identified(component: Component) -> None:
    """Wait until the vehicle has said who it is, or will not: what is stored goes under its name."""
    with anyio.move_on_after(IDENTITY_PATIENCE):
        vehicle = local(component)
        while vehicle.settled_identity is None:  # noqa: ASYNC110 - nobody tells
            await anyio.sleep(LOOKING_PACE)


async def prepare(
    component: Component,
    wanted: ParamSet,
    *,
    include: str | Iterable[str] = (),
    info: Mapping[str, ParamInfo] | None = None,
    force: bool = False,
    run: Runner = run_here,
) -> Plan:
    """Work out what `apply` would send to a vehicle, and in which order. Only reads.

    Args:
        component: the vehicle.
        wanted, include, info, force: as in `plan`.
        run: runs what takes long: a plan of thousands of parameters takes a second.

    Raises:
        UsageError: as from `plan`.
        NoReply: the vehicle did not answer.
        LinkError: the link failed, or the client was closed.
    """
    check_component(wanted, component.component)
    given = (include,) if isinstance(include, str) else tuple(include)
    autopilot = component.autopilot
    # what cannot be right is told before the vehicle is asked
    await run(lambda: plan({}, wanted, include=given, autopilot=autopilot))
    await identified(component)
    seen = await look(component, wanted, run=run)
    return await run(lambda: plan_for(component, seen.table, wanted, given, info, force=force))


async def verify(
    component: Component,
    wanted: ParamSet,
    *,
    include: str | Iterable[str] = (),
    info: Mapping[str, ParamInfo] | None = None,
    force: bool = False,
) -> Plan:
    """Compare a vehicle with what is wanted. Only reads.

    What comes of it is what `prepare` gives: `is_met` is the answer, and the rows that are to be *set* are
    those that differ.

    Args and errors as in `prepare`.
    """
    return await prepare(component, wanted, include=include, info=info, force=force)


def plan_for(
    component: Component,
    table: ParamSet,
    wanted: ParamSet,
    include: tuple[str, ...],
    info: Mapping[str, ParamInfo] | None,
    *,
    force: bool,
) -> Plan:
    """The plan for a vehicle that has this table."""
    return plan(
        table,
        wanted,
        include=include,
        info=info,
        autopilot=component.autopilot,
        encoding=component.encoding,
        force=force,
    )


def _heard(component: Component, seen: Seen, found: Mapping[str, Param]) -> dict[str, WrittenParam]:
    """What has been heard by now of the parameters that were seen before, and what was found."""
    heard = {name: component.params[name] for name in seen.table if name in component.params}
    return {name: WrittenParam.of(param) for name, param in (heard | dict(found)).items()}


def _not_covered(component: Component, fetched: FetchResult) -> Collection[str]:
    """The names of whose values a fetch says nothing, but for what is missing in it."""
    if fetched.source != "cache" and not fetched.resumed:
        return ()
    if fetched.hash is None:  # the policy allowed no more, or some of it came before
        return component.params.keys()
    return local(component).machine.table.unhashed()


async def _ask(
    component: Component, names: Iterable[str], given_up: Collection[str]
) -> tuple[dict[str, Param], frozenset[str]]:
    """Read parameters by name: those that are there, and those that the vehicle does not have or tell.

    Of `given_up`, which were asked for already, no answer is one; else it ends the asking.
    """
    names = tuple(names)
    with _Search(component, [name for name in names if name not in component.params]) as search:
        await search.wait()
    found, unknown = search.result()
    failed: list[NoReply | LinkError] = []

    async def ask(name: str) -> None:
        try:
            found[name] = await component.get(name)
        except (VehicleError, UsageError):  # a name that cannot be is not there either
            unknown.add(name)
        except (NoReply, LinkError) as error:
            if isinstance(error, NoReply) and name in given_up:
                unknown.add(name)
                return
            failed.append(error)
            asking.cancel_scope.cancel()

    async with anyio.create_task_group() as asking:
        for name in names:
            if name not in found and name not in unknown:
                asking.start_soon(ask, name)
    if failed:
        raise failed[0]
    return found, frozenset(unknown)


class _Search:
    """A search for parameters of which nothing has been heard, all at once, for as long as its block lasts.

    Args:
        component: the vehicle.
        names: what to search for; a name that cannot be one is left out.

    Raises:
        NoReply: the vehicle is lost, and there is something to search for.
    """

    def __init__(self, component: Component, names: Iterable[str]) -> None:
        self._component = local(component)
        self._spelled = {name: self._component.machine.spelling(name) for name in names if _is_name(name)}
        self._search: NameSearch | None = None

    def __enter__(self) -> Self:
        if self._spelled:
            self._search = self._component.machine.search(self._spelled.values(), anyio.current_time())
            self._component.wake()
        return self

    def __exit__(self, *exc: object) -> None:
        if self._search is not None:
            self._component.machine.name_searches.cancel(self._search, anyio.current_time())

    def leave_out(self, names: Iterable[str]) -> None:
        """Search no longer for these names, as the vehicle spells them."""
        if self._search is not None:
            self._search.leave_out(names)

    async def wait(self) -> None:
        """Wait until nothing is left to search for.

        Raises:
            NoReply: the vehicle is lost.
            LinkError: the link failed, or the client was closed.
        """
        if (search := self._search) is not None and search.open:
            await self._component.wait(search, None, lambda: ("names", search.attempts))

    def result(self) -> tuple[dict[str, Param], set[str]]:
        """What is there, and what is not.

        What is in neither needs to be asked for one by one: the link loses much, or the names cannot be.
        """
        found: dict[str, Param] = {}
        unknown: set[str] = set()
        for name, spelling in self._spelled.items():
            param = self._component.params.get(spelling)
            if param is not None and param.trust is Trust.LIVE:
                found[name] = param
            elif self._search is not None and spelling in self._search.unknown:
                unknown.add(name)
        return found, unknown


def _probably_hidden(component: Component, wanted: ParamSet) -> frozenset[str]:
    """Wanted members of groups whose switches are wanted on, where nothing is known of them yet.

    ArduPilot lists a group only while its switch is on. A name of them that is listed after all has been
    requested in vain, so there are none where they are many, nor where the table comes as a list, which reads
    slow down.
    """
    if component.autopilot != "ardupilot" or not local(component).machine.fetches.may_use_file():
        return frozenset()
    cautions = cautions_for("ardupilot")
    switches = {name for name, each in wanted.items() if cautions.reveals(name) and each.value != 0}
    groups = tuple(f"{name.rpartition('_')[0]}_" for name in switches)
    names = [name for name in wanted if name.startswith(groups) and name not in switches]
    unheard = frozenset(name for name in names if name not in component.params)
    return unheard if len(unheard) <= MOST_BESIDE else frozenset()


def _in_no_hidden_group(table: Mapping[str, Param], wanted: ParamSet) -> frozenset[str]:
    """Wanted names that an ArduPilot cannot have: neither its list nor a group that it hides has them.

    The list leaves out what follows the switch of a group, an INT8 that is listed, while that is 0; the
    names of the group begin alike (`AP_Param::next_group`). All else that can be read by name is in it.

    Args:
        table: the whole list.
        wanted: what to look for.
    """
    switches = [name for name, param in table.items() if param.type is ParamType.INT8 and param.value == 0]
    hidden = {start for name in switches for start in _starts(name)}
    return frozenset(name for name in wanted if name not in table and hidden.isdisjoint(_starts(name)))


def _starts(name: str) -> Iterator[str]:
    """Return what a name may have in common with those of its group: all up to each underscore."""
    return (name[: at + 1] for at, letter in enumerate(name) if letter == "_")


def _is_name(name: str) -> bool:
    """Whether a parameter can have this name."""
    with suppress(UsageError):
        return check_name(name) != HASH_CHECK
    return False
