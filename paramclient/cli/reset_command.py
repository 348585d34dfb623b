"""The subcommand reset: sets parameters to the firmware's defaults."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Final

from cyclopts import Parameter

from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.json_output import JsonObject, param_value, vehicle_json
from paramclient.cli.metadata import (
    MetadataChoice,
    from_file,
    known_of_session,
    request_from_vehicle,
    say_sources,
)
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import Coloured, by_index, can_ask, confirm, report, say
from paramclient.cli.param_names import check_given
from paramclient.cli.read_commands import get_chosen, report_all
from paramclient.cli.session import CommandSession, Done, sessions
from paramclient.cli.writes import WriteJob, write_all
from paramclient.errors import NoReply, UsageError, VehicleError
from paramclient.metadata import Metadata
from paramclient.model.defaults import Default, default_of
from paramclient.model.names import is_group_switch, is_pattern
from paramclient.model.notation import value_json
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
        metadata: A file that describes parameters; or vehicle, to download the vehicle's own metadata.
        yes: Do not ask for confirmation.
    """
    if bool(names) + all_ + changed != 1:
        raise UsageError("reset takes names, or --all, or --changed")
    chosen, given = check_given(names), from_file(metadata)
    async with sessions(url, options, writes=True) as found:
        plans: list[_Plan] = []
        codes, failed = [int(ExitCode.DONE)], list[int]()
        for each in found:
            fetched = await each.fetch()
            params, errors = await get_chosen(each, chosen or ["*"], is_fetched=True)
            failed += [report_all(errors.values(), each.prefix)] if errors else []
            if fetched.missing and any(map(is_pattern, chosen or "*")):
                report(f"{each.prefix}incomplete: {counted(len(fetched.missing), 'parameter')} not received")
                codes.append(ExitCode.INCOMPLETE)
            described = given or await _known(each, metadata, params)
            plans.append(_plan(each, params, described, is_named=bool(names), changed=changed))
        if failed:
            report("nothing was written")
            return max(failed)
        if any(plan.without_default for plan in plans):
            codes.append(ExitCode.INCOMPLETE)
        asks = any(plan.writes for plan in plans) and not yes and not options.json and can_ask()
        if dry_run or asks:
            found.show([Done(each.session, each) for each in plans])
        if dry_run:
            for plan in [] if options.json else plans:
                say(f"{plan.session.receiver}: {len(plan.writes)} to reset, {plan.others}; nothing was sent")
                say_sources(plan.session.label, plan.defaults)
            return max(codes)
        if asks and not await confirm("go on?"):
            return ExitCode.INCOMPLETE
        codes.append(await write_all(found, [plan.job() for plan in plans]))
    for plan in plans:
        plan.report()
    return max(codes)


@dataclass(frozen=True, slots=True)
class _Plan:
    """What a reset would write to one vehicle.

    Attributes:
        session: the vehicle.
        described: its metadata, or None.
        writes: parameters and their defaults.
        unchanged: names of parameters that have their default already.
        without_default: parameters without a known default.
        read_only: names of parameters that the vehicle lets no client write, and that were not named.
    """

    columns: ClassVar[Sequence[str]] = ("name", "now", "default", "status")

    session: CommandSession
    described: Metadata | None
    writes: list[tuple[Param, Default]] = field(default_factory=list)
    unchanged: list[str] = field(default_factory=list)
    without_default: list[Param] = field(default_factory=list)
    read_only: list[str] = field(default_factory=list)

    @property
    def defaults(self) -> list[Default]:
        """The defaults that are written, with their origins."""
        return [default for _, default in self.writes]

    @property
    def others(self) -> str:
        """The numbers of parameters that are not written, in words."""
        without = len(self.without_default)
        return f"{len(self.unchanged)} with their default, {without} without a known default"

    @property
    def unwritten(self) -> JsonObject:
        """The JSON of the names that are not written."""
        without = [param.name for param in self.without_default]
        return {"unchanged": self.unchanged, "without_default": without, "read_only": self.read_only}

    def job(self) -> WriteJob:
        """Return the writes."""
        writes: dict[str, WireValue] = {param.name: default.value for param, default in self.writes}
        before = {param.name: param for param, _ in self.writes}
        return WriteJob(self.session, writes, self.described, before, self.unwritten)

    def as_json(self) -> JsonObject:
        """Return the JSON of the values that would be sent."""
        values = [
            {
                "name": param.name,
                "value": param_value(param),
                "default": value_json(default.value, param.type),
                "source": default.source,
            }
            for param, default in self.writes
        ]
        vehicle = vehicle_json(self.session.component)
        return {"vehicle": vehicle, "dry_run": True, "values": values, **self.unwritten}

    def rows(self) -> Iterator[Sequence[object]]:
        """Yield the values that would be sent, then the parameters without a known default."""
        for param, default in self.writes:
            text = format_value(default.value, param.type)
            yield param.name, _text(param), text, f"default of {default.source}"
        for param in self.without_default:
            yield param.name, _text(param), None, Coloured("no known default", "yellow")

    def report(self) -> None:
        """Print what was not written, and which defaults are from the metadata."""
        prefix = self.session.prefix
        if not self.session.options.json:
            say(f"{prefix}{self.others}")
            if self.read_only:
                listed = first_of(self.read_only, RESET_NAMES_MAX)
                say(f"{prefix}left out, as they can only be read: {listed}")
            say_sources(self.session.label, self.defaults)
        if self.without_default:
            listed = first_of([param.name for param in self.without_default], RESET_NAMES_MAX)
            report(f"{prefix}not written, as their default is not known: {listed}")


def _plan(
    session: CommandSession,
    params: Sequence[Param],
    described: Metadata | None,
    *,
    is_named: bool,
    changed: bool,
) -> _Plan:
    """Choose the values to write; unless they are named, all that the vehicle lets a client write.

    Switches such as *_ENABLE come last: their defaults may hide the parameters of their group.
    """
    autopilot = session.component.autopilot
    rules, plan = rules_for(autopilot), _Plan(session, described)
    known = {} if described is None else described.defaults_of(each.name for each in params)
    if not is_named:
        params = by_index(params)
    for param in sorted(params, key=lambda each: is_group_switch(each.name, autopilot)):
        rule = None if is_named else rules.left_out(param.name)
        default = default_of(param, known.get(param.name))
        if rule is not None and rule.category == READ_ONLY:
            plan.read_only.append(param.name)
        elif default is not None and _has_value(param, default.value):
            plan.unchanged.append(param.name)
        elif default is not None:
            plan.writes.append((param, default))
        elif not changed:
            plan.without_default.append(param)
    return plan


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


def _text(param: Param) -> str:
    return format_value(param.settable, param.type)


def _has_value(param: Param, value: WireValue) -> bool:
    return same_bits(param.type, param.bits, bits_of(value, param.type))
