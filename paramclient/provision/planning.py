"""What a set-up would do, worked out before anything is sent: which values, in which order, and why not."""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, Protocol

from paramclient.errors import UsageError
from paramclient.model.identity import Identity, autopilot_name, reason_against_non_finite
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import (
    Encoding,
    Param,
    ParamType,
    Value,
    bits_of,
    encode,
    format_value,
    same_bits,
    type_name,
)
from paramclient.provision.cautions import OUT_OF_RANGE, READ_ONLY, Cautions, Choice, cautions_for
from paramclient.provision.similar_names import nearest_names

__all__ = [
    "MISSING",
    "WRONG",
    "ParamInfo",
    "Plan",
    "PlanRow",
    "PlanStatus",
    "RowStanding",
    "Stage",
    "Step",
    "overlay",
    "plan",
]

MISSING: Final = "missing"
"""The category of what the vehicle does not have."""
WRONG: Final = "wrong"
"""The category of a value that the parameter's type cannot take, or that cannot be sent."""
MOST_SUGGESTED: Final = 40
"""Names for which similar ones are looked up. Who misses more has another vehicle's file, and no typos."""


class ParamInfo(Protocol):
    """What a plan takes from metadata, where there is some."""

    @property
    def minimum(self) -> float | None: ...
    @property
    def maximum(self) -> float | None: ...
    @property
    def is_read_only(self) -> bool: ...
    @property
    def reboot_required(self) -> bool: ...


class PlanStatus(StrEnum):
    """What a plan means to do with a wanted parameter."""

    SET = "set"
    LATER = "later"
    """The vehicle does not have it now; a step of the plan may bring it to light, and then it is set."""
    UNCHANGED = "unchanged"
    SKIPPED = "skipped"
    """It stays as it is on board, or is not there at all; `PlanRow.reason` says why."""
    INVALID = "invalid"
    """The value cannot be right; `PlanRow.reason` says why."""


class RowStanding(StrEnum):
    """How what a vehicle has compares with a wanted parameter."""

    SAME = "same"
    DIFFERENT = "different"
    MISSING = "missing"
    """The vehicle does not have the parameter."""
    LEFT_OUT = "left out"
    """It need not be the same."""


@dataclass(frozen=True, slots=True)
class PlanRow:
    """What a plan means to do with one wanted parameter.

    Attributes:
        wanted: the parameter as it is written.
        status: what is to be done.
        before: the value that the vehicle has, or None where it does not have the parameter.
        type: the vehicle's type for it; None where that is not known.
        category: for what is skipped or invalid, the kind of reason: one of `CATEGORIES`, `MISSING`, or
            `WRONG`; else "".
        reason: the same as a sentence; "" where there is nothing to say.
        nearest: for what the vehicle does not have, its names that look most alike, the likeliest first.
    """

    wanted: WrittenParam
    status: PlanStatus
    before: Value | None = None
    type: ParamType | int | None = None
    category: str = ""
    reason: str = ""
    nearest: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        return self.wanted.name

    @property
    def differs(self) -> bool:
        """Whether the vehicle holds another value than the wanted one, or none."""
        return self.before is None or not _is_same(self.wanted.value, self.before, self.type)

    @property
    def standing(self) -> RowStanding:
        """How it compares."""
        if self.category == MISSING:
            return RowStanding.MISSING
        if self.status is PlanStatus.SKIPPED:
            return RowStanding.LEFT_OUT
        return RowStanding.SAME if self.status is PlanStatus.UNCHANGED else RowStanding.DIFFERENT

    @property
    def is_met(self) -> bool:
        """Whether the vehicle has the value already, or need not have it."""
        return self.standing in (RowStanding.SAME, RowStanding.LEFT_OUT)

    def __str__(self) -> str:
        kind = ParamType.REAL32 if self.type is None else self.type
        wanted = format_value(self.wanted.value, kind)
        if self.status is PlanStatus.UNCHANGED:
            return f"{self.name} = {wanted}"
        change = wanted if self.before is None else f"{format_value(self.before, kind)} -> {wanted}"
        like = f" (did you mean {', '.join(self.nearest)}?)" if self.nearest else ""
        why = f": {self.reason}{like}" if self.reason else ""
        return f"{self.name} {change}, {self.status}{why}"


@dataclass(frozen=True, slots=True)
class Step:
    """One value to write.

    Attributes:
        name, value: what is sent, as it is written.
        type: the vehicle's type for it, with which it is sent.
        before: what the vehicle has.
        needs_reboot: whether it counts only from the next start on.
    """

    name: str
    value: Value
    type: ParamType | int
    before: Value
    needs_reboot: bool = False

    def __str__(self) -> str:
        change = f"{format_value(self.before, self.type)} -> {format_value(self.value, self.type)}"
        return f"{self.name} {change}"


@dataclass(frozen=True, slots=True)
class Stage:
    """Steps that are done side by side, before those of the next stage.

    Attributes:
        purpose: what they have in common, in words.
        steps: the steps, in the order in which the parameters are written down.
        reveals: whether other parameters may appear afterwards.
        reboot_first: whether the vehicle has to start again before the next stage: what is set before that
            would be lost, or is not there yet.
        is_last: whether these may end the conversation. They are done one after another instead.
    """

    purpose: str
    steps: tuple[Step, ...]
    reveals: bool = False
    reboot_first: bool = False
    is_last: bool = False


@dataclass(frozen=True, slots=True)
class Plan:
    """What a set-up means to do; see `plan`.

    Attributes:
        wanted: what is to come of it.
        rows: by name, one for each wanted parameter, in the order in which they are written.
        stages: the steps, in the order in which they are to be done. After a stage that reveals others, or
            after a start of the vehicle, it is looked at afresh and planned anew; the further stages are what
            is known so far.
        extra: names that the vehicle has and `wanted` does not; they stay as they are.
        include: what was asked for although the list leaves it out.
        identity: whose plan it is, where `current` said so.
        force: whether values that the autopilot cannot store are sent all the same.
        unstarted: switches that are on already, and whose group is not there: as they count from the next
            start of the vehicle on, it may not have started since they were set.
    """

    wanted: ParamSet
    rows: Mapping[str, PlanRow]
    stages: tuple[Stage, ...]
    extra: tuple[str, ...] = ()
    include: tuple[str, ...] = ()
    identity: Identity | None = None
    unstarted: tuple[str, ...] = ()
    force: bool = False

    @property
    def steps(self) -> list[Step]:
        """Every value to write, in order."""
        return [step for stage in self.stages for step in stage.steps]

    @property
    def reboot_for(self) -> tuple[str, ...]:
        """The names of steps that count only from the next start of the vehicle on."""
        return tuple(step.name for step in self.steps if step.needs_reboot)

    @property
    def counts(self) -> Mapping[PlanStatus, int]:
        """How many rows have each status."""
        return Counter(row.status for row in self.rows.values())

    def of(self, status: PlanStatus) -> list[PlanRow]:
        """The rows with this status, in order."""
        return [row for row in self.rows.values() if row.status is status]

    @property
    def is_met(self) -> bool:
        """Whether the vehicle has all that is wanted already, but for what is left out on purpose."""
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
) -> Plan:
    """Work out what has to be set on a vehicle so that it has the wanted values. Nothing is sent.

    The order: what chooses the frame; the switches that show groups of others; everything else; switches
    that are turned off; what may end the conversation, such as the system id.

    A value is invalid that the parameter's own type cannot take, or that cannot be sent exactly: a fraction
    for an integer, and, where integers are sent as float32 (ArduPilot), one beyond 24 bits. So is one
    outside of the range in the metadata, or not finite, unless "out-of-range" is included: many vehicles
    take such values without a word. Of PX4 and ArduPilot, only `force` lets NaN and infinity through: PX4
    cannot save them, nor anything else from then on, and may stop.

    Args:
        current: what the vehicle has: a table, such as `component.params`, or a snapshot.
        wanted: what it shall have.
        include: what the list leaves out, and is to be set all the same: categories (`CATEGORIES`), and globs
            of names.
        info: metadata by name, where there is some.
        autopilot: "px4" or "ardupilot"; None where `current` says it, or for the lists of both.
        encoding: how values are sent; None: as the autopilot does.
        force: let NaN and infinity be set, whatever the autopilot makes of them.

    Raises:
        UsageError: `include` names no category and is no glob, or the two are of different components or
            autopilots.
    """
    identity = None
    if isinstance(current, ParamSet):
        identity = current.identity
        if autopilot is None and identity is not None:
            autopilot = autopilot_name(identity.autopilot)
        check_component(wanted, current.component)
    _check_autopilot(wanted, autopilot)
    given = (include,) if isinstance(include, str) else tuple(include)
    if encoding is None:
        encoding = Encoding.C_CAST if autopilot == "ardupilot" else Encoding.BYTEWISE
    cautions = cautions_for(autopilot or "")
    planner = _Planner(
        current,
        wanted,
        cautions,
        Choice(given),
        info or {},
        encoding,
        autopilot or "",
        vehicle_type=None if identity is None else identity.vehicle_type,
        force=force,
    )
    rows = {name: planner.row(each) for name, each in wanted.items()}
    stages = planner.stages(rows)
    unstarted = planner.unstarted(rows)
    rows = planner.settle_missing(rows, stages)
    extra = tuple(name for name in current if name not in wanted)
    return Plan(wanted, rows, stages, extra, given, identity, unstarted, force)


def overlay(base: ParamSet, over: ParamSet) -> ParamSet:
    """The parameters of `base`, with those of `over` in their place or behind them.

    For one file that all vehicles share, and a small one for each. What `over` says of the vehicle counts,
    else what `base` says.
    """
    check_component(over, base.component)
    return ParamSet(
        {**base.params, **over.params},
        component=base.component if over.component is None else over.component,
        system=base.system if over.system is None else over.system,
        identity=over.identity or base.identity,
        at=base.at if over.at is None else over.at,
        source=" + ".join(filter(None, (base.source, over.source))),
    )


def check_component(wanted: ParamSet, component: int | None) -> None:
    """See that parameters are meant for this component.

    Raises:
        UsageError: they say that they are another one's.
    """
    if wanted.component is not None and component is not None and wanted.component != component:
        raise UsageError(
            f"the parameters{f' of {wanted.source}' if wanted.source else ''} are those of component "
            f"{wanted.component}, not of component {component}"
        )


def _check_autopilot(wanted: ParamSet, autopilot: str | None) -> None:
    """See that parameters are not those of another autopilot: many share a name, and mean something else.

    Raises:
        UsageError: they say that they are.
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
    def __init__(
        self,
        current: ParamSet | Mapping[str, Param],
        wanted: ParamSet,
        cautions: Cautions,
        choice: Choice,
        info: Mapping[str, ParamInfo],
        encoding: Encoding,
        autopilot: str,
        *,
        vehicle_type: int | None,
        force: bool,
    ) -> None:
        self._current = current
        self._wanted = wanted
        self._vehicle_type = vehicle_type
        self._cautions = cautions
        self._choice = choice
        self._info = info
        self._encoding = encoding
        self._force = force
        # nothing but ArduPilot sends integers as float32
        usual = "ardupilot" if encoding is Encoding.C_CAST else ""
        self._against_non_finite = reason_against_non_finite(autopilot or usual)

    def row(self, wanted: WrittenParam) -> PlanRow:
        """What is to be done with one parameter; what is missing is settled later."""
        name = wanted.name
        held: Param | WrittenParam | None = self._current.get(name)
        before = None if held is None else held.value
        kind = wanted.type if held is None or held.type is None else held.type

        def verdict(status: PlanStatus, category: str = "", reason: str = "") -> PlanRow:
            return PlanRow(wanted, status, before, kind, category, reason)

        caution = self._cautions.left_out(name, self._value_to_be)
        if caution is not None and not self._choice.has(name, caution.category):
            return verdict(PlanStatus.SKIPPED, caution.category, f"left out: it {caution.reason}")
        if before is None:
            return verdict(PlanStatus.LATER, MISSING, "not on this vehicle")
        if _is_same(wanted.value, before, kind):
            return verdict(PlanStatus.UNCHANGED)
        info = self._info.get(name)
        if info is not None and info.is_read_only and not self._choice.has(name, READ_ONLY):
            return verdict(PlanStatus.SKIPPED, READ_ONLY, "left out: it can only be read")
        wrong = self._wrong(name, wanted.value, kind, info)
        if wrong is None and isinstance(wanted.value, bytes) and not isinstance(before, bytes):
            wrong = WRONG, f"{format_value(wanted.value)} are raw bytes, and the vehicle gives a number"
        if wrong is None or (wrong[0] == OUT_OF_RANGE and self._choice.has(name, OUT_OF_RANGE)):
            return verdict(PlanStatus.SET)
        return verdict(PlanStatus.INVALID, *wrong)

    def stages(self, rows: Mapping[str, PlanRow]) -> tuple[Stage, ...]:
        """The steps, in order."""
        steps = [self._step(row) for row in rows.values() if row.status is PlanStatus.SET]
        is_any_missing = any(row.status is PlanStatus.LATER for row in rows.values())
        last = _taken(steps, lambda step: self._cautions.is_last(step.name))
        frame = _taken(steps, lambda step: self._cautions.chooses_frame(step.name))
        switches = _taken(steps, lambda step: self._cautions.reveals(step.name))
        turned_off = _taken(switches, lambda step: step.value == 0)
        stages = []
        if frame:
            resets = any(self._cautions.resets(step.name) for step in frame)
            waits = is_any_missing and any(step.needs_reboot for step in frame)
            stages.append(Stage("what chooses the frame", tuple(frame), True, resets or waits))
        if switches:
            waits = is_any_missing and any(step.needs_reboot for step in switches)
            stages.append(Stage("what shows others", tuple(switches), True, waits))
        if steps:
            stages.append(Stage("the others", tuple(steps)))
        if turned_off:
            stages.append(Stage("what is turned off", tuple(turned_off)))
        if last:
            last.sort(key=lambda step: self._cautions.is_system_id(step.name))
            stages.append(Stage("what may end the conversation", tuple(last), is_last=True))
        return tuple(stages)

    def unstarted(self, rows: Mapping[str, PlanRow]) -> tuple[str, ...]:
        """Switches that may only wait for a start of the vehicle to show what is missing."""
        missing = [name for name, row in rows.items() if row.status is PlanStatus.LATER]
        return tuple(
            name
            for name, row in rows.items()
            if row.status is PlanStatus.UNCHANGED
            and row.before != 0
            and (self._cautions.reveals(name) or self._cautions.chooses_frame(name))
            and self._needs_reboot(name)
            and any(each.startswith(name.rpartition("_")[0] + "_") for each in missing)
        )

    def settle_missing(self, rows: Mapping[str, PlanRow], stages: Sequence[Stage]) -> dict[str, PlanRow]:
        """What is missing, and nothing in the plan could bring to light, is skipped; similar names."""
        may_come = any(stage.reveals for stage in stages)
        names = [name for name, row in rows.items() if row.status is PlanStatus.LATER]
        if len(names) > MOST_SUGGESTED:
            nearest: Mapping[str, tuple[str, ...]] = {}
        else:
            nearest = {name: nearest_names(name, self._current.keys() - rows.keys()) for name in names}
        settled = dict(rows)
        for name in names:
            settled[name] = PlanRow(
                rows[name].wanted,
                PlanStatus.LATER if may_come else PlanStatus.SKIPPED,
                type=rows[name].type,
                category=MISSING,
                reason=rows[name].reason + (", unless a step shows it" if may_come else ""),
                nearest=nearest.get(name, ()),
            )
        return settled

    def _wrong(
        self, name: str, value: Value, kind: ParamType | int | None, info: ParamInfo | None
    ) -> tuple[str, str] | None:
        """What is wrong with a value: the category, and a sentence."""
        if self._cautions.is_system_id(name) and (isinstance(value, bytes) or not 1 <= value <= 255):
            return WRONG, "a system id is a number from 1 to 255"
        if kind is not None:
            try:
                encode(value, kind, self._encoding)
            except UsageError as error:
                return WRONG, str(error)
            if isinstance(value, float) and kind < ParamType.REAL32 and not value.is_integer():
                return WRONG, f"{value!r} is not a whole number, and the parameter is {type_name(kind)}"
        if isinstance(value, bytes):
            return None
        if not math.isfinite(value):
            if self._force:
                return None
            if self._against_non_finite:
                return WRONG, self._against_non_finite
            return OUT_OF_RANGE, f"{value} is no number to fly with"
        if info is not None:
            sent = _float32(value) if kind == ParamType.REAL32 else value
            if info.minimum is not None and sent < _float32(info.minimum):
                return OUT_OF_RANGE, f"{format_value(value)} is below its minimum, {info.minimum:g}"
            if info.maximum is not None and sent > _float32(info.maximum):
                return OUT_OF_RANGE, f"{format_value(value)} is above its maximum, {info.maximum:g}"
        return None

    def _step(self, row: PlanRow) -> Step:
        assert row.before is not None, "only what the vehicle has is set"
        kind = ParamType.REAL32 if row.type is None else row.type
        return Step(row.name, row.wanted.value, kind, row.before, self._needs_reboot(row.name))

    def _value_to_be(self, name: str) -> Value | None:
        """The value that a parameter shall have, or else has."""
        param: Param | WrittenParam | None = self._wanted.get(name) or self._current.get(name)
        return None if param is None else param.value

    def _needs_reboot(self, name: str) -> bool:
        info = self._info.get(name)
        if info is not None and info.reboot_required:
            return True
        return self._cautions.needs_reboot(name, self._vehicle_type)


def _taken(steps: list[Step], fits: Callable[[Step], bool]) -> list[Step]:
    """Take those that fit out of the steps."""
    taken = [step for step in steps if fits(step)]
    steps[:] = [step for step in steps if not fits(step)]
    return taken


def _is_same(wanted: Value, held: Value, kind: ParamType | int | None) -> bool:
    """Whether a vehicle that holds a value has the wanted one; in its type, where that is known."""
    if isinstance(wanted, bytes) or isinstance(held, bytes):
        return wanted == held
    if kind is None:
        if isinstance(wanted, int) and isinstance(held, int):
            return wanted == held
        kind = ParamType.REAL32
    try:
        return same_bits(kind, bits_of(wanted, kind), bits_of(held, kind))
    except UsageError:
        return False


def _float32(value: float) -> float:
    """The nearest float32; what is beyond them becomes infinite."""
    try:
        number: float = struct.unpack("<f", struct.pack("<f", value))[0]
    except OverflowError:
        return math.copysign(math.inf, value)
    return number
