"""The subcommand reset: sets parameters to the firmware's defaults."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Final

import anyio
from cyclopts import Parameter
from cyclopts.validators import Number

from paramclient.cli.confirmation import can_confirm, confirm
from paramclient.cli.default_sources import say_sources
from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.json_output import VehicleJson
from paramclient.cli.metadata import (
    MetadataChoice,
    from_file,
    known_of_session,
    request_from_vehicle,
)
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import (
    Coloured,
    by_index,
    print_json,
    print_table,
    printable,
    report,
    say,
)
from paramclient.cli.param_names import ChosenNames, check_given, suggest
from paramclient.cli.read_commands import fetch_table
from paramclient.cli.session import CommandSession, announce_write, connect
from paramclient.cli.write_outcomes import (
    outcome_cells,
    outcomes_code,
    report_outcomes,
    summary,
    write_all,
    writes_json,
)
from paramclient.client.component import SETTLE_MAX
from paramclient.errors import NoReply, ParamClientError, UsageError, VehicleError
from paramclient.metadata import Metadata
from paramclient.model.defaults import DefaultSource, default_of
from paramclient.model.names import is_group_switch, is_pattern
from paramclient.model.notation import typed, value_json
from paramclient.model.values import Param, Trust, WireValue, bits_of, format_value, same_bits
from paramclient.model.wording import counted, first_of
from paramclient.protocol.set_results import SetOutcome
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
    settle: Annotated[float, Parameter(validator=Number(gte=0, lte=SETTLE_MAX))] = 0.0,
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
    async with connect(url, options, writes=True) as session:
        fetched = await fetch_table(session)
        chosen, read_only = (await _chosen(session, name_patterns), ()) if names else _all_names(session)
        if chosen is None:
            return ExitCode.INCOMPLETE
        code = ExitCode.DONE
        if fetched.missing and any(map(is_pattern, name_patterns or "*")):
            report(f"incomplete: {counted(len(fetched.missing), 'parameter')} were not received")
            code = ExitCode.INCOMPLETE
        component, deadline = session.component, session.deadline
        params = await _read_unconfirmed(
            component.params, lambda name: component.get(name, timeout=deadline.left()), chosen
        )
        if described is None:
            described = await _known(session, metadata, params)
        plan = _ResetPlan.of(session, params, described, read_only, lists_unknown=not changed)
        if plan.choice.without_default:
            code = ExitCode.INCOMPLETE
        if dry_run:
            plan.print_planned()
            return code
        if plan.choice.values and not yes and can_confirm(options):
            plan.print_planned()
            if not await confirm("go on?"):
                return ExitCode.INCOMPLETE
        outcomes: Sequence[SetOutcome] = []
        began = anyio.current_time()
        if plan.choice.values:
            await session.check_only()
            await announce_write([session])
            outcomes = await write_all(
                session,
                [*plan.choice.values.items()],
                plan.print_outcomes,
                verb="resetting",
                settle=settle,
                force=False,
                durable=durable,
            )
        line = summary(session, outcomes, anyio.current_time() - began)
    plan.print_outcomes(outcomes)
    if not options.json:
        say(f"{line if outcomes else plan.nothing}; {len(plan.choice.unchanged)} had their default already")
        plan.say_sources()
    report_outcomes(outcomes, described)
    plan.report_unwritten()
    return max(code, outcomes_code(outcomes))


def _all_names(session: CommandSession) -> tuple[list[str], tuple[str, ...]]:
    """Return the names of all parameters in the order of their writes, and those of read-only ones apart."""
    rules = rules_for(session.component.autopilot)
    writable: list[str] = []
    read_only: list[str] = []
    for param in by_index(session.component.params.values()):
        rule = rules.left_out(param.name)
        (read_only if rule is not None and rule.category == READ_ONLY else writable).append(param.name)
    return _in_order(session, writable), tuple(read_only)


async def _chosen(session: CommandSession, name_patterns: Sequence[str]) -> list[str] | None:
    """Return the names that names and patterns choose; None after a report of the unknown ones."""
    chosen = ChosenNames.of(session.component, name_patterns)
    errors: dict[str, ParamClientError] = {**chosen.errors}
    for name in chosen.names:
        if name not in session.component.params:
            try:
                await session.component.get(name, timeout=session.deadline.left())
            except VehicleError as error:
                errors[name] = error
    if not errors:
        return _in_order(session, chosen.names)
    for unknown in (await suggest(session, errors)).values():
        report(str(unknown))
    report("nothing was written")
    return None


def _in_order(session: CommandSession, names: Sequence[str]) -> list[str]:
    """Return the names in the order of their writes.

    Switches such as *_ENABLE come last: their defaults may hide the parameters of their group.
    """
    autopilot = session.component.autopilot
    return sorted(names, key=lambda name: is_group_switch(name, autopilot))


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
        say(printable(f"{session.label} gives no metadata with defaults: {error}"))
        return None


@dataclass(frozen=True, slots=True)
class _ResetChoice:
    """The values that a reset writes.

    Attributes:
        values: the defaults to write, by name, in the order of the names.
        unchanged: names of parameters that have their default already.
        without_default: names of parameters without a known default.
    """

    values: Mapping[str, WireValue]
    unchanged: tuple[str, ...]
    without_default: tuple[str, ...]

    @classmethod
    def of(cls, params: Iterable[Param], defaults: Mapping[str, WireValue]) -> _ResetChoice:
        """Choose the values to write.

        Args:
            params: the current parameters.
            defaults: defaults of parameters whose default the vehicle has not given; the vehicle's own
                default has priority.
        """
        values: dict[str, WireValue] = {}
        unchanged, unknown = [], []
        for param in params:
            default = defaults.get(param.name) if param.default is None else param.default
            if default is None:
                unknown.append(param.name)
            elif _has_value(param, default):
                unchanged.append(param.name)
            else:
                values[param.name] = default
        return cls(values, tuple(unchanged), tuple(unknown))


@dataclass(frozen=True, slots=True)
class _ResetPlan:
    """The values that a reset writes, and their output.

    Attributes:
        session: the session.
        choice: the values.
        params: the parameters before the reset, by name.
        described: metadata of the vehicle, or None.
        read_only: names of parameters that the vehicle lets no client write, and that were not named.
    """

    session: CommandSession
    choice: _ResetChoice
    params: Mapping[str, Param]
    described: Metadata | None
    read_only: tuple[str, ...]

    @classmethod
    def of(
        cls,
        session: CommandSession,
        params: Sequence[Param],
        described: Metadata | None,
        read_only: tuple[str, ...],
        *,
        lists_unknown: bool,
    ) -> _ResetPlan:
        """Choose the values to write.

        Args:
            session: the session.
            params: the parameters to reset.
            described: metadata of the vehicle, or None.
            read_only: as the attribute.
            lists_unknown: whether parameters without a known default are listed.
        """
        defaults = {} if described is None else described.defaults_of(each.name for each in params)
        if not lists_unknown:
            params = [each for each in params if each.default is not None or each.name in defaults]
        choice = _ResetChoice.of(params, defaults)
        return cls(session, choice, {each.name: each for each in params}, described, read_only)

    @property
    def nothing(self) -> str:
        """The line about a reset without a value to write."""
        return f"nothing to set on {self.session.receiver}"

    def print_planned(self) -> None:
        """Print the values that would be sent."""
        choice = self.choice
        if self.session.options.json:
            values = [
                {
                    "name": name,
                    "value": value_json(self.params[name].settable, self.params[name].type_number),
                    "default": value_json(*typed(value, self.params[name].type_number)),
                    "source": self._source(name).value,
                }
                for name, value in choice.values.items()
            ]
            print_json({"vehicle": self._vehicle, "dry_run": True, "values": values, **self._unwritten})
            return
        rows: list[tuple[object, ...]] = [
            (name, self._before(name), self._default(name), f"default of {self._source(name)}")
            for name in choice.values
        ]
        rows += [(name, self._before(name), None, _NO_DEFAULT) for name in choice.without_default]
        if rows:
            print_table(["name", "now", "default", "status"], rows, right="now default")
        say(
            printable(
                f"{self.session.receiver}: {len(choice.values)} to reset, {len(choice.unchanged)} with their "
                f"default, {len(choice.without_default)} without a known default; nothing was sent"
            )
        )
        self.say_sources()

    def print_outcomes(self, outcomes: Sequence[SetOutcome]) -> None:
        """Print the outcomes as a table or as JSON."""
        if self.session.options.json:
            results = writes_json(self.session, outcomes, self.described)
            print_json({"vehicle": self._vehicle, "results": results, **self._unwritten})
            return
        rows: list[tuple[object, ...]] = []
        for outcome in outcomes:
            name, _, actual, status = outcome_cells(self.session, outcome)
            rows.append((name, self._before(outcome.name), self._default(outcome.name), actual, status))
        for name in self.choice.without_default:
            before = self._before(name)
            rows.append((name, before, None, before, _NO_DEFAULT))
        if rows:
            print_table(["name", "before", "default", "now", "status"], rows, right="before default now")

    def say_sources(self) -> None:
        """Print how many of the defaults are from the metadata, which has none of an airframe."""
        values = self.choice.values
        say_sources(
            self.session.label, [default_of(self.params[name], each) for name, each in values.items()]
        )

    def report_unwritten(self) -> None:
        """Print a line about the read-only parameters, and one about those without a known default."""
        if self.read_only and not self.session.options.json:
            say(printable(f"left out, as they can only be read: {first_of(self.read_only, RESET_NAMES_MAX)}"))
        unknown = self.choice.without_default
        if unknown:
            names = first_of(unknown, RESET_NAMES_MAX)
            report(f"not written, as their default is not known: {names}")

    @property
    def _vehicle(self) -> VehicleJson:
        return VehicleJson.of(self.session.component)

    @property
    def _unwritten(self) -> dict[str, object]:
        """The JSON of the names that are not written."""
        return {
            "unchanged": [*self.choice.unchanged],
            "without_default": [*self.choice.without_default],
            "read_only": [*self.read_only],
        }

    def _source(self, name: str) -> DefaultSource:
        """Return the origin of a default that is written."""
        return DefaultSource.METADATA if self.params[name].default is None else DefaultSource.VEHICLE

    def _before(self, name: str) -> str:
        param = self.params[name]
        return format_value(param.settable, param.type_number)

    def _default(self, name: str) -> str:
        return format_value(*typed(self.choice.values[name], self.params[name].type_number))


_NO_DEFAULT: Final = Coloured("no known default", "yellow")
"""The cell of a parameter that is not written."""


async def _read_unconfirmed(
    table: Mapping[str, Param], read: Callable[[str], Awaitable[Param]], names: Iterable[str]
) -> list[Param]:
    """Return parameters of a fetched table in the order of the names; read those that are only cached.

    Args:
        table: `Component.params`.
        read: reads a parameter into the table.
        names: param_ids; of equal ones the first counts.

    Raises:
        UnknownParameter: the vehicle has no parameter with one of the names.
        ParamClientError: as from `Component.get`.
    """
    params = []
    for name in dict.fromkeys(names):
        param = table.get(name)
        if param is None or param.trust is Trust.CACHED:
            await read(name)
            param = table[name]
        params.append(param)
    return params


def _has_value(param: Param, value: WireValue) -> bool:
    """Return whether a parameter has this value, as far as its type can represent the value."""
    try:
        return same_bits(param.type_number, param.bits, bits_of(value, param.type_number))
    except UsageError:  # not in the range of the type; the write reports it
        return False
