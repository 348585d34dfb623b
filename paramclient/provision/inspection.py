"""Read what a vehicle has of the wanted parameters, and plan the changes: `plan`."""

from __future__ import annotations

from collections.abc import Collection, Container, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, Unpack
from weakref import WeakKeyDictionary

import anyio

from paramclient.client.component import Component
from paramclient.errors import LinkError, NoReply, UsageError, VehicleError
from paramclient.model.paramset import AnyParams, ParamSet, set_of
from paramclient.model.values import Param, ParamType, Trust, Value
from paramclient.provision.planning import Plan, Planner, PlanOptions, check_keys
from paramclient.provision.sources import component_set, part_set

READS_IN_PROGRESS_MAX: Final = 64
"""Reads by name that are in progress at once, each in a task. The component itself sends fewer at a time."""
IDENTITY_TIMEOUT: Final = 10.0
"""Seconds to wait for the identity of a vehicle. The identification usually ends sooner, after a few
requests."""
READ_OVERHEAD: Final = 0.5
"""Seconds that a group of reads by name takes in addition to the time per read."""
READ_INTERVAL: Final = 0.025
"""Seconds for one of many reads on a fast link: ArduPilot answers 49 per second (measured)."""
READ_SIZE_RATIO: Final = 6.0
"""Bytes of a read and its response, 73, over those of one parameter in ArduPilot's file, 13 (measured)."""
claims: Final = WeakKeyDictionary[Component, Value | None]()
"""The system ids that running calls of `apply` set, by vehicle."""


async def plan(component: Component, wanted: AnyParams, **options: Unpack[PlanOptions]) -> Plan:
    """Return what `apply` would write to a vehicle, and in which order. Only reads.

    The plan is `complete` if the vehicle has all wanted values.

    Args:
        component: the vehicle.
        wanted: the wanted parameters, or plain values by name.
        options: as in `PlanOptions`.

    Raises:
        UsageError: as from `plan_from`.
        NoReply: the vehicle did not answer.
        LinkError: the link failed, or the client was closed.
    """
    check_keys(options, PlanOptions)
    wanted = set_of(wanted, is_extended=component.is_extended)
    plan_for(component, wanted, None, options)
    await wait_for_identity(component)
    return plan_for(component, wanted, await inspect(component, wanted), options)


def plan_for(component: Component, wanted: ParamSet, found: Inspection | None, options: PlanOptions) -> Plan:
    """Return the plan for a vehicle; before it is read, only the errors of `plan_from` matter."""
    table = component_set(component, (), "") if found is None else found.table
    is_in_use, kind = partial(_is_system_in_use, component), component.autopilot
    return Planner(table, wanted, kind, component.encoding, options, is_in_use).plan()


def _is_system_in_use(component: Component, name: str, system: Value) -> bool:
    """Return whether another vehicle on the link has a system id, or gets it.

    It gets the id that its table has, at its next start, or that a running `apply` sets.

    Args:
        component: a component of the vehicle.
        name: the parameter with the system id.
        system: the id.
    """
    own, known = component.identity, component.client.components.values()
    others = [each for each in known if each.vehicle is not component.vehicle and each.state != "lost"]
    others = [each for each in others if not own.has_own_uid or each.identity.uid != own.uid]
    held = [param.settable for each in others if (param := each.params.get(name)) is not None]
    return system in [*held, *(each.system for each in others), *map(claims.get, others)]


async def wait_for_identity(component: Component) -> None:
    """Wait until the vehicle is identified, at most `IDENTITY_TIMEOUT`, as the cache key requires."""
    await component.wait_until_identified(IDENTITY_TIMEOUT)


@dataclass(frozen=True, slots=True)
class Inspection:
    """The state of a vehicle: its table and the wanted parameters that are not in its list.

    Attributes:
        table: the parameters, each received in this session or confirmed by the vehicle's hash.
        complete: whether `table` has all parameters of the vehicle's list.
        hash: the hash with which the vehicle confirmed its list, or None.
        absent: requested names that the vehicle does not have or did not answer.
        download_time: seconds that the download of the table took; 0 if there was none.
    """

    table: ParamSet
    complete: bool
    hash: int | None
    absent: frozenset[str]
    download_time: float

    def is_reading_faster(self, count: int) -> bool:
        """Return whether `count` reads by name are faster than another download of the table.

        False with a hash, which confirms the table without a download.
        """
        if self.hash is not None:
            return False
        pace = max(READ_INTERVAL, READ_SIZE_RATIO * self.download_time / max(len(self.table), 1))
        return READ_OVERHEAD + count * pace < self.download_time


async def inspect(component: Component, wanted: ParamSet, absent: frozenset[str] = frozenset()) -> Inspection:
    """Update the table, and read by name the wanted parameters that it does not have.

    Vehicles have parameters that are in no list: those that PX4 does not use yet, and those of a group that
    ArduPilot hides. They can be read and set by name. Values that were received earlier on this link and not
    confirmed since are read by name too: those that an incomplete list has left out. A parameter that is not
    received then either counts as absent.

    Args:
        component: the vehicle.
        wanted: the wanted parameters.
        absent: names that the vehicle is known not to have, unless they are listed by now.

    Raises:
        UsageError: the vehicle's integers contradict the encoding, so that none of them is known.
        NoReply: the vehicle did not answer.
        LinkError: the link failed, or the client was closed.
    """
    before = {name for name, param in component.params.items() if param.trust is Trust.LIVE}
    fetched = await component.fetch_all()
    if component.node.channel.is_lost:
        raise NoReply(f"the parameters of {component.node.channel}", attempts=0, waited=fetched.elapsed)
    if doubt := component.session.encoding_doubt:
        raise UsageError(doubt)
    params = dict(component.params)
    listed = {name: param for name, param in params.items() if param.index is not None}
    table = {name: param for name, param in listed.items() if param.trust is not Trust.CACHED}
    complete = fetched.complete and len(table) == len(listed)
    if complete and component.is_extended:  # the list has all of them
        absent |= frozenset(wanted).difference(params)
    elif complete and component.autopilot == "ardupilot":
        absent |= _in_no_hidden_group(table, wanted).difference(params)
    missing = frozenset(fetched.missing)
    given_up = {name for name, param in table.items() if param.index in missing}
    if fetched.source == "cache" and fetched.hash is None:  # the cache policy did not verify it
        given_up |= before.intersection(table)
    to_read = [name for name in wanted if name not in table and name not in absent]
    found, unreported = await _read_names(component, [*given_up, *to_read], given_up)
    known = {name: param for name, param in (table | found).items() if name not in unreported}
    lacks = [name for name in listed if name not in known]
    lacks += [f"index {each}" for each in sorted(missing.difference(each.index for each in listed.values()))]
    return Inspection(
        part_set(component, known.values(), f"vehicle {component.system}/{component.component}", lacks),
        complete,
        fetched.hash,
        (absent | unreported).difference(table),
        0.0 if fetched.source == "cache" else fetched.elapsed,
    )


async def reread(
    component: Component, inspection: Inspection, names: Iterable[str], given_up: Collection[str] = ()
) -> Inspection:
    """Read parameters by name, and add the values of other parameters received meanwhile.

    Args:
        component: the vehicle.
        inspection: its latest inspection.
        names: param_ids. Parameters that the vehicle does not report are not in the result.
        given_up: names that count as not reported if the vehicle does not answer, as long as it answers
            another one.

    Raises:
        NoReply: the vehicle did not answer.
        LinkError: the link failed, or the client was closed.
    """
    began = anyio.current_time()
    found, unknown = await _read_names(component, names, given_up)
    if given_up and not found:
        waited = anyio.current_time() - began
        raise NoReply(f"the values of {component.node.channel}", attempts=0, waited=waited)
    known = (inspection.table.keys() | found.keys()) - unknown
    params = (param for name, param in component.params.items() if name in known)
    return replace(
        inspection,
        table=component_set(component, params, inspection.table.source, inspection.table.lacks),
        absent=(inspection.absent | unknown).difference(found),
    )


async def _read_names(
    component: Component, names: Iterable[str], given_up: Container[str]
) -> tuple[dict[str, Param], frozenset[str]]:
    """Read parameters by name; return those received and the names that the vehicle does not have or report.

    A timeout ends the reads and is raised, except for names in `given_up`: they count as not reported.
    """
    names = tuple(names)
    found: dict[str, Param] = {}
    unknown: set[str] = set()
    failed: list[NoReply | LinkError] = []
    left = iter(names)

    async def read() -> None:
        for name in left:
            try:
                found[name] = await component.get(name)
            except (VehicleError, UsageError):  # the vehicle cannot have an invalid name either
                unknown.add(name)
            except (NoReply, LinkError) as error:
                if isinstance(error, NoReply) and name in given_up:
                    unknown.add(name)
                    continue
                failed.append(error)
                reading.cancel_scope.cancel()

    async with anyio.create_task_group() as reading:
        for _ in range(min(READS_IN_PROGRESS_MAX, len(names))):
            reading.start_soon(read)
    if failed:
        raise failed[0]
    return found, frozenset(unknown)


def _in_no_hidden_group(table: Mapping[str, Param], wanted: Iterable[str]) -> frozenset[str]:
    """Return wanted names that an ArduPilot cannot have: neither listed nor in a hidden group.

    While the switch of a group, a listed INT8, is 0, the list leaves out the parameters of that group; their
    names begin like that of the switch (`AP_Param::next_group`), possibly without an underscore behind it
    (OSD_TYPE: OSD1_ENABLE). All other parameters that can be read by name are listed.

    Args:
        table: the whole list.
        wanted: the wanted names.
    """
    switches = [name for name, param in table.items() if param.type is ParamType.INT8 and param.settable == 0]
    hidden = tuple({name[:at] for name in switches for at in range(1, len(name)) if name[at] == "_"})
    return frozenset(name for name in wanted if name not in table and not name.startswith(hidden))
