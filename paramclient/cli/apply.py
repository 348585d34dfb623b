"""The subcommands apply and restore: write the values of a file, or an earlier state, to vehicles."""

from __future__ import annotations

import shlex
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial as bind
from typing import ClassVar, Final, Self, TypeAlias

import anyio
import anyio.to_thread

from paramclient.cli.cached import parse_when
from paramclient.cli.json_output import JsonObject, apply_json, plan_json, row_json, rows_json
from paramclient.cli.metadata import MetadataChoice, known_of_session
from paramclient.cli.options import ApplyFlags
from paramclient.cli.output import (
    LINE_NAMES_MAX,
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
from paramclient.cli.session import ChosenVehicle, CommandSession, sessions
from paramclient.cli.sources import check_pattern, described, fill_pattern, is_pattern_name, resolve_all
from paramclient.cli.writes import STYLES, write_all
from paramclient.errors import CacheError, FileError, NoReply, NotInCache, UnknownVehicle, UsageError
from paramclient.files import FileFormat, ParamFile
from paramclient.model.names import age_in_words, first_of
from paramclient.model.paramset import ParamSet
from paramclient.provision.apply_restore import load_restore_point, restore_categories
from paramclient.provision.apply_rules import CATEGORIES, READ_ONLY
from paramclient.provision.execution import ApplyOptions, ApplyProgress, ApplyResult
from paramclient.provision.execution import run as run_apply
from paramclient.provision.inspection import plan, wait_for_identity
from paramclient.provision.planning import ApplyRow, ApplyStatus, Plan, Rows
from paramclient.provision.sources import choose, is_file, read_source

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
    source = await _read(file, options)
    load = bind(_from_file, file, source)
    return await run(url, _of_kind(options, source), load, metadata=metadata, partial=partial)


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
    load, flags = bind(_earlier_state, url, None), options
    if when is not None and (is_file(when) or is_pattern_name(when)):
        check_pattern("the backup file", when, options)
        source = await _read(when, options)
        load, flags = bind(_from_file, when, source), _of_kind(options, source)
    elif options.place is False:
        raise UsageError(
            "earlier states are in the cache, which --no-cache excludes; leave out --no-cache, or name a "
            "backup file"
        )
    elif when is not None:
        moment = parse_when(when, time.time())
        if isinstance(moment, int) and ChosenVehicle.parse(options.vehicle).is_all:
            raise UsageError(
                f"snapshot {when} is of one vehicle; with --vehicle all, give a time such as '2h ago'"
            )
        load = bind(_earlier_state, url, moment)

    async def load_own(session: CommandSession) -> State:
        state = await load(session)
        say(f"{session.prefix}the state: {described(state.params)}")
        return replace(state, include=await restore_categories(session.component, state.params))

    return await run(url, flags, load_own, is_restore=True)


# The values to write


@dataclass(frozen=True, slots=True)
class State:
    """The values to write to one vehicle.

    Attributes:
        params: the values.
        again: the command that continues after an error; "" for the given one. A restore without a time is
            refused the second time, and an age is another time later.
        include: categories that are written, although they are else left out.
        is_part: whether values are missing, so that the command cannot end as complete.
    """

    params: ParamSet
    again: str = ""
    include: tuple[str, ...] = ()
    is_part: bool = False


Load: TypeAlias = Callable[[CommandSession], Awaitable[State]]
"""Returns the values for a vehicle."""


async def _read(text: str, options: ApplyFlags) -> ParamFile | None:
    """Return the values for every vehicle; None for a file name with placeholders: each has its own."""
    if is_file(text):
        return read_source(text)
    if is_pattern_name(text):
        return None
    return ParamFile((*await resolve_all([text], options, writes=True),), FileFormat.JSON, text)


def _of_kind(options: ApplyFlags, source: ParamFile | None) -> ApplyFlags:
    """Return the options; with a source of extended parameters, those of the vehicles are meant."""
    return replace(options, extended=options.extended or (source is not None and source.is_extended))


async def _from_file(name: str, source: ParamFile | None, session: CommandSession) -> State:
    """Return the values for a vehicle; as its own, if its hardware id is named and the file has none.

    The id is named by --vehicle, or in the name of the file.

    Raises:
        FileError: the file does not exist, or has no parameters for the vehicle.
    """
    if source is None:
        path = await fill_pattern(name, session)
        source = read_source(path) if is_file(path) else None
        if source is None:
            raise FileError("no such file", source=path)
    params = choose(source, session.choice.component, session.component.system)
    await wait_for_identity(session.component)
    own, origin = session.component.identity, params.identity
    is_named = session.choice.uid is not None or (own.uid is not None and own.uid in params.source)
    if is_named and own.uid is not None and (origin is None or origin.uid is None):
        params = replace(params, identity=own if origin is None else replace(origin, uid=own.uid))
    return State(params, is_part=source.left_out > 0)


async def _earlier_state(url: str, moment: float | int | None, session: CommandSession) -> State:
    """Return the state at a time, of a snapshot, or without either before the last apply.

    Raises:
        ParamClientError: there is none.
    """
    cache, vehicle = session.client.cache, session.component
    if cache is None:
        raise NotInCache("earlier states are in the cache, which cannot be used")
    await wait_for_identity(vehicle)
    await vehicle.core.cache_writer.write_all()
    where, extended = (vehicle.identity.key, vehicle.component), vehicle.is_extended
    try:
        if moment is not None:
            load = bind(cache.state_at, *where, moment, extended=extended)
            again = "" if isinstance(moment, int) else _command(url, local_time(moment), session)
            return State(await anyio.to_thread.run_sync(load), again)
        find = bind(load_restore_point, cache, *where, extended=extended)
        point = await anyio.to_thread.run_sync(find)
    except UnknownVehicle:  # the vehicle was heard on the link; the user named none of the cache
        message = f"the cache {cache.place} has no earlier state of {where[0]}, component {where[1]}"
        raise NotInCache(message) from None
    except NotInCache:
        raise
    except CacheError as error:
        raise CacheError(
            f"nothing was sent, as the earlier state cannot be read: {error}. A backup file can be restored "
            "without the cache (--no-cache)"
        ) from error
    now = time.time()
    changes = [f"{name} {age_in_words(now - at)} ago" for name, at in point.changes.items()]
    changed = first_of(changes, LINE_NAMES_MAX) or "nothing, as far as is known"
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
    load: Load,
    *,
    metadata: MetadataChoice = None,
    partial: bool = True,
    is_restore: bool = False,
) -> int:
    """Plan, ask, and write; print the plans or the results, also those so far after an interruption.

    Args:
        url: the link.
        flags: the options of the subcommand.
        load: returns the values for a vehicle.
        metadata: the value of --metadata.
        partial: whether invalid values and unknown names are skipped.
        is_restore: whether the values are an earlier state of the vehicle.

    Returns:
        The exit code.

    Raises:
        FileError: a file of --backup exists, or names several vehicles' backups, or a vehicle has no file.
    """
    check_pattern("the file of --backup", flags.backup, flags)
    async with sessions(url, flags, writes=True) as found:
        jobs, backups = dict[CommandSession, _Job](), set[str]()

        async def prepare(session: CommandSession) -> None:
            state = await load(session)
            options = ApplyOptions(
                include=(*state.include, *flags.include),
                info=await known_of_session(session, metadata),
                partial=partial,
                reboot=flags.reboot,
                allow_armed=flags.allow_armed,
            )
            if flags.backup is not None:
                options["backup"] = path = await fill_pattern(flags.backup, session)
                if path in backups or await anyio.Path(path).exists():
                    message = "exists already, or is the backup of another vehicle; choose another name"
                    raise FileError(message, source=path)
                backups.add(path)
            jobs[session] = _Job(session, state, options, is_restore)

        await found.work(prepare)
        for error in found.errors.values():
            if isinstance(error, FileError):  # before anything is sent to another vehicle
                raise error
        if flags.dry_run or (not flags.yes and not flags.json and can_ask()):
            plans = await found.work(lambda session: jobs[session].make_plan())
            has_work = any(job.has_work for job in jobs.values())
            if flags.dry_run or has_work:
                code = found.show(plans)
            if flags.dry_run:
                return code
            if has_work and not await confirm("go on?"):
                return ExitCode.INCOMPLETE
        if flags.no_cache and flags.backup is None and not url.startswith("sim:"):
            say("the state before is not stored: --no-cache is given, and --backup is not")
        return await write_all(found, jobs)


@dataclass(eq=False)
class _Job:
    """What apply or restore does with one vehicle: its plan, and what became of it.

    Attributes:
        session: the vehicle.
        state: the values to write.
        options: the options of the run.
        is_restore: whether the values are an earlier state of the vehicle.
        plan: the plan, until the writes begin.
        arrived: the outcomes so far.
        result: the result at the end.
    """

    columns: ClassVar[Sequence[str]] = ("name", "before", "wanted", "now", "status", "reason")

    session: CommandSession
    state: State
    options: ApplyOptions
    is_restore: bool
    plan: Plan | None = None
    arrived: dict[str, ApplyRow] = field(default_factory=dict)
    result: ApplyResult | None = None

    async def make_plan(self) -> Self:
        """Plan before the deadline of the command, and return the job.

        Raises:
            NoReply: the deadline has passed.
        """
        session, left = self.session, self.session.deadline.left()
        include, info = self.options["include"], self.options["info"]
        with anyio.move_on_after(left):
            self.plan = await plan(session.component, self.state.params, include=include, info=info)
            return self
        raise NoReply(f"the parameters of {session.label}", attempts=0, waited=left or 0.0)

    async def write(self) -> Self:
        """Write, and return the job with its result."""
        session = self.session

        def update(now: ApplyProgress) -> None:
            if now.row is not None:
                self.arrived[now.row.name] = now.row
                status.count(now.done, now.total)

        async def announce() -> None:
            await session.check_only()
            session.announce_write()

        self.plan = None
        title = f"{'restoring' if self.is_restore else 'setting'} {session.label}"
        more = ApplyOptions(timeout=session.deadline.left(), progress=update, before_writing=announce)
        with Status(f"{title}: waiting for the first response", title) as status:
            self.result = await run_apply(
                session.component, self.state.params, {**self.options, **more}, is_restore=self.is_restore
            )
        return self

    def as_json(self) -> JsonObject:
        """Return the JSON of the plan or the result; after an interruption, of the outcomes so far."""
        if self.plan is not None:
            return plan_json(self.plan, self.session.component)
        if self.result is not None:
            return apply_json(self.result, self.session.component)
        rows = rows_json(self.arrived.values())
        return {**self.session.ids, "complete": False, "params": rows, "error": "interrupted"}

    def rows(self) -> Iterator[Sequence[object]]:
        """Yield the cells of each row; those of a plan in the order of writing."""
        shown = self.arrived.values() if self.result is None else self.result.shown_rows
        if self.plan is not None:
            yield from self._steps(self.plan)
            shown = [row for row in self.plan.shown_rows if row.status is not ApplyStatus.SET]
        for row in shown:
            yield _cells(row, row.why)

    def _steps(self, made: Plan) -> Iterator[Sequence[object]]:
        reboots = self.options["reboot"] and bool(made.reboot_for or made.awaiting_reboot)
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

    @property
    def open_count(self) -> int:
        """The number of values that were acknowledged, and not read back."""
        return sum(row.status is ApplyStatus.UNPROVEN for row in self.arrived.values())

    @property
    def _is_refused(self) -> bool:
        """Whether the plan has problems, and nothing is written because of them."""
        return bool(self.plan and self.plan.problems) and not self.options["partial"]

    @property
    def has_work(self) -> bool:
        """Whether the plan writes something."""
        if self.plan is None or self._is_refused:
            return False
        return bool(self.plan.to_write) or (self.options["reboot"] and bool(self.plan.awaiting_reboot))

    def report(self) -> int:
        """Print counts, what was left out with the options that write it, and what was not checked.

        Returns:
            The exit code; of a plan, the one that the command is expected to have.
        """
        result, label = self.result, self.session.label
        made = self.plan if result is None else result.plan
        if made is None:  # interrupted
            return ExitCode.DONE
        shown: Rows = made if result is None else result
        end, reboot_for = "; nothing was sent", () if self.options["reboot"] else made.reboot_for
        if result is not None:
            end, reboot_for = f" in {result.elapsed:.1f} s", result.reboot_required
        words = (f"{count} {_WORDS.get(status, status)}" for status, count in shown.counts.items())
        say(f"{self.session.receiver}: {', '.join(words) or 'nothing to set'}{end}")
        left_out = Counter(
            row.category
            for row in shown.of(ApplyStatus.SKIPPED)
            if row.category in CATEGORIES and row.category != READ_ONLY and row.differs
        )
        if left_out:
            listed = ", ".join(f"{count} {category}" for category, count in left_out.items())
            options = " ".join(f"--include {category}" for category in left_out)
            say(f"{label}: left out: {listed}; to write them: {options}")
        if made.unchecked_note:
            say(f"{label}: {made.unchecked_note}")
        if reboot_for:
            say(f"{label}: takes effect after a reboot: {first_of(reboot_for, LINE_NAMES_MAX)}")
        code = self._report_plan(made) if result is None else self._report_result(result)
        return max(code, ExitCode.INCOMPLETE) if self.state.is_part else code

    def _report_plan(self, made: Plan) -> int:
        """Print what the firmware and the armed state say about a plan, and whether it is refused."""
        label, code = self.session.label, ExitCode.DONE
        if made.firmware_note:
            say(f"{label}: {made.firmware_note}")
        if any(not row.is_as_wanted for row in made.of(ApplyStatus.SKIPPED, ApplyStatus.INVALID)):
            code = ExitCode.INCOMPLETE
        if self.session.component.is_armed and not self.options["allow_armed"]:
            report(f"{label} is armed; nothing would be set now without --allow-armed")
            code = ExitCode.INCOMPLETE
        if self._is_refused:
            names = first_of([*made.problems], LINE_NAMES_MAX)
            report(f"{label}: nothing would be sent without --partial: {names}")
            code = ExitCode.USAGE
        return code

    def _report_result(self, result: ApplyResult) -> int:
        """Print a new system id, and the error that ended the run."""
        session = self.session
        if result.system != session.component.system:
            say(f"{session.address} is {result.system}/{result.component} now")
        if result.error is not None:
            report(f"{session.label}: {result.error}; {self.to_continue}")
            return max(code_of(result.error), ExitCode.INCOMPLETE)
        return ExitCode.DONE if result.complete else ExitCode.INCOMPLETE

    @property
    def to_continue(self) -> str:
        """How to continue after an error, in words."""
        again = self.state.again
        return f"to continue: `{again}`" if again else "run it again to continue"


def _cells(row: ApplyRow, reason: str) -> Sequence[object]:
    found = row_json(row)
    values = map(found.get, ("before", "wanted", "actual"))
    return row.name, *values, Coloured(row.status, STYLES[row.status]), reason
