"""Comparison of two parameter sets, optionally against a common base.

Has no knowledge of vehicles, files or time: every source that gives a `ParamSet` can be compared.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum

from paramclient.errors import UsageError
from paramclient.model.names import NameChoice
from paramclient.model.paramset import AnyParams, ParamSet, WrittenParam, set_of
from paramclient.model.values import ParamType, Value, bits_of, from_bits, same_bits


class DifferenceStatus(StrEnum):
    """How the left parameter compares with the right parameter of the same name."""

    SAME = "same"
    DIFFERENT = "different"
    ONLY_LEFT = "only left"
    ONLY_RIGHT = "only right"


class ChangedSide(StrEnum):
    """Which side has another value than the base. A side without the parameter counts as unchanged."""

    NEITHER = "neither"
    LEFT = "left"
    RIGHT = "right"
    BOTH = "both"
    """Both sides differ from the base and have the same value."""
    CONFLICT = "conflict"
    """Both sides differ from the base and have different values."""


@dataclass(frozen=True, slots=True)
class Difference:
    """The comparison of one name.

    Attributes:
        name: param_id.
        left, right: the parameter on each side, or None; at least one is not None.
        base: the parameter in the base, or None.
        status: how left and right compare, by value alone (see `types_differ`).
        changed_side: which side differs from the base; None without a base, or if the base lacks the name.
    """

    name: str
    left: WrittenParam | None
    right: WrittenParam | None
    base: WrittenParam | None
    status: DifferenceStatus
    changed_side: ChangedSide | None

    @property
    def is_same(self) -> bool:
        return self.status is DifferenceStatus.SAME

    @property
    def is_shown(self) -> bool:
        """Whether to report the entry: the values or types differ, or a side differs from the base."""
        return not self.is_same or self.types_differ or self.changed_side not in (None, ChangedSide.NEITHER)

    @property
    def types_differ(self) -> bool:
        """Whether both sides have a type and the types differ. `INT32 1` equals `REAL32 1.0`."""
        types = {each.type for each in (self.left, self.right) if each is not None and each.type is not None}
        return len(types) == 2

    @property
    def is_rounding(self) -> bool:
        """Whether the values are different integers, and one is the other rounded to float32.

        A vehicle with the C-cast encoding reports integers beyond 24 bits rounded this way, so the values
        may be equal on board. Only a packed parameter file holds the exact value.
        """
        if self.status is not DifferenceStatus.DIFFERENT or self.left is None or self.right is None:
            return False
        values = self.left.settable, self.right.settable
        if not all(isinstance(each, int) for each in values):
            return False
        rounded, other = (_bits(each, ParamType.REAL32) for each in values)
        return rounded is not None and rounded == other and from_bits(rounded, ParamType.REAL32) in values


@dataclass(frozen=True, slots=True)
class Comparison:
    """The result of a comparison.

    Attributes:
        left, right: the compared sets, complete.
        base: the base, or None.
        entries: every selected name of either side, equal ones included, ordered by name.
    """

    left: ParamSet
    right: ParamSet
    base: ParamSet | None
    entries: tuple[Difference, ...]

    @property
    def is_same(self) -> bool:
        """Whether both sides have the same names with the same values."""
        return all(entry.is_same for entry in self.entries)

    @property
    def differences(self) -> tuple[Difference, ...]:
        """The entries that are not the same."""
        return tuple(entry for entry in self.entries if not entry.is_same)

    @property
    def counts(self) -> Mapping[DifferenceStatus, int]:
        """The number of entries of each status, 0 for those that do not occur."""
        return Counter(entry.status for entry in self.entries)

    @property
    def changed_sides(self) -> Mapping[ChangedSide, int]:
        """The number of entries by the side that differs from the base, without names that the base lacks."""
        return Counter(entry.changed_side for entry in self.entries if entry.changed_side is not None)

    def __repr__(self) -> str:
        return f"<Comparison {len(self.differences)} of {len(self.entries)} params not the same>"


def compare(
    left: AnyParams,
    right: AnyParams,
    *,
    base: AnyParams | None = None,
    names: Iterable[str] | None = None,
) -> Comparison:
    """Compare two sets with `same_value`.

    Args:
        left, right: the sets, which may also be tables, or plain values by name.
        base: a third set, to determine which side differs from it: an earlier state, or `defaults_of` both.
            Names that only the base has are ignored.
        names: names or shell patterns (`MC_*`, `SERVO?_TRIM`), case-sensitive, to compare only the names
            that match.

    Raises:
        UsageError: a pattern matches no name of either side. Without this error, a misspelt name would
            compare as equal.
    """
    left, right, base = set_of(left), set_of(right), None if base is None else set_of(base)
    chosen = left.keys() | right.keys()
    if names is not None:
        given = [names] if isinstance(names, str) else names
        lacks = "".join(f" ({each.source}: {each.lacks})" for each in (left, right) if each.lacks)
        chosen = NameChoice(given).choose(chosen, f" of either side{lacks}")
    entries = []
    for name in sorted(chosen):
        ours, theirs, before = left.get(name), right.get(name), None if base is None else base.get(name)
        entries.append(Difference(name, ours, theirs, before, *_judge(ours, theirs, before)))
    return Comparison(left, right, base, tuple(entries))


def non_defaults(params: ParamSet) -> ParamSet:
    """Return the parameters that differ from the firmware's defaults, as far as these are known."""
    defaults = {name: default for name, param in params.items() if (default := _default_of(param))}
    return replace(params, params={n: params[n] for n in defaults if not same_value(params[n], defaults[n])})


def same_value(left: WrittenParam, right: WrittenParam) -> bool:
    """Return whether both are the same parameter value, independent of the notation.

    If one of them is REAL32, or neither has a type and one is not a whole number, both are rounded to float32
    first: files seldom give more digits. Otherwise a value without a type is read as the type of the other
    side; integers are compared exactly. −0 equals 0, NaN equals only the same NaN, and raw bytes equal only
    the same bytes of the same type.

    Symmetric but not transitive: 16777217 equals 16777217.0, and 16777217.0 equals 16777216.
    """
    if left.is_raw or right.is_raw:
        types = left.type, right.type
        return left.settable == right.settable and (None in types or types[0] == types[1])
    if left.value == right.value:  # equal in every type, and the common case: skips the slower comparison
        return True
    kind = _common_type(left, right)
    if kind is None:
        return _same_number(left.value, right.value)
    ours, theirs = _bits(left.value, kind), _bits(right.value, kind)
    if ours is None or theirs is None:
        return ours == theirs and _same_number(left.value, right.value)
    return same_bits(kind, ours, theirs)


def defaults_of(*sets: ParamSet) -> ParamSet:
    """Return the firmware's defaults that the sets contain: a base for `compare`.

    A parameter with different defaults in two sets, as after a change of the firmware, is left out: the sides
    have no common default.
    """
    known: dict[str, WrittenParam] = {}
    disputed: set[str] = set()
    for each in sets:
        for name, param in each.items():
            default = _default_of(param)
            if default is not None and not same_value(known.setdefault(name, default), default):
                disputed.add(name)
    kept = {name: param for name, param in known.items() if name not in disputed}
    return ParamSet(kept, source="the firmware's defaults")


def _default_of(param: WrittenParam) -> WrittenParam | None:
    """Return a parameter with its default as the value; None if that is not known."""
    return None if param.default is None else WrittenParam(param.name, param.default, param.type)


def _judge(
    left: WrittenParam | None, right: WrittenParam | None, base: WrittenParam | None
) -> tuple[DifferenceStatus, ChangedSide | None]:
    if left is None or right is None:
        status = DifferenceStatus.ONLY_RIGHT if left is None else DifferenceStatus.ONLY_LEFT
    else:
        status = DifferenceStatus.SAME if same_value(left, right) else DifferenceStatus.DIFFERENT
    if base is None:
        return status, None
    is_left, is_right = (each is not None and not same_value(each, base) for each in (left, right))
    if is_left and is_right:
        return status, ChangedSide.BOTH if status is DifferenceStatus.SAME else ChangedSide.CONFLICT
    return status, ChangedSide.LEFT if is_left else ChangedSide.RIGHT if is_right else ChangedSide.NEITHER


def _common_type(left: WrittenParam, right: WrittenParam) -> ParamType | int | None:
    """Return the type in which to compare two values, or None to compare them as numbers."""
    kinds = {param.type for param in (left, right) if param.type is not None}
    if ParamType.REAL32 in kinds:
        return ParamType.REAL32
    if kinds:
        return kinds.pop() if len(kinds) == 1 else None
    return None if isinstance(left.value, int) and isinstance(right.value, int) else ParamType.REAL32


def _bits(value: Value, number: ParamType | int) -> int | None:
    """Return the bits of a value in a type, or None if the value does not fit."""
    try:
        return bits_of(value, number)
    except UsageError:
        return None


def _same_number(left: Value, right: Value) -> bool:
    """Return whether two numbers are equal as written; NaN by its bits."""
    if isinstance(left, float) and isinstance(right, float):
        return same_bits(ParamType.REAL64, *(bits_of(each, ParamType.REAL64) for each in (left, right)))
    return bool(left == right)
