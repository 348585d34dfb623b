"""The subcommand apply, and what it shares with restore: the plan, the confirmation, the writes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Awaitable, Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, ClassVar, Final

import anyio
from cyclopts import Parameter

from paramclient.cli.exit_codes import ExitCode, code_of
from paramclient.cli.json_apply import apply_json, plan_json, rows_json
from paramclient.cli.json_output import JsonObject
from paramclient.cli.metadata import MetadataChoice, from_file, known_of_session
from paramclient.cli.options import ApplyFlags
from paramclient.cli.output import Coloured, Status, can_ask, confirm, report, say
from paramclient.cli.session import CommandSession, Done, Sessions, sessions
from paramclient.cli.sources import (
    check_new,
    check_pattern,
    choose,
    fill_pattern,
    is_file,
    open_file,
    resolve,
)
from paramclient.errors import FileError, NoReply, UsageError
from paramclient.model.notation import typed
from paramclient.model.paramset import ParamSet
from paramclient.model.values import WireValue, format_value
from paramclient.model.wording import counted, first_of
from paramclient.protocol.fetch import Progress
from paramclient.provision import (
    CATEGORIES,
    ApplyOptions,
    ApplyProgress,
    ApplyResult,
    ApplyRow,
    ApplyStatus,
    Plan,
    plan,
)
from paramclient.provision import apply as apply_to_vehicle
from paramclient.provision.planning import Rows, check_component

__all__ = ["ApplyJob", "apply", "run_jobs"]

APPLY_NAMES_MAX: Final = 10
"""Parameters that a line names, so that it stays short; it gives the number of further ones."""
_STYLES: Final = {
    ApplyStatus.SET: "green",
    ApplyStatus.LATER: "yellow",
    ApplyStatus.INVALID: "bold red",
    ApplyStatus.SKIPPED: "dim",
    ApplyStatus.ACCEPTED: "green",
    ApplyStatus.ADJUSTED: "yellow",
    ApplyStatus.REFUSED: "red",
    ApplyStatus.UNPROVEN: "yellow",
    ApplyStatus.UNKNOWN: "bold red",
    ApplyStatus.NOT_TRIED: "dim",
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
    durable: bool = False,
    over: Annotated[str | None, Parameter(name="--overlay")] = None,
    metadata: MetadataChoice = None,
    options: ApplyFlags = _OPTIONS,
) -> int:
    """Write the values of a parameter file to a vehicle, in dependency order, and verify each of them.

    All or nothing: with an invalid value, or a name that the vehicle does not have, nothing is written (exit
    code 2), unless --partial is given. The previous state is stored in the cache, for `restore`. On a
    terminal, the changes are shown and must be confirmed. Exit code 0: the vehicle has all values of the
    file. Exit code 1: some values differ. After an interruption, run the same command again to continue. If
    several vehicles are heard, --vehicle must choose one, or all.

    Left out by default are the categories identity, hardware, calibration, measured, counter, action,
    read-only and out-of-range.

    Args:
        url: The link, such as udpin:0.0.0.0:14550, or sim:ardupilot for a simulated vehicle.
        file: A parameter file; or a vehicle in the cache, as cache:VEHICLE.
        partial: Skip invalid values and names that the vehicle does not have, and write the remaining values.
        durable: End only when the values and their history are on the disk and survive a power loss.
        over: A file whose parameters replace and extend those of FILE, with {uid} or {system} in its name
            for the vehicle's ids.
        metadata: A file that describes parameters, or vehicle to download the vehicle's own metadata: for the
            ranges of values, and for parameters that take effect only after a reboot.
    """
    check_pattern("the file of --overlay", over, options)
    check_pattern("the file of --backup", options.backup, options)
    given = from_file(metadata)
    opened = open_file(file, partial=partial) if is_file(file) else None
    params = None
    if opened is None:
        params = await resolve(file, options, writes=True, extended=options.extended)
    extended = options.extended or (opened is not None and opened.is_extended)
    async with sessions(url, options, writes=True, extended=extended) as found:

        async def job(session: CommandSession) -> ApplyJob:
            base = params
            if opened is not None:
                base = choose(opened, session.choice.component, session.component.system)
            assert base is not None
            wanted = base if over is None else await _with_overlay(base, over, session)
            info = given or await known_of_session(session, metadata)
            more: ApplyOptions = {"info": info, "partial": partial, "durable": durable}
            return ApplyJob(session, wanted, options, more)

        jobs = [Done(each, result=await job(each)) for each in found]
        if not options.dry_run and options.no_cache and options.backup is None and not url.startswith("sim:"):
            say("the state before is not stored: --no-cache is given, and --backup is not")
        code = await run_jobs(found, jobs)
        return max(code, ExitCode.INCOMPLETE) if opened is not None and opened.left_out else code


async def _with_overlay(base: ParamSet, pattern: str, session: CommandSession) -> ParamSet:
    path = await fill_pattern(pattern, session)
    if not is_file(path):
        raise FileError(f"no such file, which --overlay names for {session.label}", source=path)
    own = choose(open_file(path), session.choice.component, session.component.system)
    check_component(own, base.component, is_extended=base.is_extended)
    params = {**base.params, **own.params}
    return replace(base, params=params, identity=own.identity or base.identity)


# Shared with restore


@dataclass(kw_only=True)
class _Planned:
    """The plan for one vehicle, as it is printed."""

    columns: ClassVar[Sequence[str]] = ("stage", "name", "before", "wanted", "status", "reason")

    job: ApplyJob
    plan: Plan

    def as_json(self) -> JsonObject:
        return plan_json(self.plan, self.job.session.component, full=self.job.flags.full)

    def rows(self) -> Iterator[Sequence[object]]:
        has_started = False
        restart = (None, None, None, Coloured("reboot", "yellow"), "the vehicle reboots")
        for number, stage in enumerate(self.plan.stages, start=1):
            for row in stage.rows:
                purpose = stage.purpose + (", takes effect after a reboot" if row.needs_reboot else "")
                yield number, *_cells(row, row.reason or purpose)
            if self.job.flags.reboot and stage.reboot_first:
                has_started = True
                yield number, *restart
        if self.job.flags.reboot and not has_started and (self.plan.reboot_for or self.plan.awaiting_reboot):
            yield None, *restart
        for row in self.plan.rows.values():
            if row.status is not ApplyStatus.SET and (self.job.flags.full or row.is_shown):
                yield None, *_cells(row, row.why)

    def say_summary(self) -> None:
        session, made = self.job.session, self.plan
        if made.firmware_note:
            say(f"{session.label}: {made.firmware_note}")
        say(f"{session.receiver}: {_counted(made)}; nothing was sent")
        self.job.say_notes(made, made)
        if made.reboot_for and not self.job.flags.reboot:
            names = first_of(made.reboot_for, APPLY_NAMES_MAX)
            say(f"{session.label}: would take effect after a reboot: {names}")

    @property
    def has_work(self) -> bool:
        """Whether something is written."""
        is_refused = bool(self.plan.problems) and not self.job.partial
        waits = self.job.flags.reboot and bool(self.plan.awaiting_reboot)
        return not is_refused and (bool(self.plan.to_write) or waits)

    def check(self) -> int:
        """Report that the vehicle is armed; return the exit code that the command is expected to have."""
        session, code = self.job.session, ExitCode.DONE
        if self.plan.problems and not self.job.partial:
            code = ExitCode.USAGE
        elif any(not row.is_as_wanted for row in self.plan.of(ApplyStatus.SKIPPED, ApplyStatus.INVALID)):
            code = ExitCode.INCOMPLETE
        if session.component.is_armed and not self.job.flags.allow_armed:
            report(f"{session.label} is armed; nothing would be set now without --allow-armed")
            code = max(code, ExitCode.INCOMPLETE)
        return code


@dataclass(eq=False)
class ApplyJob:
    """What apply or restore does with one vehicle, and what became of it.

    Attributes:
        session: the vehicle.
        wanted: the wanted parameters, or the state to restore.
        flags: the options of the subcommand.
        more: further options of `apply`.
        call: `apply` or `restore`.
        own: categories that `call` includes by itself.
        again: the command that continues after an error, if it is not the given command.
        done: a sentence on a complete result; "" for none.
        arrived: the outcomes so far.
        result: the result at the end.
    """

    columns: ClassVar[Sequence[str]] = ("name", "before", "wanted", "now", "status", "reason")

    session: CommandSession
    wanted: ParamSet
    flags: ApplyFlags
    more: ApplyOptions
    call: Callable[..., Awaitable[ApplyResult]] = apply_to_vehicle
    own: tuple[str, ...] = ()
    again: str = ""
    done: str = ""
    arrived: dict[str, ApplyRow] = field(default_factory=dict)
    result: ApplyResult | None = None

    @property
    def partial(self) -> bool:
        """Whether invalid values are skipped."""
        return self.call is not apply_to_vehicle or self.more.get("partial", False)

    async def planned(self) -> _Planned:
        """Return the plan, if it is known before the deadline of the command.

        Raises:
            NoReply: the deadline has passed.
        """
        left = self.session.deadline.left()
        with anyio.move_on_after(left):
            made = await plan(
                self.session.component,
                self.wanted,
                include=(*self.own, *self.flags.include),
                info=self.more.get("info"),
                force=self.flags.force,
            )
            return _Planned(job=self, plan=made)
        raise NoReply(f"the parameters of {self.session.label}", attempts=0, waited=left or 0.0)

    async def run(self, backup: Path | None) -> ApplyJob:
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

        title = f"{'setting' if self.call is apply_to_vehicle else 'restoring'} {session.label}"
        with Status(f"{title}: waiting for the first response", title) as status:
            self.result = await self.call(
                session.component,
                self.wanted,
                include=flags.include,
                force=flags.force,
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
        """Return the JSON of the result; after an interruption, of the outcomes so far."""
        if self.result is None:
            rows = rows_json(self._so_far)
            return {**self.session.ids, "complete": False, "params": rows, "error": "interrupted"}
        return apply_json(self.result, self.session.component, full=self.flags.full)

    def rows(self) -> Iterator[Sequence[object]]:
        """Yield the cells of `APPLIED_COLUMNS`."""
        rows: Iterable[ApplyRow] = self._so_far
        if self.result is not None:
            rows = self.result.rows.values() if self.flags.full else self.result.shown_rows
        for row in rows:
            name, before, wanted, *more = _cells(row, row.why)
            yield name, before, wanted, _text(row.actual, row), *more

    @property
    def _so_far(self) -> list[ApplyRow]:
        """The outcomes before an interruption: no value was read back."""
        unproven, reason = ApplyStatus.UNPROVEN, "acknowledged, and not read back"
        return [
            replace(row, status=unproven, reason=reason) if row.status is ApplyStatus.ACCEPTED else row
            for row in self.arrived.values()
        ]

    def say_summary(self) -> int:
        """Print what became of the vehicle; return the exit code."""
        result, session = self.result, self.session
        assert result is not None
        say(f"{session.receiver}: {_counted(result)} in {result.elapsed:.1f} s")
        self.say_notes(result, result.plan)
        if result.system != session.component.system:
            say(f"{session.address} is {result.system}/{result.component} now")
        if result.reboot_required:
            names = first_of(result.reboot_required, APPLY_NAMES_MAX)
            say(f"{session.label}: takes effect after a reboot: {names}")
        if result.error is not None:
            report(f"{session.label}: {result.error}; {self.to_continue}")
            return max(code_of(result.error), ExitCode.INCOMPLETE)
        if self.done:
            say(f"{session.label}: {self.done}")
        return ExitCode.DONE if result.complete else ExitCode.INCOMPLETE

    def say_notes(self, shown: Rows, made: Plan) -> None:
        """Print what was left out, with the options that write it, and what was not checked."""
        left_out = [
            row for row in shown.of(ApplyStatus.SKIPPED) if row.category in CATEGORIES and row.differs
        ]
        if left_out:
            counts = Counter(row.category for row in left_out)
            listed = ", ".join(f"{count} {category}" for category, count in counts.items())
            options = " ".join(f"--include {category}" for category in counts)
            say(f"{self.session.label}: left out: {listed}; to write them: {options}")
        if made.unchecked_note:
            say(f"{self.session.label}: {made.unchecked_note}")

    @property
    def to_continue(self) -> str:
        """How to continue after an error, in words."""
        return f"to continue: `{self.again}`" if self.again else "run it again to continue"


async def run_jobs(found: Sessions, loaded: Sequence[Done[ApplyJob]]) -> int:
    """Print the plans, or write and print the results, also those so far after an interruption.

    Args:
        found: the vehicles.
        loaded: the job of each vehicle, or the error why there is none.

    Returns:
        The exit code.

    Raises:
        UsageError: --backup gives several vehicles one file.
        FileError: a file of --backup exists.
    """
    failed = [each for each in loaded if each.error is not None]
    jobs = {each.session: each.result for each in loaded if each.result is not None}
    ready, flags = Sessions(jobs), next((job.flags for job in jobs.values()), ApplyFlags())
    backups = {each: await fill_pattern(flags.backup, each) for each in jobs} if flags.backup else {}
    if len(set(backups.values())) < len(backups):
        raise UsageError(f"--backup {flags.backup} names one file for several vehicles")
    files = {each: check_new(name) for each, name in backups.items()}
    if flags.dry_run or (not flags.yes and not flags.json and can_ask()):
        made = await ready.work(lambda session: jobs[session].planned()) if ready else []
        plans = [each.result for each in made if each.result is not None]
        if flags.dry_run or any(each.has_work for each in plans):
            made += [Done(each.session, error=each.error) for each in failed]
            code = found.show(made)
            if not flags.json:
                for each in plans:
                    each.say_summary()
        if flags.dry_run:
            return max([code, *(each.check() for each in plans)])
        if any(each.has_work for each in plans) and not await confirm("go on?"):
            return ExitCode.INCOMPLETE
    try:
        done = await ready.work(lambda session: jobs[session].run(files.get(session))) if ready else []
    except anyio.get_cancelled_exc_class():
        found.show([Done(session, result=job) for session, job in jobs.items()])
        rows = [row for job in jobs.values() for row in job.arrived.values()]
        unproven = sum(row.status is ApplyStatus.ACCEPTED for row in rows)
        say(
            f"interrupted: {counted(unproven, 'value')} acknowledged, not proven, and others may be in "
            f"flight; {'; '.join(dict.fromkeys(job.to_continue for job in jobs.values()))}"
        )
        raise
    code = found.show([*done, *failed])
    return max([code, *(each.result.say_summary() for each in done if each.result is not None)])


def _cells(row: ApplyRow, reason: str) -> list[object]:
    return [
        row.name,
        _text(row.before, row),
        _text(row.wanted.settable, row),
        Coloured(row.status, _STYLES.get(row.status, "")),
        reason,
    ]


def _text(value: WireValue | None, row: ApplyRow) -> str | None:
    return None if value is None else format_value(*typed(value, row.type))


def _counted(rows: Rows) -> str:
    counts = rows.counts
    found = [f"{counts[kind]} {_WORDS.get(kind, kind)}" for kind in ApplyStatus if counts.get(kind)]
    return ", ".join(found) or "nothing to set"
