"""The subcommands apply and restore: write the values of a file, or an earlier state, to vehicles."""

from __future__ import annotations

import shlex
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Final

import anyio
import anyio.to_thread

from paramclient.cli.file_output import described
from paramclient.cli.json_apply import apply_json, plan_json, rows_json
from paramclient.cli.json_output import JsonObject
from paramclient.cli.metadata import MetadataChoice, known_of_session
from paramclient.cli.options import ApplyFlags
from paramclient.cli.output import (
    Coloured,
    ExitCode,
    Status,
    can_ask,
    code_of,
    confirm,
    local_time,
    report,
    say,
)
from paramclient.cli.session import ChosenVehicle, CommandSession, Done, Sessions, sessions
from paramclient.cli.sources import check_pattern, fill_pattern, is_pattern_name, resolve_all
from paramclient.cli.time_arguments import parse_when
from paramclient.errors import (
    CacheError,
    FileError,
    NoReply,
    NotInCache,
    UnknownVehicle,
    UsageError,
)
from paramclient.files import ParamFile
from paramclient.model.names import age_in_words, counted, first_of
from paramclient.model.notation import typed
from paramclient.model.paramset import ParamSet
from paramclient.model.values import format_value
from paramclient.protocol.fetch import Progress
from paramclient.provision import CATEGORIES, ApplyProgress, ApplyResult, ApplyRow, ApplyStatus, Plan, plan
from paramclient.provision import apply as apply_to_vehicle
from paramclient.provision import restore as restore_state
from paramclient.provision.apply_restore import load_restore_point, restore_categories
from paramclient.provision.inspection import wait_for_identity
from paramclient.provision.planning import Rows
from paramclient.provision.sources import choose, is_file, read_source

APPLY_NAMES_MAX: Final = 10
"""Parameters that a line names, so that it stays short; it gives the number of further ones."""
_STYLES: Final = {
    **dict.fromkeys((ApplyStatus.SET, ApplyStatus.ACCEPTED), "green"),
    **dict.fromkeys((ApplyStatus.LATER, ApplyStatus.ADJUSTED, ApplyStatus.UNPROVEN), "yellow"),
    **dict.fromkeys((ApplyStatus.INVALID, ApplyStatus.UNKNOWN), "bold red"),
    **dict.fromkeys((ApplyStatus.SKIPPED, ApplyStatus.NOT_TRIED), "dim"),
    ApplyStatus.REFUSED: "red",
}
"""Styles of each status."""
_WORDS: Final = {ApplyStatus.SET: "to set", ApplyStatus.LATER: "that may be revealed"}
"""Words for planned actions in the summary, where they differ from the status."""
_OPTIONS: Final = ApplyFlags()


async def apply(
    url: str,
    file: str,
    /,
    *,
    partial: bool = False,
    metadata: MetadataChoice = None,
    options: ApplyFlags = _OPTIONS,
) -> int:
    """Write the values of a parameter file to a vehicle, in dependency order, and verify each of them.

    All or nothing: with an invalid value, or a name that the vehicle does not have, nothing is written (exit
    code 2), unless --partial is given. The previous state is stored in the cache, for `restore`. On a
    terminal, the changes are shown and must be confirmed. Exit code 0: the vehicle has all values of the
    file. Exit code 1: some values differ. After an interruption, run the same command again to continue. If
    several vehicles are heard, --vehicle must choose one, or all.

    Left out are actions, and by default the categories identity, hardware, calibration, measured, counter,
    read-only and out-of-range.

    Args:
        url: The link, such as udpin:0.0.0.0:14550, or sim:ardupilot for a simulated vehicle.
        file: A parameter file, also with {uid} or {system} in its name for the vehicle's ids; or a vehicle in
            the cache, as cache:VEHICLE.
        partial: Skip invalid values and names that the vehicle does not have, and write the remaining values.
        metadata: A file that describes parameters, or vehicle to download the vehicle's own metadata: for the
            ranges of values, and for parameters that take effect only after a reboot.
    """
    source = _Files.open(file)
    if source is None:
        (params,) = await resolve_all([file], options, writes=True)

    async def load(session: CommandSession) -> State:
        return State(params) if source is None else await source.state_of(session)

    return await run(url, options, load, source, metadata, {"partial": partial})


async def restore(url: str, when: str | None = None, /, *, options: ApplyFlags = _OPTIONS) -> int:
    """Restore an earlier state of a vehicle, with its own identity and calibration.

    Parameters that the state does not have are not changed. Identity and calibration are written if the state
    is that of this very vehicle: a snapshot, a backup that has its hardware id (as .json files do), or one
    whose name has it; or if --vehicle names the hardware id. On a terminal, the changes are shown and must be
    confirmed. The exit codes are those of apply.

    A time without a time zone is in the time zone of this computer, in which times are printed too, with its
    offset: 2026-11-20T14:00:00.000+01:00. A time in UTC ends with Z: 2026-11-20T13:00Z.

    Args:
        url: The link.
        when: A time, such as '2h ago' or '2026-11-20 14:00'; the number of a snapshot, from `history VEHICLE
            --snapshots`; or a backup file. Default: the state before the last apply, unless a restore ran
            since then. With --vehicle all, a time, or a backup file with {uid} or {system} in its name.
    """
    source = None if when is None else _Files.open(when)
    moment = None
    if source is not None:
        check_pattern("the backup file", when, options)
    else:
        moment = None if when is None else parse_when(when, time.time())
        if isinstance(moment, int) and ChosenVehicle.parse(options.vehicle).is_all:
            raise UsageError(
                f"snapshot {when} is of one vehicle; with --vehicle all, give a time such as '2h ago'"
            )
        if options.place is False:
            raise UsageError(
                "earlier states are in the cache, which --no-cache excludes; leave out --no-cache, or name a "
                "backup file"
            )

    async def load(session: CommandSession) -> State:
        state = await (source.state_of(session) if source else _earlier_state(session, url, moment))
        say(f"{session.prefix}the state: {described(state.params)}")
        return state

    return await run(url, options, load, source, None, {})


# The values to write


@dataclass(frozen=True, slots=True)
class State:
    """The values to write to one vehicle.

    Attributes:
        params: the values.
        again: the command that continues after an error; "" for the given one. A restore without a time is
            refused the second time, and an age is another time later.
        left_out: number of parameters of a file that no vehicle can have.
    """

    params: ParamSet
    again: str = ""
    left_out: int = 0


@dataclass(frozen=True, slots=True)
class _Files:
    """A file for every vehicle, or one each if the name has a placeholder; then `file` is None."""

    name: str
    file: ParamFile | None

    @classmethod
    def open(cls, name: str) -> _Files | None:
        """Return the files of an argument; None if it names none."""
        if is_file(name):
            return cls(name, read_source(name))
        return cls(name, None) if is_pattern_name(name) else None

    async def state_of(self, session: CommandSession) -> State:
        """Return the values for a vehicle; as its own, if its hardware id is named and the file has none.

        The id is named by --vehicle, or in the name of the file.

        Raises:
            FileError: the file does not exist, or has no parameters for the vehicle.
        """
        file = self.file
        if file is None:
            path = await fill_pattern(self.name, session)
            file = read_source(path) if is_file(path) else None
            if file is None:
                raise FileError("no such file", source=path)
        params = choose(file, session.choice.component, session.component.system)
        await wait_for_identity(session.component)
        own, origin = session.component.identity, params.identity
        is_named = session.choice.uid is not None or (own.uid is not None and own.uid in params.source)
        if is_named and own.uid is not None and (origin is None or origin.uid is None):
            params = replace(params, identity=own if origin is None else replace(origin, uid=own.uid))
        return State(params, left_out=file.left_out)


async def _earlier_state(session: CommandSession, url: str, moment: float | int | None) -> State:
    """Return the state at a time, of a snapshot, or without either before the last apply.

    Raises:
        ParamClientError: there is none.
    """
    cache, vehicle = session.client.cache, session.component
    if cache is None:
        raise NotInCache("earlier states are in the cache, which cannot be used")
    await wait_for_identity(vehicle)
    await vehicle.core.cache_writer.write_all()
    key, component, extended = vehicle.identity.key, vehicle.component, vehicle.is_extended
    if moment is not None:
        try:
            load = partial(cache.state_at, key, component, moment, extended=extended)
            state = await anyio.to_thread.run_sync(load)
        except UnknownVehicle:  # the vehicle was heard on the link; the user named none of the cache
            message = f"the cache {cache.place} has no earlier state of {key}, component {component}"
            raise NotInCache(message) from None
        is_number = isinstance(moment, int)
        return State(state, again="" if is_number else _command(url, local_time(moment), session))
    try:
        find = partial(load_restore_point, cache, key, component, extended=extended)
        point = await anyio.to_thread.run_sync(find)
    except NotInCache:
        raise
    except CacheError as error:
        raise CacheError(
            f"nothing was sent, as the state before the last apply cannot be read: {error}. A backup file"
            " can be restored without the cache (--no-cache)"
        ) from error
    now = time.time()
    changes = [f"{name} {age_in_words(now - at)} ago" for name, at in point.changes.items()]
    changed = first_of(changes, APPLY_NAMES_MAX) or "nothing, as far as is known"
    say(
        f"{session.prefix}the state is that before the last apply, {age_in_words(now - point.at)} ago "
        f"(snapshot {point.snapshot}); changed since then: {changed}"
    )
    return State(point.state, _command(url, point.snapshot, session))


def _command(url: str, when: object, session: CommandSession) -> str:
    """Return the command that restores a state of a vehicle, for messages."""
    vehicle = str(session.component.system) if session.choice.is_all else session.options.vehicle
    chosen = [] if vehicle is None else ["--vehicle", vehicle]
    more = ["--extended"] * session.component.is_extended
    return shlex.join(["paramclient", "restore", url, str(when), *chosen, *more])


# Plans and writes


async def run(
    url: str,
    flags: ApplyFlags,
    load: Callable[[CommandSession], Awaitable[State]],
    source: _Files | None,
    metadata: MetadataChoice,
    more: dict[str, Any],
) -> int:
    """Plan, ask, and write; print the plans or the results, also those so far after an interruption.

    Args:
        url: the link.
        flags: the options of the subcommand.
        load: returns the values for a vehicle.
        source: the files that they are from, or None.
        metadata: the value of --metadata.
        more: further options of `apply`; none for `restore`.

    Returns:
        The exit code.

    Raises:
        UsageError: --backup gives several vehicles one file.
        FileError: a file of --backup exists, or a file of a vehicle does not.
    """
    check_pattern("the file of --backup", flags.backup, flags)
    file = None if source is None else source.file
    flags = replace(flags, extended=flags.extended or (file is not None and file.is_extended))
    async with sessions(url, flags, writes=True) as found:

        async def job(session: CommandSession) -> _Job:
            state = await load(session)
            info = await known_of_session(session, metadata)
            return _Job(session, state, flags, {"info": info, **more}, is_restore=not more)

        loaded = await found.work(job)
        failed = [each for each in loaded if each.error is not None]
        for each in failed:
            if isinstance(each.error, FileError):  # before anything is sent to another vehicle
                raise each.error
        jobs = {each.session: each.result for each in loaded if each.result is not None}
        ready = Sessions(jobs)
        backups = {each: await fill_pattern(flags.backup, each) for each in jobs} if flags.backup else {}
        if len(set(backups.values())) < len(backups):
            raise UsageError(f"--backup {flags.backup} names one file for several vehicles")
        files = {each: _new(name) for each, name in backups.items()}
        if flags.dry_run or (not flags.yes and not flags.json and can_ask()):
            made = await ready.work(lambda session: jobs[session].planned()) if ready else []
            plans = [each.result for each in made if each.result is not None]
            has_work = any(each.has_work for each in plans)
            if flags.dry_run or has_work:
                code = found.show([*made, *failed])
            if flags.dry_run:
                return code
            if has_work and not await confirm("go on?"):
                return ExitCode.INCOMPLETE
        if flags.no_cache and flags.backup is None and not url.startswith("sim:"):
            say("the state before is not stored: --no-cache is given, and --backup is not")
        try:
            done = await ready.work(lambda session: jobs[session].run(files.get(session))) if ready else []
        except anyio.get_cancelled_exc_class():
            found.show([Done(session, job) for session, job in jobs.items()])
            rows = [row for job in jobs.values() for row in job.arrived.values()]
            unproven = sum(row.status is ApplyStatus.ACCEPTED for row in rows)
            say(
                f"interrupted: {counted(unproven, 'value')} acknowledged, not proven, and others may be in "
                f"flight; {'; '.join(dict.fromkeys(job.to_continue for job in jobs.values()))}"
            )
            raise
        code = found.show([*done, *failed])
        return max(code, ExitCode.INCOMPLETE) if any(job.state.left_out for job in jobs.values()) else code


def _new(path: str) -> Path:
    """Return the path of a new file. An existing file may be the only copy of an earlier state.

    Raises:
        FileError: the file exists.
    """
    if Path(path).exists():
        message = "exists already, and may be the backup of an earlier run; choose another name"
        raise FileError(message, source=path)
    return Path(path)


@dataclass(eq=False)
class _Job:
    """What apply or restore does with one vehicle: its plan, and what became of it.

    Attributes:
        session: the vehicle.
        state: the values to write.
        flags: the options of the subcommand.
        more: further options of `apply`.
        is_restore: whether the values are an earlier state of the vehicle.
        plan: the plan, until the writes begin.
        arrived: the outcomes so far.
        result: the result at the end.
    """

    columns: ClassVar[Sequence[str]] = ("name", "before", "wanted", "now", "status", "reason")

    session: CommandSession
    state: State
    flags: ApplyFlags
    more: dict[str, Any]
    is_restore: bool
    plan: Plan | None = None
    arrived: dict[str, ApplyRow] = field(default_factory=dict)
    result: ApplyResult | None = None

    async def planned(self) -> _Job:
        """Plan before the deadline of the command, and return the job.

        Raises:
            NoReply: the deadline has passed.
        """
        component, params, left = self.session.component, self.state.params, self.session.deadline.left()
        own = await restore_categories(component, params) if self.is_restore else ()
        with anyio.move_on_after(left):
            include = (*own, *self.flags.include)
            self.plan = await plan(component, params, include=include, info=self.more["info"])
            return self
        raise NoReply(f"the parameters of {self.session.label}", attempts=0, waited=left or 0.0)

    async def run(self, backup: Path | None) -> _Job:
        """Write, and return the job with its result; `backup` is the file for the state before."""
        session, flags = self.session, self.flags
        began: float | None = None

        def update(state: ApplyProgress) -> None:
            nonlocal began
            if state.row is not None:
                self.arrived[state.row.name] = state.row
                began = began or anyio.current_time()
                elapsed = anyio.current_time() - began
                status.update(Progress.after(state.done, state.total, elapsed))

        async def announce() -> None:
            await session.check_only()
            session.announce_write()

        self.plan = None
        title = f"{'restoring' if self.is_restore else 'setting'} {session.label}"
        with Status(f"{title}: waiting for the first response", title) as status:
            self.result = await (restore_state if self.is_restore else apply_to_vehicle)(
                session.component,
                self.state.params,
                include=flags.include,
                reboot=flags.reboot,
                allow_armed=flags.allow_armed,
                backup=backup,
                timeout=session.deadline.left(),
                progress=update,
                before_writing=announce,
                **self.more,
            )
        return self

    def as_json(self) -> JsonObject:
        """Return the JSON of the plan or the result; after an interruption, of the outcomes so far."""
        if self.plan is not None:
            return plan_json(self.plan, self.session.component)
        if self.result is not None:
            return apply_json(self.result, self.session.component)
        rows = rows_json(self._so_far)
        return {**self.session.ids, "complete": False, "params": rows, "error": "interrupted"}

    def rows(self) -> Iterator[Sequence[object]]:
        """Yield the cells of each row; those of a plan in the order of writing."""
        if self.plan is not None:
            yield from self._plan_rows(self.plan)
            return
        for row in self._so_far if self.result is None else self.result.shown_rows:
            yield _cells(row, row.why)

    def _plan_rows(self, made: Plan) -> Iterator[Sequence[object]]:
        reboots = self.flags.reboot and bool(made.reboot_for or made.awaiting_reboot)
        restart = (None, None, None, None, Coloured("reboot", "yellow"), "the vehicle reboots")
        for stage in made.stages:
            for row in stage.rows:
                purpose = stage.purpose + (", takes effect after a reboot" if row.needs_reboot else "")
                yield _cells(row, row.reason or purpose)
            if reboots and stage.reboot_first:
                reboots = False
                yield restart
        if reboots:
            yield restart
        for row in made.shown_rows:
            if row.status is not ApplyStatus.SET:
                yield _cells(row, row.why)

    @property
    def _so_far(self) -> Iterator[ApplyRow]:
        """The outcomes before an interruption: no value was read back."""
        unproven, reason = ApplyStatus.UNPROVEN, "acknowledged, and not read back"
        for row in self.arrived.values():
            is_proven = row.status is not ApplyStatus.ACCEPTED
            yield row if is_proven else replace(row, status=unproven, reason=reason)

    @property
    def _is_refused(self) -> bool:
        """Whether the plan has problems, and nothing is written because of them."""
        return bool(self.plan and self.plan.problems) and not (self.is_restore or self.more["partial"])

    @property
    def has_work(self) -> bool:
        """Whether the plan writes something."""
        if self.plan is None or self._is_refused:
            return False
        return bool(self.plan.to_write) or (self.flags.reboot and bool(self.plan.awaiting_reboot))

    def report(self) -> int:
        """Print a summary of the plan or of the result; return the exit code."""
        if self.plan is not None:
            return self._say_plan()
        return ExitCode.DONE if self.result is None else self._say_result()

    def _say_plan(self) -> int:
        """Print a summary of the plan; return the exit code that the command is expected to have."""
        session, made, code = self.session, self.plan, ExitCode.DONE
        assert made is not None
        if not self.flags.json:
            if made.firmware_note:
                say(f"{session.label}: {made.firmware_note}")
            reboot_for = () if self.flags.reboot else made.reboot_for
            self._say(made, made, "; nothing was sent", "would take effect", reboot_for)
        if self._is_refused:
            code = ExitCode.USAGE
        elif any(not row.is_as_wanted for row in made.of(ApplyStatus.SKIPPED, ApplyStatus.INVALID)):
            code = ExitCode.INCOMPLETE
        if session.component.is_armed and not self.flags.allow_armed:
            report(f"{session.label} is armed; nothing would be set now without --allow-armed")
            code = max(code, ExitCode.INCOMPLETE)
        return code

    def _say_result(self) -> int:
        """Print what became of the vehicle; return the exit code."""
        result, session = self.result, self.session
        assert result is not None
        end = f" in {result.elapsed:.1f} s"
        self._say(result, result.plan, end, "takes effect", result.reboot_required)
        if result.system != session.component.system:
            say(f"{session.address} is {result.system}/{result.component} now")
        if result.error is not None:
            report(f"{session.label}: {result.error}; {self.to_continue}")
            return max(code_of(result.error), ExitCode.INCOMPLETE)
        return ExitCode.DONE if result.complete else ExitCode.INCOMPLETE

    def _say(self, shown: Rows, made: Plan, end: str, effect: str, reboot_for: Sequence[str]) -> None:
        """Print counts, what was left out with the options that write it, and what was not checked."""
        words = (f"{count} {_WORDS.get(status, status)}" for status, count in shown.counts.items())
        say(f"{self.session.receiver}: {', '.join(words) or 'nothing to set'}{end}")
        left_out = Counter(
            row.category
            for row in shown.of(ApplyStatus.SKIPPED)
            if row.category in CATEGORIES and row.differs
        )
        if left_out:
            listed = ", ".join(f"{count} {category}" for category, count in left_out.items())
            options = " ".join(f"--include {category}" for category in left_out)
            say(f"{self.session.label}: left out: {listed}; to write them: {options}")
        if made.unchecked_note:
            say(f"{self.session.label}: {made.unchecked_note}")
        if reboot_for:
            names = first_of(reboot_for, APPLY_NAMES_MAX)
            say(f"{self.session.label}: {effect} after a reboot: {names}")

    @property
    def to_continue(self) -> str:
        """How to continue after an error, in words."""
        again = self.state.again
        return f"to continue: `{again}`" if again else "run it again to continue"


def _cells(row: ApplyRow, reason: str) -> list[object]:
    values = (
        None if value is None else format_value(*typed(value, row.type))
        for value in (row.before, row.wanted.settable, row.actual)
    )
    return [row.name, *values, Coloured(row.status, _STYLES.get(row.status, "")), reason]
