"""The subcommand reset: sets parameters to the firmware's defaults."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Final

from cyclopts import Parameter

from paramclient.cli.default_sources import say_sources
from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.json_output import JsonObject, vehicle_json
from paramclient.cli.metadata import MetadataChoice, from_file, known_of_session, request_from_vehicle
from paramclient.cli.options import LinkOptions, Settle
from paramclient.cli.output import Coloured, by_index, can_ask, confirm, report, say
from paramclient.cli.param_names import check_given
from paramclient.cli.read_commands import get_chosen, report_all
from paramclient.cli.session import CommandSession, Done, sessions
from paramclient.cli.set_command import WriteJob, write_all
from paramclient.errors import NoReply, ParamClientError, UsageError, VehicleError
from paramclient.metadata import Metadata
from paramclient.model.defaults import Default, DefaultSource, default_of
from paramclient.model.names import is_group_switch, is_pattern
from paramclient.model.notation import typed, value_json
from paramclient.model.values import Param, WireValue, bits_of, format_value, same_bits
from paramclient.model.wording import counted, first_of
from paramclient.provision.apply_rules import READ_ONLY, rules_for

__all__ = ["reset"]

RESET_NAMES_MAX: Final = 10
"""Parameters that a line names, so that it stays short; it gives the number of further ones."""

_DEFAULTS: Final = LinkOptions()


async def reset(
    url: str,
    /,
    *names: str,
    all_: Annotated[bool, Parameter(name="--all")] = False,
    changed: bool = False,
    dry_run: bool = False,
    settle: Settle = 0.0,
    durable: bool = False,
    metadata: MetadataChoice = None,
    yes: bool = False,
    options: LinkOptions = _DEFAULTS,
) -> int:
    """Set parameters to the firmware's defaults, and verify each by the value that the vehicle reports.

    Fetches the table first. ArduPilot, and PX4 from 1.18 on, give the defaults in the parameter file over
    MAVFTP; defaults that the vehicle does not give are taken from its metadata. Parameters without a known
    default are listed and not written. On a terminal, the changes are shown and must be confirmed. If several
    vehicles are heard, --vehicle must choose one.

    Exit code 1: a value was refused, a name is unknown, a default is not known, or the changes were not
    confirmed.

    Args:
        url: The link.
        names: The parameters, in upper or lower case, or patterns such as "MC_*".
        all_: Reset all parameters, also the system id, calibration and statistics, except those that the
            vehicle lets no client write.
        changed: Reset all parameters that differ from their default, as far as it is known. The same
            exception.
        dry_run: Print the values that would be sent, and send none of them.
        settle: Seconds to watch each value before it is read again, as with set.
        durable: End only when all values and their history are on the disk and survive a power loss.
        metadata: A file that describes parameters; or vehicle, to download the vehicle's own metadata.
        yes: Do not ask for confirmation.
    """
    if bool(names) + all_ + changed != 1:
        raise UsageError("reset takes names, or --all, or --changed")
    name_patterns = check_given(names)
    described = from_file(metadata)
    async with sessions(url, options, writes=True) as found:
        jobs = {
            each: await _prepare(each, name_patterns, described, metadata, changed=changed) for each in found
        }
        errors = [report_all(job.errors.values(), each.prefix) for each, job in jobs.items() if job.errors]
        if errors:
            report("nothing was written")
            return max(errors)
        code = max(job.code for job in jobs.values())
        writes = any(job.writes for job in jobs.values())
        asks = writes and not yes and not options.json and can_ask()
        if dry_run or asks:
            planned = [Done(each, _Planned(job)) for each, job in jobs.items()]
            found.show(planned, ["name", "now", "default", "status"], "now default")
            for job in jobs.values() if not options.json else []:
                say(job.planned)
                say_sources(job.session.label, job.sources)
        if dry_run:
            return code
        if asks and not await confirm("go on?"):
            return ExitCode.INCOMPLETE
        written = await write_all(found, jobs, settle=settle, force=False, durable=durable)
    for job in jobs.values():
        if not options.json:
            say_sources(job.session.label, job.sources)
    return max(code, written)


@dataclass
class _ResetJob(WriteJob):
    """The defaults that a reset writes to one vehicle.

    Attributes:
        before: the parameters before the reset, by name.
        unchanged: names of parameters that have their default already.
        without_default: names of parameters without a known default.
        read_only: names of parameters that the vehicle lets no client write, and that were not named.
        errors: the unknown names.
        is_incomplete: whether parameters of a pattern were not received.
    """

    columns: ClassVar[Sequence[str]] = ("name", "before", "default", "now", "status")
    right: ClassVar[str] = "before default now"
    verb: ClassVar[str] = "resetting"

    before: Mapping[str, Param] = field(default_factory=dict)
    unchanged: Sequence[str] = ()
    without_default: Sequence[str] = ()
    read_only: Sequence[str] = ()
    errors: Mapping[str, ParamClientError] = field(default_factory=dict)
    is_incomplete: bool = False

    @property
    def sources(self) -> list[Default | None]:
        """The defaults that are written, with their origins."""
        return [default_of(self.before[name], value) for name, value in self.writes]

    @property
    def planned(self) -> str:
        """The line about the values that would be written."""
        return (
            f"{self.session.receiver}: {len(self.writes)} to reset, {len(self.unchanged)} with their "
            f"default, {len(self.without_default)} without a known default; nothing was sent"
        )

    def summary(self, more: str) -> str:
        """Return the numbers of outcomes in words."""
        done = super().summary(more) if self.writes else f"nothing to set on {self.session.receiver}"
        return f"{done}; {len(self.unchanged)} had their default already"

    @property
    def code(self) -> int:
        """The exit code for what is not written, and for all outcomes."""
        is_part = self.is_incomplete or self.without_default
        return max(super().code, ExitCode.INCOMPLETE if is_part else ExitCode.DONE)

    @property
    def unwritten(self) -> JsonObject:
        """The JSON of the names that are not written."""
        names = ("unchanged", "without_default", "read_only")
        return {name: [*getattr(self, name)] for name in names}

    def as_json(self) -> JsonObject:
        """Return the JSON of the vehicle, the outcomes, and the names that are not written."""
        return super().as_json() | self.unwritten

    def rows(self) -> Iterator[Sequence[object]]:
        """Yield the values before and after."""
        for (name, _, actual, status), row in zip(super().rows(), self.planned_rows(), strict=False):
            yield name, *row[1:3], actual, status
        for name, before, default, status in self.planned_rows():
            if default is None:
                yield name, before, None, before, status

    def planned_rows(self) -> Iterator[Sequence[object]]:
        """Yield the values that would be sent, then the parameters without a known default."""
        for name, value in self.writes:
            param = self.before[name]
            default = format_value(*typed(value, param.type_number))
            yield name, _text(param), default, f"default of {_source(param)}"
        for name in self.without_default:
            yield name, _text(self.before[name]), None, Coloured("no known default", "yellow")

    def report(self) -> None:
        """Print remarks, errors, and what was not written."""
        super().report()
        prefix = self.session.prefix
        if self.read_only and not self.session.options.json:
            names = first_of(self.read_only, RESET_NAMES_MAX)
            say(f"{prefix}left out, as they can only be read: {names}")
        if self.without_default:
            names = first_of(self.without_default, RESET_NAMES_MAX)
            report(f"{prefix}not written, as their default is not known: {names}")


@dataclass(frozen=True, slots=True)
class _Planned:
    """What a reset would write."""

    job: _ResetJob

    def as_json(self) -> JsonObject:
        """Return the JSON of the values that would be sent."""
        before = self.job.before
        values = [
            {
                "name": name,
                "value": value_json(before[name].settable, before[name].type_number),
                "default": value_json(*typed(value, before[name].type_number)),
                "source": _source(before[name]).value,
            }
            for name, value in self.job.writes
        ]
        vehicle = vehicle_json(self.job.session.component)
        return {"vehicle": vehicle, "dry_run": True, "values": values, **self.job.unwritten}

    def rows(self) -> Iterator[Sequence[object]]:
        """Yield the rows."""
        return self.job.planned_rows()


async def _prepare(
    session: CommandSession,
    names: Sequence[str],
    described: Metadata | None,
    choice: MetadataChoice,
    *,
    changed: bool,
) -> _ResetJob:
    """Choose the values to write; without names, all that the vehicle lets a client write.

    Switches such as *_ENABLE come last: their defaults may hide the parameters of their group.
    """
    autopilot = session.component.autopilot
    fetched = await session.fetch()
    is_part = bool(fetched.missing) and any(map(is_pattern, names or "*"))
    if is_part:
        missing = counted(len(fetched.missing), "parameter")
        report(f"{session.prefix}incomplete: {missing} were not received")
    params, errors = await get_chosen(session, names or ["*"], is_fetched=True)
    read_only: list[str] = []
    if not names:
        rules = rules_for(autopilot)
        excluded = {each.name: rules.left_out(each.name) for each in by_index(params)}
        read_only = [name for name, rule in excluded.items() if rule and rule.category == READ_ONLY]
        params = [each for each in by_index(params) if each.name not in read_only]
    if described is None:
        described = await _known(session, choice, params)
    defaults = {} if described is None else described.defaults_of(each.name for each in params)
    writes: list[tuple[str, WireValue]] = []
    unchanged: list[tuple[str, WireValue]] = []
    unknown: list[str] = []
    for param in sorted(params, key=lambda each: is_group_switch(each.name, autopilot)):
        default = defaults.get(param.name) if param.default is None else param.default
        if default is not None:
            (unchanged if _has_value(param, default) else writes).append((param.name, default))
        elif not changed:
            unknown.append(param.name)
    return _ResetJob(
        session,
        writes,
        described,
        before={each.name: each for each in params},
        unchanged=[name for name, _ in unchanged],
        without_default=unknown,
        read_only=read_only,
        errors=errors,
        is_incomplete=is_part,
    )


async def _known(session: CommandSession, choice: str | None, params: Sequence[Param]) -> Metadata | None:
    """Return the metadata of the vehicle, or None if there is none.

    Without a choice of the user, it is downloaded only if the vehicle does not give a default.
    """
    found = await known_of_session(session, choice)
    if found is not None or all(param.default is not None for param in params):
        return found
    try:
        return await request_from_vehicle(session)
    except (UsageError, VehicleError, NoReply) as error:
        say(f"{session.label} gives no metadata with defaults: {error}")
        return None


def _source(param: Param) -> DefaultSource:
    """Return the origin of a default that is written."""
    return DefaultSource.METADATA if param.default is None else DefaultSource.VEHICLE


def _text(param: Param) -> str:
    return format_value(param.settable, param.type_number)


def _has_value(param: Param, value: WireValue) -> bool:
    """Return whether a parameter has this value, as far as its type can represent the value."""
    try:
        return same_bits(param.type_number, param.bits, bits_of(value, param.type_number))
    except UsageError:  # not in the range of the type; the write reports it
        return False
