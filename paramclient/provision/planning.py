"""The plan of a set-up: the values to write, their order, and reasons for parameters that are not written.

The parameters that no set-up writes are in `apply_rules.toml`.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final, Protocol

from paramclient.errors import UsageError
from paramclient.model.identity import Identity, autopilot_name, reason_against_non_finite, version_difference
from paramclient.model.names import nearest_names
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.renames import Renames
from paramclient.model.values import (
    Encoding,
    Param,
    ParamType,
    WireValue,
    bits_of,
    format_value,
    same_bits,
    type_name,
)
from paramclient.protocol.dialect import EXTENDED, PLAIN
from paramclient.provision.apply_rules import OUT_OF_RANGE, READ_ONLY, ApplyRules, Choice, rules_for

__all__ = [
    "MISSING",
    "WRONG",
    "ParamInfo",
    "Plan",
    "PlanRow",
    "PlanStatus",
    "Stage",
    "Step",
    "overlay",
    "plan",
]

NOT_ON_VEHICLE: Final = "not on this vehicle"
"""The reason of a parameter that the vehicle does not have."""
MISSING: Final = "missing"
"""The category of a parameter that the vehicle does not have."""
WRONG: Final = "wrong"
"""The category of a value that the parameter's type cannot take, or that cannot be sent."""
SUGGESTIONS_MAX: Final = 40
"""Missing names up to which similar names are suggested. With more, the file is for another vehicle and has
no typing errors."""


class ParamInfo(Protocol):
    """The metadata of one parameter that a plan uses."""

    @property
    def minimum(self) -> float | None:
        """The lowest valid value in the unit of the parameter, or None."""
        ...

    @property
    def maximum(self) -> float | None:
        """The highest valid value in the unit of the parameter, or None."""
        ...

    @property
    def is_read_only(self) -> bool:
        """Whether only the vehicle writes the parameter."""
        ...

    @property
    def reboot_required(self) -> bool:
        """Whether a change takes effect after a reboot."""
        ...


class PlanStatus(StrEnum):
    """The planned action for a wanted parameter."""

    SET = "set"
    """The value differs and is to be written."""
    LATER = "later"
    """The vehicle does not have the parameter now; a step of the plan may reveal it, going by its name, and
    then it is set."""
    UNCHANGED = "unchanged"
    """The vehicle has the value already."""
    SKIPPED = "skipped"
    """The parameter is not written, or the vehicle does not have it; `PlanRow.reason` gives the reason."""
    INVALID = "invalid"
    """The value is invalid; `PlanRow.reason` gives the reason."""


@dataclass(frozen=True, slots=True)
class PlanRow:
    """The planned action for one wanted parameter, with the value that the vehicle has.

    Attributes:
        wanted: the parameter as the file has it.
        status: the planned action.
        before: the value that the vehicle has, or None if it does not have the parameter.
        type: the vehicle's type of the parameter; None if unknown.
        category: for skipped and invalid parameters, the kind of reason: one of `CATEGORIES`, `MISSING`, or
            `WRONG`; else "".
        reason: the reason for the status as a sentence; may be "".
        nearest: for a parameter that the vehicle does not have, the most similar names, most similar first.
        renamed: the wanted parameter under the vehicle's name and with the value for it, if the vehicle has
            the parameter under another name (see `Renames`); else None.
        rename_note: for a parameter that the vehicle has under none of its names, words that name the other
            ones; else "".
    """

    wanted: WrittenParam
    status: PlanStatus
    before: WireValue | None = None
    type: ParamType | int | None = None
    category: str = ""
    reason: str = ""
    nearest: tuple[str, ...] = ()
    renamed: WrittenParam | None = None
    rename_note: str = ""

    @property
    def name(self) -> str:
        """The param_id in the file."""
        return self.wanted.name

    @property
    def target(self) -> WrittenParam:
        """The wanted parameter with the name and the value that the vehicle is to have."""
        return self.wanted if self.renamed is None else self.renamed

    @property
    def reason_missing(self) -> str:
        """The reason of a parameter that the vehicle does not have."""
        return "; ".join(filter(None, (NOT_ON_VEHICLE, self.rename_note)))

    @property
    def differs(self) -> bool:
        """Whether the vehicle has another value than the wanted one, or no such parameter."""
        return self.before is None or not _is_same(self.target.settable, self.before, self.type)

    @property
    def is_met(self) -> bool:
        """Whether the vehicle has the wanted value, or the parameter is left out."""
        return self.category != MISSING and self.status in (PlanStatus.UNCHANGED, PlanStatus.SKIPPED)

    def __str__(self) -> str:
        kind = ParamType.REAL32 if self.type is None else self.type
        wanted = format_value(self.target.settable, kind)
        name = self.name if self.renamed is None else f"{self.name} (here {self.renamed.name})"
        if self.status is PlanStatus.UNCHANGED:
            return f"{name} = {wanted}"
        change = wanted if self.before is None else f"{format_value(self.before, kind)} -> {wanted}"
        like = f" (did you mean {', '.join(self.nearest)}?)" if self.nearest else ""
        why = f": {self.reason}{like}" if self.reason else ""
        return f"{name} {change}, {self.status}{why}"


@dataclass(frozen=True, slots=True)
class Step:
    """One value to write.

    Attributes:
        name: param_id on the vehicle.
        value: the value to send.
        type: the vehicle's type of the parameter, which PARAM_SET carries.
        before: the value that the vehicle has.
        needs_reboot: whether the change takes effect after a reboot.
        wanted: the parameter as the file has it, possibly with another name (see `Renames`).
    """

    name: str
    value: WireValue
    type: ParamType | int
    before: WireValue
    needs_reboot: bool
    wanted: WrittenParam

    def __str__(self) -> str:
        change = f"{format_value(self.before, self.type)} -> {format_value(self.value, self.type)}"
        return f"{self.name} {change}"


@dataclass(frozen=True, slots=True)
class Stage:
    """Steps that are written concurrently, before those of the next stage.

    Attributes:
        purpose: what the steps have in common, in words.
        steps: the steps, in the order of the file.
        reveals: whether other parameters may appear afterwards.
        reboot_first: whether the vehicle must reboot before the next stage: values that are set before the
            reboot would be lost, or their parameters do not exist yet.
        is_last: whether the steps may end the connection. These are written one by one.
    """

    purpose: str
    steps: tuple[Step, ...]
    reveals: bool = False
    reboot_first: bool = False
    is_last: bool = False


@dataclass(frozen=True, slots=True)
class Plan:
    """The planned actions of a set-up; see `plan`.

    Attributes:
        wanted: the wanted parameters.
        rows: by name, one row for each wanted parameter, in the order of the file.
        stages: the steps in the order of writing. After a stage that reveals parameters, and after a reboot,
            the vehicle is read again and a new plan is made; the later stages are those known so far.
        extra: names that the vehicle has and `wanted` does not have; they are not changed.
        include: categories and globs that are included although the list leaves them out.
        identity: the vehicle of the plan, if `current` names it.
        force: whether to send values that the autopilot cannot store.
        renames: the names that firmware versions have changed, or None.
        awaiting_reboot: switches that are on and whose group is missing: they take effect after a reboot,
            and the vehicle may not have rebooted since they were set.
    """

    wanted: ParamSet
    rows: Mapping[str, PlanRow]
    stages: tuple[Stage, ...]
    extra: tuple[str, ...] = ()
    include: tuple[str, ...] = ()
    identity: Identity | None = None
    awaiting_reboot: tuple[str, ...] = ()
    force: bool = False
    renames: Renames | None = None

    @property
    def firmware_note(self) -> str:
        """The firmware versions of the file and the vehicle, as a sentence; "" unless they differ."""
        before, own = self.wanted.identity, self.identity
        return "" if before is None or own is None else version_difference(before, own)

    @property
    def steps(self) -> list[Step]:
        """All values to write, in order."""
        return [step for stage in self.stages for step in stage.steps]

    @property
    def reboot_for(self) -> tuple[str, ...]:
        """The names of steps that take effect after a reboot."""
        return tuple(step.name for step in self.steps if step.needs_reboot)

    @property
    def counts(self) -> Mapping[PlanStatus, int]:
        """The number of rows with each status."""
        return Counter(row.status for row in self.rows.values())

    def of(self, status: PlanStatus) -> list[PlanRow]:
        """Return the rows with this status, in order."""
        return [row for row in self.rows.values() if row.status is status]

    @property
    def is_met(self) -> bool:
        """Whether the vehicle has all wanted values, except those left out on purpose."""
        return all(row.is_met for row in self.rows.values())

    def __repr__(self) -> str:
        counts = ", ".join(f"{count} {status}" for status, count in self.counts.items())
        return f"<Plan {counts or 'nothing'} in {len(self.stages)} stages>"


def plan(
    current: ParamSet | Mapping[str, Param],
    wanted: ParamSet,
    *,
    include: str | Iterable[str] = (),
    info: Mapping[str, ParamInfo] | None = None,
    autopilot: str | None = None,
    encoding: Encoding | None = None,
    force: bool = False,
    renames: Renames | None = None,
) -> Plan:
    """Return what must be set on a vehicle so that it has the wanted values. Sends nothing.

    The order: parameters that select the frame; switches that reveal groups of parameters; all other
    parameters; switches that are turned off; parameters that may end the connection, such as the system id.

    A value is invalid if the parameter's type cannot hold it, or if it cannot be sent exactly: a fraction for
    an integer, and, where integers are sent as float32 (ArduPilot), an integer beyond 24 bits. Values outside
    of the range in the metadata, and values that are not finite, are invalid unless "out-of-range" is
    included: many vehicles accept such values without an error. For PX4 and ArduPilot, only `force` allows
    NaN and infinity: PX4 cannot save them, nor any other parameter from then on, and may stop.

    Args:
        current: the vehicle's parameters: a table, such as `component.params`, or a snapshot.
        wanted: the wanted parameters.
        include: categories (`CATEGORIES`) and globs of names to set although the list leaves them out.
        info: metadata by name.
        autopilot: "px4" or "ardupilot"; None if `current` names it, or to use the lists of both.
        encoding: the encoding of values; None for that of the autopilot.
        force: allow NaN and infinity for every autopilot.
        renames: names that firmware versions have changed. A wanted parameter that is not in `current` is
            planned under its other name, if `current` has that one.

    Raises:
        UsageError: an element of `include` is neither a category nor a glob; `current` and `wanted` are of
            different components or autopilots, or one has plain and the other extended parameters; or two
            wanted names are one parameter of `current`.
    """
    identity = None
    if isinstance(current, ParamSet):
        identity = current.identity
        if autopilot is None and identity is not None:
            autopilot = autopilot_name(identity.autopilot)
        check_component(wanted, current.component, is_extended=current.is_extended)
    _check_autopilot(wanted, autopilot)
    given = (include,) if isinstance(include, str) else tuple(include)
    if encoding is None:
        encoding = Encoding.C_CAST if autopilot == "ardupilot" else Encoding.BYTEWISE
    rules = rules_for(autopilot or "", is_extended=wanted.is_extended)
    planner = _Planner(
        current,
        wanted,
        rules,
        Choice(given),
        info or {},
        encoding,
        autopilot or "",
        vehicle_type=None if identity is None else identity.vehicle_type,
        force=force,
        renames=renames or Renames(),
    )
    rows = {name: planner.row(each) for name, each in wanted.items()}
    awaiting_reboot = planner.awaiting_reboot(rows)
    rows = planner.settle_missing(rows)
    stages = planner.stages(rows)
    named = {row.target.name for row in rows.values()}
    extra = tuple(name for name in current if name not in named)
    return Plan(wanted, rows, stages, extra, given, identity, awaiting_reboot, force, renames)


def overlay(base: ParamSet, over: ParamSet) -> ParamSet:
    """Return the parameters of `base`, replaced and extended by those of `over`.

    For a file that all vehicles share, and a small file for each vehicle. The identity and address of `over`
    have precedence over those of `base`.

    Raises:
        UsageError: the two are of different components.
    """
    check_component(over, base.component, is_extended=base.is_extended)
    return ParamSet(
        {**base.params, **over.params},
        component=base.component if over.component is None else over.component,
        system=base.system if over.system is None else over.system,
        identity=over.identity or base.identity,
        at=base.at if over.at is None else over.at,
        source=" + ".join(filter(None, (base.source, over.source))),
        is_extended=base.is_extended,
    )


def check_component(wanted: ParamSet, component: int | None, *, is_extended: bool) -> None:
    """Check that parameters are meant for this component, and for its plain or its extended parameters.

    Raises:
        UsageError: they name another component, or are of the other kind.
    """
    if wanted.is_extended != is_extended:
        kinds = ("extended", "plain") if wanted.is_extended else ("plain", "extended")
        of = f" of {wanted.source}" if wanted.source else ""
        raise UsageError(f"the parameters{of} are {kinds[0]} ones, and {kinds[1]} ones are needed")
    if wanted.component is not None and component is not None and wanted.component != component:
        raise UsageError(
            f"the parameters{f' of {wanted.source}' if wanted.source else ''} are those of component "
            f"{wanted.component}, not of component {component}"
        )


def _check_autopilot(wanted: ParamSet, autopilot: str | None) -> None:
    """Check that parameters are not those of another autopilot: shared names have different meanings.

    Raises:
        UsageError: the parameters name another autopilot.
    """
    if wanted.identity is None:
        return
    meant = autopilot_name(wanted.identity.autopilot)
    if {meant, autopilot} == {"px4", "ardupilot"}:
        raise UsageError(
            f"the parameters{f' of {wanted.source}' if wanted.source else ''} are those of a vehicle with "
            f"{meant}, not with {autopilot}"
        )


class _Planner:
    """Makes the rows and stages of one plan; the arguments are those of `plan`, resolved."""

    def __init__(
        self,
        current: ParamSet | Mapping[str, Param],
        wanted: ParamSet,
        rules: ApplyRules,
        choice: Choice,
        info: Mapping[str, ParamInfo],
        encoding: Encoding,
        autopilot: str,
        *,
        vehicle_type: int | None,
        force: bool,
        renames: Renames,
    ) -> None:
        self._current = current
        self._renames = renames
        self._renamed = renames.renamed(wanted, current)
        targets = (self._renamed.get(name, param) for name, param in wanted.items())
        self._targets = {param.name: param for param in targets}
        self._vehicle_type = vehicle_type
        self._rules = rules
        self._choice = choice
        self._info = info
        self._encoding = encoding
        self._dialect = EXTENDED if wanted.is_extended else PLAIN
        self._force = force
        # only ArduPilot sends integers as float32
        usual = "ardupilot" if encoding is Encoding.C_CAST else ""
        self._against_non_finite = reason_against_non_finite(autopilot or usual)

    def row(self, wanted: WrittenParam) -> PlanRow:
        """Return the row of one parameter; `settle_missing` completes rows of missing parameters."""
        renamed = self._renamed.get(wanted.name)
        target = wanted if renamed is None else renamed
        name = target.name
        current: Param | WrittenParam | None = self._current.get(name)
        before = None if current is None else current.settable
        kind = target.type_number if current is None or current.type_number is None else current.type_number
        note = self._renames.missing_note(wanted.name) if before is None else ""

        def verdict(status: PlanStatus, category: str = "", reason: str = "") -> PlanRow:
            return PlanRow(wanted, status, before, kind, category, reason, (), renamed, note)

        def includes(category: str) -> bool:
            return any(self._choice.has(each, category) for each in (name, wanted.name))

        for each in dict.fromkeys((name, wanted.name)):  # the list may know only one of two names
            rule = self._rules.left_out(each, self._value_to_be)
            if rule is not None and not includes(rule.category):
                return verdict(PlanStatus.SKIPPED, rule.category, f"left out: it {rule.reason}")
        if before is None:
            return verdict(PlanStatus.LATER, MISSING)
        if _is_same(target.settable, before, kind):
            return verdict(PlanStatus.UNCHANGED)
        info = self._info.get(name)
        if info is not None and info.is_read_only and not includes(READ_ONLY):
            return verdict(PlanStatus.SKIPPED, READ_ONLY, "left out: it can only be read")
        wrong = self._find_fault(name, target.settable, kind, info)
        if wrong is None and target.is_raw and not isinstance(before, bytes):
            wrong = WRONG, f"{format_value(target.settable)} are raw bytes, and the vehicle has a number"
        if wrong is None or (wrong[0] == OUT_OF_RANGE and includes(OUT_OF_RANGE)):
            return verdict(PlanStatus.SET)
        category, reason = wrong
        return verdict(PlanStatus.INVALID, category, reason if renamed is None else f"as {name}, {reason}")

    def stages(self, rows: Mapping[str, PlanRow]) -> tuple[Stage, ...]:
        """Return the stages, in order."""
        steps = [self._step(row) for row in rows.values() if row.status is PlanStatus.SET]
        is_any_missing = any(row.status is PlanStatus.LATER for row in rows.values())
        last = _pop_matching(steps, lambda step: self._rules.is_last(step.name))
        frame = _pop_matching(steps, lambda step: self._rules.chooses_frame(step.name))
        switches = _pop_matching(steps, lambda step: self._rules.reveals(step.name))
        turned_off = _pop_matching(switches, lambda step: step.value == 0)
        stages = []
        if frame:
            resets = any(self._rules.resets(step.name) for step in frame)
            waits = is_any_missing and any(step.needs_reboot for step in frame)
            stages.append(Stage("frame parameters", tuple(frame), True, resets or waits))
        if switches:
            waits = is_any_missing and any(step.needs_reboot for step in switches)
            stages.append(Stage("switches that reveal parameters", tuple(switches), True, waits))
        if steps:
            stages.append(Stage("all other parameters", tuple(steps)))
        if turned_off:
            stages.append(Stage("switches that are turned off", tuple(turned_off)))
        if last:
            last.sort(key=lambda step: self._rules.is_system_id(step.name))
            stages.append(Stage("parameters that may end the connection", tuple(last), is_last=True))
        return tuple(stages)

    def awaiting_reboot(self, rows: Mapping[str, PlanRow]) -> tuple[str, ...]:
        """Return switches whose missing group may appear after a reboot."""
        missing = [
            each
            for name, row in rows.items()
            if row.status is PlanStatus.LATER
            for each in (name, *self._renames.other_names(name))
        ]
        return tuple(
            name
            for name, row in ((row.target.name, row) for row in rows.values())
            if row.status is PlanStatus.UNCHANGED
            and row.before != 0
            and (self._rules.reveals(name) or self._rules.chooses_frame(name))
            and self._needs_reboot(name)
            and any(each.startswith(name.rpartition("_")[0] + "_") for each in missing)
        )

    def settle_missing(self, rows: Mapping[str, PlanRow]) -> dict[str, PlanRow]:
        """Return the rows with missing parameters as later, if a step may reveal them, or skipped.

        Adds the similar names that the vehicle has.
        """
        names = [name for name, row in rows.items() if row.status is PlanStatus.LATER]
        if len(names) > SUGGESTIONS_MAX:
            nearest: Mapping[str, tuple[str, ...]] = {}
        else:
            unnamed = self._current.keys() - self._targets.keys()
            spelled = {name.upper(): name for name in self._current}
            nearest = {
                name: nearest_names(name, unnamed | {spelled.get(name.upper(), name)}) for name in names
            }
        settled = dict(rows)
        may_be_revealed = self._revealed_names(rows)
        for name in names:
            may_appear = any(map(may_be_revealed, (name, *self._renames.other_names(name))))
            settled[name] = replace(
                rows[name],
                status=PlanStatus.LATER if may_appear else PlanStatus.SKIPPED,
                reason=rows[name].reason_missing + (", unless a step reveals it" if may_appear else ""),
                nearest=nearest.get(name, ()),
            )
        return settled

    def _revealed_names(self, rows: Mapping[str, PlanRow]) -> Callable[[str], bool]:
        """Return a function that decides whether a step may reveal a name that the vehicle does not have.

        A switch reveals names that begin like its own: the members of its group, which may end in a digit
        (OSD_TYPE: OSD1_ENABLE). One that is turned on may also start a driver whose names share only the part
        up to the first underscore (CAN_P1_DRIVER: CAN_D1_UC_NODE). A new frame, and ArduPilot's scripts, may
        bring names of every group.
        """
        groups: set[str] = set()
        for row in rows.values():
            name = row.target.name
            if row.status is not PlanStatus.SET or self._rules.is_last(name):
                continue
            is_switch = self._rules.reveals(name)
            if is_switch and row.target.settable == 0:
                continue
            if self._rules.brings_any(name) or (not is_switch and self._rules.chooses_frame(name)):
                return lambda _: True
            if is_switch:
                groups.add(name.rpartition("_")[0])
                if row.before == 0:
                    groups.add(name[: name.index("_") + 1])
        prefixes = tuple(groups)
        return lambda name: name.startswith(prefixes)

    def _find_fault(
        self, name: str, value: WireValue, kind: ParamType | int | None, info: ParamInfo | None
    ) -> tuple[str, str] | None:
        """Return why a value is invalid, as category and sentence, or None."""
        if self._rules.is_system_id(name) and (isinstance(value, bytes | str) or not 1 <= value <= 255):
            return WRONG, "a system id is a number from 1 to 255"
        if kind is not None:
            try:
                self._dialect.encode(value, kind, self._encoding)
            except UsageError as error:
                return WRONG, str(error)
            if isinstance(value, float) and kind < ParamType.REAL32 and not value.is_integer():
                return WRONG, f"{value!r} is not a whole number, and the parameter is {type_name(kind)}"
        if isinstance(value, bytes | str):
            return None
        if not math.isfinite(value):
            if self._force:
                return None
            if self._against_non_finite:
                return WRONG, self._against_non_finite
            return OUT_OF_RANGE, f"{value} is not a finite number"
        if info is not None:
            sent = _float32(value) if kind == ParamType.REAL32 else value
            if info.minimum is not None and sent < _float32(info.minimum):
                return OUT_OF_RANGE, f"{format_value(value)} is below its minimum, {info.minimum:g}"
            if info.maximum is not None and sent > _float32(info.maximum):
                return OUT_OF_RANGE, f"{format_value(value)} is above its maximum, {info.maximum:g}"
        return None

    def _step(self, row: PlanRow) -> Step:
        assert row.before is not None, "only parameters that the vehicle has are set"
        kind = ParamType.REAL32 if row.type is None else row.type
        name, value = row.target.name, row.target.settable
        return Step(name, value, kind, row.before, self._needs_reboot(name), row.wanted)

    def _value_to_be(self, name: str) -> WireValue | None:
        """Return the wanted value of a parameter, or else its present value."""
        param: Param | WrittenParam | None = self._targets.get(name) or self._current.get(name)
        return None if param is None else param.settable

    def _needs_reboot(self, name: str) -> bool:
        info = self._info.get(name)
        if info is not None and info.reboot_required:
            return True
        return self._rules.needs_reboot(name, self._vehicle_type)


def _pop_matching(steps: list[Step], fits: Callable[[Step], bool]) -> list[Step]:
    """Remove the steps that fit from the list, and return them."""
    taken = [step for step in steps if fits(step)]
    steps[:] = [step for step in steps if not fits(step)]
    return taken


def _is_same(wanted: WireValue, current: WireValue, kind: ParamType | int | None) -> bool:
    """Return whether two values are equal in the vehicle's type; as float32 if the type is unknown."""
    if kind != ParamType.CUSTOM and (isinstance(wanted, bytes) or isinstance(current, bytes)):
        return wanted == current
    if kind is None:
        if isinstance(wanted, int) and isinstance(current, int):
            return wanted == current
        kind = ParamType.REAL32
    try:
        return same_bits(kind, bits_of(wanted, kind), bits_of(current, kind))
    except UsageError:
        return False


def _float32(value: float) -> float:
    """Return the nearest float32; infinity for values beyond its range."""
    try:
        number: float = struct.unpack("<f", struct.pack("<f", value))[0]
    except OverflowError:
        return math.copysign(math.inf, value)
    return number
