"""The plan of an `apply`: the values to write, their order, and reasons for parameters that are not written.

The parameters that no `apply` writes are in `apply_rules.toml`.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final, TypedDict, Unpack

from paramclient.errors import UsageError
from paramclient.metadata import ParamInfo
from paramclient.model.comparison import same_value
from paramclient.model.identity import Identity, autopilot_name, reason_against_non_finite, version_difference
from paramclient.model.names import is_group_switch, nearest_names
from paramclient.model.paramset import AnyParams, ParamSet, WrittenParam, set_of
from paramclient.model.values import Encoding, ParamType, Value, format_value
from paramclient.protocol.dialect import EXTENDED, PLAIN
from paramclient.provision.apply_rules import ACTION, OUT_OF_RANGE, READ_ONLY, Choice, rules_for

MISSING: Final = "missing"
"""The category of a parameter that the vehicle does not have."""
WRONG: Final = "wrong"
"""The category of a value that the parameter's type cannot take, or that cannot be sent."""
SUGGESTIONS_MAX: Final = 40
"""Missing names up to which similar names are suggested. With more, the file is for another vehicle and has
no typing errors."""


class PlanOptions(TypedDict, total=False):
    """Options of `plan` and `plan_from`, and of `apply`.

    Attributes:
        include: categories (`CATEGORIES`) and globs of names to set although the list leaves them out.
        info: metadata by name.
        force: allow values outside of the range in the metadata, and NaN and infinity for every autopilot.
    """

    include: str | Iterable[str]
    info: Mapping[str, ParamInfo] | None
    force: bool


class ApplyStatus(StrEnum):
    """The planned action for a wanted parameter, or its outcome."""

    SET = "set"
    """Planned: the value differs and is to be written."""
    LATER = "later"
    """Planned: the vehicle does not have the parameter now; a step of the plan may reveal it, going by its
    name, and then it is set."""
    ACCEPTED = "accepted"
    """The value was written, and read back at the end."""
    ADJUSTED = "adjusted"
    """The value was written, and the vehicle changed it, immediately or within a second."""
    REFUSED = "refused"
    """Also planned: the vehicle refused the value or lacks the parameter, or the value cannot be sent."""
    UNCHANGED = "unchanged"
    """The vehicle has the value already."""
    SKIPPED = "skipped"
    """Also planned: left out on purpose; `reason` says why."""
    UNPROVEN = "unproven"
    """The value was acknowledged, and could not be read back at the end."""
    UNKNOWN = "unknown"
    """The value was sent and not acknowledged: the vehicle may have it."""
    NOT_TRIED = "not tried"
    """The value was not sent: `apply` ended before."""


@dataclass(frozen=True, slots=True)
class ApplyRow:
    """What is planned for one wanted parameter, or what became of it.

    Attributes:
        wanted: the parameter as the file has it.
        status: the planned action, or the outcome.
        before: the value before `apply`, or None if the vehicle did not have the parameter.
        actual: the value that the vehicle last sent, or None; None in a plan.
        type: the vehicle's type of the parameter; None if unknown.
        category: for skipped and refused parameters, the kind of reason: one of `CATEGORIES`, "action",
            `MISSING`, or `WRONG`; else "".
        reason: the reason for the status as a sentence; may be "".
        nearest: for a parameter that the vehicle does not have, the most similar names, most similar first.
        needs_reboot: whether a change takes effect after a reboot.
    """

    wanted: WrittenParam
    status: ApplyStatus
    before: Value | None = None
    actual: Value | None = None
    type: ParamType | int | None = None
    category: str = ""
    reason: str = ""
    nearest: tuple[str, ...] = ()
    needs_reboot: bool = False

    @property
    def name(self) -> str:
        """The param_id in the file."""
        return self.wanted.name

    @property
    def differs(self) -> bool:
        """Whether the vehicle had another value than the wanted one, or no such parameter."""
        return self.before is None or not _is_same(self.wanted.settable, self.before, self.type)

    @property
    def is_as_wanted(self) -> bool:
        """Whether the vehicle has the wanted value, or the parameter is left out on purpose."""
        return self.status in (ApplyStatus.ACCEPTED, ApplyStatus.UNCHANGED, ApplyStatus.SKIPPED)

    @property
    def is_shown(self) -> bool:
        """Whether to show the row: not unchanged parameters and left-out ones that do not differ."""
        return self.differs if self.status is ApplyStatus.SKIPPED else self.status != ApplyStatus.UNCHANGED

    @property
    def why(self) -> str:
        """The reason, with the similar names."""
        return f"{self.reason} (did you mean {', '.join(self.nearest)}?)" if self.nearest else self.reason

    def __str__(self) -> str:
        kind = ParamType.REAL32 if self.type is None else self.type
        now = self.wanted.settable if self.actual is None else self.actual
        is_changed = self.before is not None and not _is_same(now, self.before, self.type)
        before = f"{format_value(self.before, kind)} ->" if self.before is not None and is_changed else "="
        why = f": {self.why}" if self.why else ""
        return f"{self.name} {before} {format_value(now, kind)}, {self.status}{why}"


@dataclass(frozen=True, slots=True)
class Stage:
    """Values that are written concurrently, before those of the next stage.

    Attributes:
        purpose: what the values have in common, in words.
        rows: the values, in the order of the file.
        reveals: whether other parameters may appear afterwards.
        reboot_first: whether the vehicle must reboot before the next stage: values that are set before the
            reboot would be lost, or their parameters do not exist yet.
    """

    purpose: str
    rows: tuple[ApplyRow, ...]
    reveals: bool = False
    reboot_first: bool = False


@dataclass(frozen=True, slots=True)
class Rows:
    """Rows of parameters.

    Attributes:
        rows: by name in the file, one row for each wanted parameter, in the order of the file.
    """

    rows: Mapping[str, ApplyRow]

    @property
    def counts(self) -> Mapping[ApplyStatus, int]:
        """The number of rows with each status that occurs, in the order of the statuses."""
        found = Counter(row.status for row in self.rows.values())
        return Counter({status: found[status] for status in ApplyStatus if found[status]})

    @property
    def summary(self) -> str:
        """The number of rows with each status, in words."""
        return ", ".join(f"{count} {status}" for status, count in self.counts.items()) or "nothing"

    @property
    def complete(self) -> bool:
        """Whether the vehicle has all wanted values, except those left out on purpose."""
        return all(row.is_as_wanted for row in self.rows.values())

    @property
    def shown_rows(self) -> list[ApplyRow]:
        """The rows to show: all except unchanged parameters and left-out ones that do not differ."""
        return [row for row in self.rows.values() if row.is_shown]

    def of(self, *statuses: ApplyStatus) -> list[ApplyRow]:
        """Return the rows with one of these statuses, in order."""
        return [row for row in self.rows.values() if row.status in statuses]


@dataclass(frozen=True, slots=True)
class Plan(Rows):
    """What an `apply` would write, see `plan`; `complete` if it is nothing.

    Attributes:
        stages: the rows of the values to write, in the order of writing. After a stage that reveals
            parameters, and after a reboot, the vehicle is read again and a new plan is made; the later stages
            are those known so far.
        problems: by name, why `apply` refuses the file: invalid values, and names that the vehicle does not
            have and no step may reveal.
        extra: names that the vehicle has and the wanted parameters do not have; they are not changed.
        unchecked: names of numbers to write whose range was not checked: there is no metadata of them.
        firmware: the identities of the file and of the vehicle, if both are known; else ().
        awaiting_reboot: switches that are on and whose group is missing: they take effect after a reboot,
            and the vehicle may not have rebooted since they were set; and a system id that is not used yet.
        system_id: the wanted system id; None without one, or if it is left out.
    """

    stages: tuple[Stage, ...]
    problems: Mapping[str, str]
    extra: tuple[str, ...] = ()
    unchecked: tuple[str, ...] = ()
    firmware: tuple[Identity, ...] = ()
    awaiting_reboot: tuple[str, ...] = ()
    system_id: Value | None = None

    @property
    def firmware_note(self) -> str:
        """The firmware versions of the file and the vehicle, as a sentence; "" unless they differ."""
        return version_difference(*self.firmware) if self.firmware else ""

    @property
    def unchecked_note(self) -> str:
        """The number of values whose range was not checked, as a sentence; "" if there is none."""
        count, total = len(self.unchecked), len(self.to_write)
        return f"ranges not checked: {count} of {total} have no metadata" if count else ""

    @property
    def to_write(self) -> list[ApplyRow]:
        """All values to write, in order."""
        return [row for stage in self.stages for row in stage.rows]

    @property
    def reboot_for(self) -> tuple[str, ...]:
        """The names of values to write that take effect after a reboot."""
        return tuple(row.name for row in self.to_write if row.needs_reboot)

    def check_state(self) -> None:
        """Check that the wanted parameters may be an earlier state of the vehicle; a file may not name it.

        Raises:
            UsageError: the vehicle lacks most of them.
        """
        absent = [row for row in self.of(ApplyStatus.REFUSED) if row.category == MISSING]
        if len(absent) > max(SUGGESTIONS_MAX, len(self.rows) / 2):
            raise UsageError("nothing was sent: most parameters of the state are not on this vehicle")

    def __repr__(self) -> str:
        return f"<Plan {self.summary} in {len(self.stages)} stages>"


def plan_from(
    current: AnyParams,
    wanted: AnyParams,
    *,
    autopilot: str | None = None,
    encoding: Encoding | None = None,
    **options: Unpack[PlanOptions],
) -> Plan:
    """Return what must be written to a vehicle with these parameters so that it has the wanted values.

    The order: parameters that select the frame; switches that reveal groups of parameters; all other
    parameters; switches that are turned off; parameters that may end the connection, such as the system id.

    A value is invalid if the parameter's type cannot hold it, or if it cannot be sent exactly: a fraction for
    an integer, and, where integers are sent as float32 (ArduPilot), an integer beyond 24 bits. Values outside
    of the range in the metadata, and values that are not finite, are invalid unless "out-of-range" is
    included, or `force` is given: many vehicles accept such values without an error. For PX4 and ArduPilot,
    only `force` allows NaN and infinity: PX4 cannot save them, nor any other parameter from then on, and may
    stop.

    Args:
        current: the vehicle's parameters: a table, such as `component.params`, or a snapshot.
        wanted: the wanted parameters, or plain values by name.
        autopilot: "px4" or "ardupilot"; None if `current` names it, or to use the lists of both.
        encoding: the encoding of values; None for that of the autopilot.
        options: as in `PlanOptions`.

    Raises:
        UsageError: an element of `include` is neither a category nor a glob; `current` and `wanted` are of
            different components or autopilots, or one has plain and the other extended parameters.
    """
    check_keys(options, PlanOptions)
    current = set_of(current, is_extended=isinstance(wanted, ParamSet) and wanted.is_extended)
    wanted = set_of(wanted, is_extended=current.is_extended)
    return Planner(current, wanted, autopilot, encoding, options).plan()


def check_keys(given: Mapping[str, object], known: type) -> None:
    """Raise TypeError for an option that a TypedDict does not have: only type checkers compare them."""
    if unknown := sorted(given.keys() - known.__annotations__.keys()):
        raise TypeError(f"no option {unknown[0]!r}; see {known.__name__}")


def _check_origin(wanted: ParamSet, current: ParamSet, autopilot: str | None) -> None:
    """Check that parameters are meant for a vehicle: shared names of two autopilots have different meanings.

    Raises:
        UsageError: they are of another component or autopilot, or extended ones instead of plain ones.
    """
    meant = None if wanted.identity is None else autopilot_name(wanted.identity.autopilot)
    of = f" of {wanted.source}" if wanted.source else ""
    if wanted.is_extended != current.is_extended:
        kinds = ("extended", "plain") if wanted.is_extended else ("plain", "extended")
        raise UsageError(f"the parameters{of} are {kinds[0]} ones, and {kinds[1]} ones are needed")
    own = wanted.component, current.component
    if None not in own and own[0] != own[1]:
        raise UsageError(f"the parameters{of} are those of component {own[0]}, not of component {own[1]}")
    if {meant, autopilot} == {"px4", "ardupilot"}:
        raise UsageError(f"the parameters{of} are those of a vehicle with {meant}, not with {autopilot}")


class Planner:
    """Makes the rows and stages of one plan; the arguments are those of `plan_from`.

    `is_in_use` returns whether another vehicle has, or gets, the value of a system id parameter.
    """

    def __init__(
        self,
        current: ParamSet,
        wanted: ParamSet,
        autopilot: str | None,
        encoding: Encoding | None,
        options: PlanOptions,
        is_in_use: Callable[[str, Value], bool] = lambda *_: False,
    ) -> None:
        self.current, self.wanted, self.is_in_use = current, wanted, is_in_use
        self.identity = current.identity
        if autopilot is None and self.identity is not None:
            autopilot = autopilot_name(self.identity.autopilot)
        _check_origin(wanted, current, autopilot)
        usual = Encoding.C_CAST if autopilot == "ardupilot" else Encoding.BYTEWISE
        self.autopilot, self.encoding = autopilot or "", encoding or usual
        self.described, self.choice = options.get("info") or {}, Choice(options.get("include", ()))
        self.force = options.get("force", False)
        self.rules = rules_for(self.autopilot, is_extended=wanted.is_extended)

    def plan(self) -> Plan:
        """Return the plan."""
        rows = {each.name: self.row(each) for each in self.wanted.values()}
        self.settle_missing(rows)
        awaiting_reboot = self.awaiting_reboot(rows)
        hidden = tuple(map(_group_of, awaiting_reboot))
        file, own = self.wanted.identity, self.identity
        ids = [row for row in rows.values() if self.rules.has("system_id", row.name)]
        unused = [r.name for r in ids if own and r.status is ApplyStatus.UNCHANGED and r.before != own.system]
        return Plan(
            rows,
            self.stages(rows),
            problems={
                name: row.why if row.wanted.line is None else f"{row.why} (line {row.wanted.line})"
                for name, row in rows.items()
                if row.status is ApplyStatus.REFUSED
                and not (row.category == MISSING and name.startswith(hidden))
            },
            extra=tuple(name for name in self.current if name not in self.wanted),
            unchecked=tuple(
                name
                for name, row in rows.items()
                if row.status is ApplyStatus.SET
                and not isinstance(row.wanted.settable, str | bytes)
                and name not in self.described
            ),
            firmware=() if file is None or own is None else (file, own),
            awaiting_reboot=(*awaiting_reboot, *unused),
            system_id=next((r.wanted.settable for r in ids if r.status is not ApplyStatus.SKIPPED), None),
        )

    def row(self, wanted: WrittenParam) -> ApplyRow:
        """Return the row of one parameter; `settle_missing` completes rows of missing parameters."""
        name = wanted.name
        current = self.current.get(name)
        before = None if current is None else current.settable
        kind = wanted.type if current is None or current.type is None else current.type
        info = self.described.get(name)
        vehicle_type = None if self.identity is None else self.identity.vehicle_type
        needs_reboot = self.rules.needs_reboot(name, vehicle_type)
        needs_reboot = needs_reboot or (info is not None and info.reboot_required)

        def verdict(status: ApplyStatus, category: str = "", reason: str = "") -> ApplyRow:
            return ApplyRow(wanted, status, before, None, kind, category, reason, needs_reboot=needs_reboot)

        rule = self.rules.left_out(name, self._value_to_be)
        if rule is not None and (rule.category == ACTION or not self.choice.has(name, rule.category)):
            return verdict(ApplyStatus.SKIPPED, rule.category, f"left out: it {rule.reason}")
        if before is None:
            return verdict(ApplyStatus.REFUSED, MISSING, "not on this vehicle")
        if _is_same(wanted.settable, before, kind):
            return verdict(ApplyStatus.UNCHANGED)
        if info is not None and info.is_read_only and not self.choice.has(name, READ_ONLY):
            return verdict(ApplyStatus.SKIPPED, READ_ONLY, "left out: it can only be read")
        wrong = self._find_fault(wanted, before, kind)
        if wrong is None or (wrong[0] == OUT_OF_RANGE and self.choice.has(name, OUT_OF_RANGE)):
            return verdict(ApplyStatus.SET)
        return verdict(ApplyStatus.REFUSED, *wrong)

    def stages(self, rows: Mapping[str, ApplyRow]) -> tuple[Stage, ...]:
        """Return the stages, in order; in the last one, the system id is last."""
        may_appear = any(row.status is ApplyStatus.LATER for row in rows.values())
        to_set = [row for row in rows.values() if row.status is ApplyStatus.SET]
        to_set.sort(key=lambda row: (self.place(row), self.rules.has("system_id", row.name)))
        stages = []
        for place, group in itertools.groupby(to_set, self.place):
            chosen, reveals = tuple(group), place < _OTHERS
            reboot_first = reveals and any(
                (may_appear and row.needs_reboot) or self.rules.has("resets", row.name) for row in chosen
            )
            stages.append(Stage(_PURPOSES[place], chosen, reveals, reboot_first))
        return tuple(stages)

    def place(self, row: ApplyRow) -> int:
        """Return the place of a value's stage in `_PURPOSES`."""
        if self.rules.has("last", row.name):
            return _LAST
        if self.rules.has("frame", row.name):
            return _FRAME
        if not is_group_switch(row.name, self.autopilot):
            return _OTHERS
        return _TURNED_OFF if row.wanted.settable == 0 else _SWITCHES

    def awaiting_reboot(self, rows: Mapping[str, ApplyRow]) -> tuple[str, ...]:
        """Return switches whose missing group may appear after a reboot."""
        missing = [name for name, row in rows.items() if row.category == MISSING]
        return tuple(
            name
            for name, row in rows.items()
            if row.status is ApplyStatus.UNCHANGED
            and row.before != 0
            and row.needs_reboot
            and (is_group_switch(name, self.autopilot) or self.rules.has("frame", name))
            and any(each.startswith(_group_of(name)) for each in missing)
        )

    def settle_missing(self, rows: dict[str, ApplyRow]) -> None:
        """Mark missing parameters that a step may reveal, and add the similar names that the vehicle has."""
        names = [name for name, row in rows.items() if row.category == MISSING]
        unnamed = self.current.keys() - self.wanted.keys()
        spelled = {name.upper(): name for name in self.current} if names else {}
        may_be_revealed = self._revealed_names(rows)
        for name in names:
            row = rows[name]
            if len(names) <= SUGGESTIONS_MAX:
                row = replace(row, nearest=nearest_names(name, unnamed | {spelled.get(name.upper(), name)}))
            rows[name] = replace(row, status=ApplyStatus.LATER) if may_be_revealed(name) else row

    def _revealed_names(self, rows: Mapping[str, ApplyRow]) -> Callable[[str], bool]:
        """Return a function that decides whether a step may reveal a name that the vehicle does not have.

        A switch reveals names that begin like its own: the members of its group, which may end in a digit
        (OSD_TYPE: OSD1_ENABLE), or a driver's, whose names share only the part up to the first underscore
        (CAN_P1_DRIVER: CAN_D1_UC_NODE). A new frame, and ArduPilot's scripts, may bring names of every group.
        """
        groups: list[str] = []
        for name, row in rows.items():
            is_switch = is_group_switch(name, self.autopilot)
            is_off = is_switch and row.wanted.settable == 0
            if row.status is not ApplyStatus.SET or is_off or self.rules.has("last", name):
                continue
            if self.rules.has("brings_any" if is_switch else "frame", name):
                return lambda _: True
            if is_switch:
                groups.append(name.partition("_")[0])
        return lambda name: name.startswith(tuple(groups))

    def _find_fault(
        self, target: WrittenParam, before: Value, kind: ParamType | int | None
    ) -> tuple[str, str] | None:
        """Return why a value is invalid, as category and sentence, or None."""
        value, info = target.settable, self.described.get(target.name)
        if self.rules.has("system_id", target.name):
            if isinstance(value, bytes | str) or not 1 <= value <= 255:
                return WRONG, "a system id is a number from 1 to 255"
            if self.is_in_use(target.name, value):
                return WRONG, f"another vehicle on this link has, or gets, the system id {value}"
        if kind is not None:
            try:
                (EXTENDED if self.wanted.is_extended else PLAIN).encode(value, kind, self.encoding)
            except UsageError as error:
                return WRONG, str(error)
            if isinstance(value, float) and kind < ParamType.REAL32 and not value.is_integer():
                return WRONG, f"{value!r} is not a whole number, and the parameter is {ParamType(kind).name}"
        if target.is_raw and not isinstance(before, bytes):
            return WRONG, f"{format_value(value)} are raw bytes, and the vehicle has a number"
        if self.force or isinstance(value, bytes | str):
            return None
        if not math.isfinite(value):
            # only ArduPilot sends integers as float32
            usual = "ardupilot" if self.encoding is Encoding.C_CAST else ""
            reason = reason_against_non_finite(self.autopilot or usual)
            return (WRONG, reason) if reason else (OUT_OF_RANGE, f"{value} is not a finite number")
        if info is None or (problem := info.problem(value)) is None:
            return None
        return OUT_OF_RANGE, problem.removeprefix(f"{info.name}: ")

    def _value_to_be(self, name: str) -> Value | None:
        """Return the wanted value of a parameter, or else its present value."""
        param = self.wanted.get(name) or self.current.get(name)
        return None if param is None else param.settable


def _group_of(switch: str) -> str:
    """Return how the names of a switch's group begin."""
    return switch.rpartition("_")[0] + "_"


def _is_same(wanted: Value, current: Value, kind: ParamType | int | None) -> bool:
    """Return whether two values are equal in the vehicle's type; as float32 if the type is unknown."""
    return same_value(*(WrittenParam("", value, kind) for value in (wanted, current)))


_PURPOSES: Final = (
    "frame parameters",
    "switches that reveal parameters",
    "all other parameters",
    "switches that are turned off",
    "parameters that may end the connection",
)
"""Purposes of the stages, in their order. After the first two, further parameters may appear."""
_FRAME, _SWITCHES, _OTHERS, _TURNED_OFF, _LAST = range(len(_PURPOSES))
