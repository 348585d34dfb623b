"""The subcommands apply, restore and reset: write a file, an earlier state, or the defaults to vehicles."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial as bind
from typing import Annotated, ClassVar, Final, Self, TypeAlias

import anyio
import anyio.to_thread
from cyclopts import Parameter

from paramclient import errors
from paramclient.cache import ParamCache
from paramclient.cache.moments import parse_moment
from paramclient.cli.json_output import JsonObject, apply_json, plan_json, row_json, rows_json
from paramclient.cli.metadata import MetadataChoice, default_in, known_of_session, say_sources
from paramclient.cli.options import ApplyFlags
from paramclient.cli.output import ExitCode, Status, can_ask, code_of, confirm, listed, report, say
from paramclient.cli.session import ChosenVehicle, CommandSession, check_given, get_chosen, sessions
from paramclient.cli.set_command import interruptible
from paramclient.cli.sources import described, filled, is_pattern_name, not_a_file, resolve_all
from paramclient.files import FileFormat, ParamFile
from paramclient.model.names import age_in_words, is_pattern
from paramclient.model.paramset import ParamSet
from paramclient.provision import apply_restore, execution
from paramclient.provision.apply_rules import CATEGORIES, READ_ONLY
from paramclient.provision.execution import ApplyOptions, ApplyProgress, ApplyResult
from paramclient.provision.inspection import plan, plan_for, wait_for_identity
from paramclient.provision.planning import ApplyRow, ApplyStatus, Plan, Rows
from paramclient.provision.sources import NO_DEFAULTS, choose, is_file, link_of, read_source

_WORDS: Final = {ApplyStatus.SET: "to set", ApplyStatus.LATER: "that may be revealed"}
"""Words for planned actions in the summary, where they differ from the status."""
_INCLUDABLE: Final = frozenset(CATEGORIES) - {READ_ONLY}
"""Categories of left-out parameters that --include writes; the vehicle lets no client write the others."""


@dataclass(frozen=True, slots=True)
class State:
    """The values to write to one vehicle.

    Attributes:
        params: the values.
        is_restore: whether they are an earlier state of the vehicle.
        partial: whether invalid values and unknown names are skipped.
        code: the exit code if all values are written: not 0 if some are missing.
        to_continue: how to continue after an interruption.
    """

    params: ParamSet
    is_restore: bool = False
    partial: bool = True
    code: ExitCode = ExitCode.DONE
    to_continue: str = "run it again to continue"


Load: TypeAlias = Callable[[CommandSession], Awaitable[State]]
"""Returns the values for a vehicle."""


async def apply(
    url: str,
    file: str,
    /,
    *,
    partial: bool = False,
    metadata: MetadataChoice = None,
    options: ApplyFlags = ApplyFlags(),
) -> int:
    """Write the values of a parameter file to a vehicle, in dependency order, and verify each of them.

    All or nothing: with an invalid value, or a name that the vehicle does not have, nothing is written (exit
    code 2), unless --partial is given. The previous state is stored in the cache, for `restore`. On a
    terminal, the changes are shown and must be confirmed. Exit code 0: the vehicle has all values of the
    file. Exit code 1: some values differ; 2: the file has a fault. After an interruption, run the same
    command again to continue. If several vehicles are heard, --vehicle must choose one, or all.

    Left out are overlong names, actions, and by default the categories identity, hardware, calibration,
    measured, counter, read-only and out-of-range.

    Args:
        url: The link, such as udpin:0.0.0.0:14550, or sim:ardupilot for a simulated vehicle.
        file: A parameter file, also with {uid} or {system} in its name for the vehicle's ids; or a vehicle in
            the cache, as cache:VEHICLE.
        partial: Skip invalid values and names that the vehicle does not have, and write the remaining values.
        metadata: A file that describes parameters, or vehicle to download the vehicle's own metadata: for the
            ranges of values, and for parameters that take effect only after a reboot.
    """
    return await _run(url, *await _from_file(file, options, partial=partial), metadata)


async def restore(url: str, when: str | None = None, /, *, options: ApplyFlags = ApplyFlags()) -> int:
    """Restore an earlier state of a vehicle, with its own identity and calibration.

    Parameters that the state does not have are not changed. Identity and calibration are written if the state
    is that of this very vehicle: a snapshot, a backup that has its hardware id (as .json files do), or one
    whose name has it; or if --vehicle names the hardware id. Confirmation and exit codes are those of apply.

    A time without a time zone is in the time zone of this computer, in which times are printed too, with its
    offset: 2026-11-20T14:00:00.000+01:00. A time in UTC ends with Z: 2026-11-20T13:00Z.

    Args:
        url: The link.
        when: A time, such as '2h ago' or '2026-11-20 14:00'; the number of a snapshot, from `history VEHICLE
            --snapshots`; or a backup file. Default: the state before the last apply, unless a restore ran
            since then; an apply that continues an interrupted one within an hour counts with it as one. With
            --vehicle all, a time, or a backup file with {uid} or {system} in its name.
    """
    if when is None or not (is_file(when) or is_pattern_name(when) or link_of(when) != when):
        try:
            moment = None if when is None else parse_moment(when, time.time())
        except errors.UsageError as error:
            snapshot = "the number of a snapshot (history VEHICLE --snapshots)"
            raise errors.UsageError(f"{not_a_file(str(when))}, nor {snapshot}: {error}") from None
        return await _run(url, options, bind(_earlier_state, moment))
    if ChosenVehicle.parse(options.vehicle).is_all and not is_pattern_name(when):
        raise errors.UsageError("with --vehicle all, the backup file needs {uid} or {system} in its name")
    return await _run(url, *await _from_file(when, options, is_restore=True))


async def reset(
    url: str,
    /,
    *names: str,
    all_: Annotated[bool, Parameter(name="--all")] = False,
    metadata: MetadataChoice = None,
    options: ApplyFlags = ApplyFlags(),
) -> int:
    """Set parameters to the firmware's defaults, in dependency order, and verify each of them.

    Fetches the table first. ArduPilot, and PX4 from 1.18 on, give the defaults in the parameter file over
    MAVFTP; defaults that the vehicle does not give are taken from its metadata. The state before is stored,
    for `restore`. If several vehicles are heard, --vehicle must choose one, or all. Confirmation and exit
    codes are those of apply; 1 also if a default is not known.

    Args:
        url: The link.
        names: The parameters, in upper or lower case, or patterns such as "MC_*".
        all_: Reset all parameters, except those that apply leaves out: identity, calibration, counters and so
            on, see --include.
        metadata: A file that describes parameters; or vehicle, to download the vehicle's own metadata.
    """
    if bool(names) == all_:
        raise errors.UsageError("reset takes names, or --all")
    chosen = check_given(names)
    flags = replace(options, include=(*options.include, *(name.upper() for name in chosen)))
    return await _run(url, flags, bind(_defaults, chosen or ["*"], metadata), metadata)


# The values to write


async def _from_file(
    name: str, options: ApplyFlags, *, partial: bool = True, is_restore: bool = False
) -> tuple[ApplyFlags, Load]:
    """Return the options for the kind of a file's parameters, and what gives each vehicle its values.

    The file may also be a vehicle of the cache or a link; one with placeholders in its name is read for each
    vehicle. The values count as a vehicle's own if --vehicle or the name of the file has its hardware id, and
    the file has none.

    Args:
        name: the file.
        options: the options of the subcommand.
        partial, is_restore: as in `State`.
    """
    source: ParamFile | None = None
    if is_file(name):
        source = read_source(name)
    elif not is_pattern_name(name):
        source = ParamFile((*await resolve_all([name], options, writes=True),), FileFormat.JSON, name)

    async def load(session: CommandSession) -> State:
        path = filled(name, session.component, session.label)
        file = source or (read_source(path) if is_file(path) else None)
        if file is None:
            raise errors.FileError("no such file", source=path)
        if file.faults and not partial:
            raise errors.FileError("nothing was sent; --partial writes what can be read", source=file.source)
        params = choose(file, session.choice.component, session.component.system)
        own, origin = session.component.identity, params.identity
        has_uid = origin is not None and origin.uid is not None
        header = file.header if len({each.system for each in file.sets}) == 1 else ()  # else of several
        is_named = own.uid and any(own.uid in each for each in (params.source, *header))
        if own.uid and not has_uid and (session.choice.uid or is_named):
            params = replace(params, identity=replace(origin or own, uid=own.uid))
        return State(params, is_restore, partial, ExitCode.USAGE if file.faults else ExitCode.DONE)

    return replace(options, extended=options.extended or (source is not None and source.is_extended)), load


async def _earlier_state(moment: float | int | None, session: CommandSession) -> State:
    """Return the state at a time, of a snapshot, or without either before the last apply.

    Raises:
        ParamClientError: there is none.
    """
    cache, vehicle = session.client.cache, session.component
    if cache is None:
        raise errors.UsageError("earlier states are in the cache, which is not used; name a backup file")
    await vehicle.core.cache_writer.write_all()
    place, extended = (vehicle.identity.key, vehicle.component), vehicle.is_extended
    try:
        if moment is not None:
            read = bind(cache.state_at, *place, moment, extended=extended)
            return State(await anyio.to_thread.run_sync(read), is_restore=True)
        find = bind(apply_restore.load_restore_point, cache, *place, extended=extended)
        point = await anyio.to_thread.run_sync(find)
    except (errors.CacheError, errors.UnknownVehicle) as error:  # the user named no vehicle of the cache
        raise errors.CacheError(f"nothing was sent, as no earlier state can be read: {error}") from error
    when = f"{age_in_words(time.time() - point.at)} ago (snapshot {point.snapshot})"
    changed = listed([*point.changes]) or "nothing, as far as is known"
    say(f"{session.prefix}the state is that before the last apply, {when}; changed since then: {changed}")
    again = f"restore {session.client.link.name} {point.snapshot} --vehicle {session.address}"
    again += " --extended" if extended else ""
    return State(point.state, is_restore=True, to_continue=f"to continue: paramclient {again}")


async def _defaults(chosen: Sequence[str], choice: MetadataChoice, session: CommandSession) -> State:
    """Return the firmware's defaults of the chosen parameters.

    Raises:
        VehicleError: no default is known.
        ParamClientError: the vehicle has no such parameter, or does not answer.
    """
    missing = (await session.fetch()).missing
    params, problems = await get_chosen(session, chosen, is_fetched=True)
    for error in problems.values():
        raise error
    known = await known_of_session(session, choice)
    if known is None and any(param.default is None for param in params):
        with suppress(errors.UsageError, errors.VehicleError, errors.NoReply):  # it gives no metadata
            known = await known_of_session(session, "vehicle")
    found = {param.name: default_in(known, param) for param in params}
    wanted = {name: default.value for name, default in found.items() if default is not None}
    if not wanted:
        raise errors.VehicleError(NO_DEFAULTS, *session.component.address)
    say_sources(session.label, found.values())
    without = [name for name in found if name not in wanted]
    is_cut = any(map(is_pattern, chosen)) and session.report_missing(missing) > 0
    if without:
        report(f"{session.prefix}not written, as their default is not known: {listed(without)}")
    code = ExitCode.INCOMPLETE if is_cut or without else ExitCode.DONE
    return State(ParamSet(wanted, source="the firmware's defaults"), code=code)


# Plans and writes


async def _run(url: str, flags: ApplyFlags, load: Load, metadata: MetadataChoice = None) -> int:
    """Plan, ask, and write; print the plans or the results, also those so far after an interruption.

    Args:
        url: the link.
        flags: the options of the subcommand.
        load: returns the values for a vehicle.
        metadata: the value of --metadata.

    Returns:
        The exit code.

    Raises:
        CacheError: the cache, which takes the state before, cannot be written.
        FileError: a file of --backup exists, or names several vehicles' backups, or a vehicle has no file.
    """
    if not (flags.dry_run or flags.no_cache):  # that nothing is sent is known at once, not after a warning
        try:
            with ParamCache(flags.cache) as cache:
                await anyio.to_thread.run_sync(bind(cache.save, (), durable=True))
        except errors.CacheError as failure:
            hint = "--no-cache does without, and restore then needs a backup file"
            raise errors.CacheError(f"nothing was sent: {failure}; {hint}") from failure
    async with sessions(url, flags, writes=True) as found:
        if not flags.dry_run:  # which a log serves too
            found[0].client.core.station.check_may_send()
        jobs, backups, systems = dict[CommandSession, _Job](), set[str | None](), set[object]()

        async def prepare(session: CommandSession) -> None:
            await wait_for_identity(session.component)
            backup = None if flags.backup is None else filled(flags.backup, session.component, session.label)
            if backup is not None and (await anyio.Path(backup).exists() or backup in backups):
                problem = "exists already, or is another vehicle's; a name may have {uid} or {system}"
                raise errors.FileError(problem, source=backup)
            backups.add(backup)
            state, include = await load(session), flags.include
            if state.is_restore:
                say(f"{session.prefix}the state: {described(state.params)}")
                include += await apply_restore.restore_categories(session.component, state.params)
            info = await known_of_session(session, metadata)
            options = ApplyOptions(include=include, info=info, partial=state.partial, backup=backup)
            system = plan_for(session.component, state.params, None, options).system_id
            if system is not None and system in systems:
                hint = "a file for each has {system} in its name"
                problem = f"nothing was sent: several vehicles would get the system id {system!r}; {hint}"
                raise errors.FileError(problem, source=state.params.source)
            systems.add(system)
            options |= {"reboot": flags.reboot, "allow_armed": flags.allow_armed}
            jobs[session] = _Job(session, state, options)

        with interruptible(found, jobs):
            await found.work(prepare)
            for error in found.errors.values():
                if isinstance(error, errors.FileError):  # before anything is sent to another vehicle
                    raise error
            if flags.dry_run or (not flags.yes and not flags.json and can_ask()):
                plans = await found.work(lambda session: jobs[session].make_plan())
                if flags.dry_run:
                    return found.show(plans)
                if any(job.has_work for job in plans.values()):
                    found.show(plans)
                    if not await confirm("go on?"):
                        return ExitCode.INCOMPLETE
            return found.show(await found.work(lambda session: jobs[session].write()))


@dataclass(eq=False)
class _Job:
    """What apply, restore or reset does with one vehicle: its plan, and what became of it.

    Attributes:
        session: the vehicle.
        state: the values to write.
        options: the options of the run.
        has_work: whether the plan writes something.
        has_begun: whether values may have been sent.
        found: the plan; while it is written, the outcomes so far; and at the end the result.
    """

    columns: ClassVar[Sequence[str]] = ("name", "before", "wanted", "now", "status", "reason")

    session: CommandSession
    state: State
    options: ApplyOptions
    has_work: bool = False
    has_begun: bool = False
    found: Rows = field(default_factory=lambda: Rows({}))

    async def make_plan(self) -> Self:
        """Plan before the deadline of the command, and return the job.

        Raises:
            UsageError: the state to restore is that of another vehicle.
            NoReply: the deadline has passed.
        """
        session, left = self.session, self.session.deadline.left()
        include, info = self.options["include"], self.options["info"]
        with Status(f"reading {session.label}"), anyio.move_on_after(left):
            self.found = made = await plan(session.component, self.state.params, include=include, info=info)
            if self.state.is_restore:
                made.check_state()
            is_refused = made.problems and not self.options["partial"]
            to_reboot_for = made.awaiting_reboot if self.options["reboot"] else ()
            self.has_work = not is_refused and bool(made.to_write or to_reboot_for)
            return self
        raise errors.NoReply(f"the parameters of {session.label}", attempts=0, waited=left or 0.0)

    async def write(self) -> Self:
        """Write, and return the job with its result."""
        session, state, arrived = self.session, self.state, dict[str, ApplyRow]()

        def update(now: ApplyProgress) -> None:
            if now.row is not None:
                arrived[now.row.name] = now.row
                status.count(now.done, now.total)
            elif now.phase == "writing" and not self.has_begun:
                self.has_begun = True
                if not session.options.json:
                    say(f"writing to {session.receiver} on {session.client.link.name}")

        self.found, title = Rows(arrived), f"setting {session.label}"
        options = self.options | {"timeout": session.deadline.left(), "progress": update}
        options["before_writing"] = session.check_only
        with Status(f"{title}: waiting for the first response", title) as status:
            run = execution.run(session.component, state.params, options, is_restore=state.is_restore)
            try:
                self.found = await run
            except errors.InvalidParameters:
                if not session.options.json:
                    raise
                return await self.make_plan()  # which has them
        return self

    def as_json(self) -> JsonObject:
        """Return the JSON of the plan or the result; after an interruption, of the outcomes so far."""
        if isinstance(self.found, Plan):
            return plan_json(self.found, self.session.component)
        if isinstance(self.found, ApplyResult):
            return apply_json(self.found, self.session.component)
        return {"complete": False, "params": rows_json(self.found.rows.values()), "error": "interrupted"}

    def rows(self) -> Iterator[Sequence[object]]:
        """Yield the cells of each row; those of a plan in the order of writing."""
        for stage in self.found.stages if isinstance(self.found, Plan) else ():
            for row in stage.rows:
                purpose = stage.purpose + (", takes effect after a reboot" if row.needs_reboot else "")
                yield _cells(row, row.reason or purpose)
        for row in self.found.shown_rows:
            if row.status is not ApplyStatus.SET:
                yield _cells(row, row.why)

    def report(self) -> int:
        """Print counts, what was left out with the options that write it, and what was not checked.

        Returns:
            The exit code; of a plan, the one that the command is expected to have.
        """
        found, session, options, params = self.found, self.session, self.options, self.state.params
        words = ", ".join(f"{count} {_WORDS.get(status, status)}" for status, count in found.counts.items())
        remarks = list[str]()
        is_whole = all(row.is_as_wanted for row in found.rows.values() if row.status not in _WORDS)
        code = max(self.state.code, ExitCode.DONE if is_whole else ExitCode.INCOMPLETE)
        if isinstance(found, Plan):
            made, end, late = found, "; nothing was sent", found.reboot_for + found.awaiting_reboot
            if session.component.is_armed and not options["allow_armed"]:
                remarks.append("armed; nothing would be set now without --allow-armed")
                code = max(code, ExitCode.INCOMPLETE)
            if found.problems and not options["partial"]:
                remarks.append(f"nothing would be sent without --partial: {listed([*found.problems])}")
                code = ExitCode.USAGE
            remarks.append(found.firmware_note)
        elif isinstance(found, ApplyResult):
            end = f"{', rebooted' * bool(found.reboots)} in {found.elapsed:.1f} s"
            made, late = found.plan, found.reboot_required
            if found.error is not None:
                remarks.append(f"{found.error}".rstrip(".") + f"; {self.state.to_continue}")
                code = max(code, code_of(found.error))
        else:
            say(f"{session.receiver}: {words or 'nothing acknowledged'}; {self.state.to_continue}")
            return code
        if made.problems:
            code = max(code, ExitCode.USAGE)
        if not session.options.json:
            say(f"{session.receiver}: {words or 'nothing to set'}{end}")
            if left_out := Counter(row.category for row in found.shown_rows if row.category in _INCLUDABLE):
                counts = ", ".join(f"{count} {category}" for category, count in left_out.items())
                includes = " ".join(f"--include {category}" for category in left_out)
                own = ", ".join(each for each in left_out if each in apply_restore.OWN_STATE_CATEGORIES)
                if own and apply_restore.is_own_state(session.component, params):
                    includes += f"; restore writes this vehicle's own {own} too"
                remarks.append(f"left out: {counts}; to write them: {includes}")
            if late:
                remarks.append(f"takes effect after a reboot: {listed(late)}")
            remarks.insert(0, "" if self.state.is_restore else made.unchecked_note)
        remarks.append(params.lacks and f"{params.source} is incomplete: {params.lacks}")
        for remark in filter(None, remarks):
            say(f"{session.label}: {remark}")
        return code


def _cells(row: ApplyRow, reason: str) -> Sequence[object]:
    return row.name, *map(row_json(row).get, ("before", "wanted", "actual")), row.status, reason
