"""How two sets of parameters stand to each other, and which of them has moved away from a third.

Nothing here knows of a vehicle, a file or the time: whatever can be had as a `ParamSet` can be compared.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum

from paramclient.errors import UsageError
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.patterns import NameChoice
from paramclient.model.values import ParamType, Value, bits_of, from_bits, same_bits

__all__ = ["Comparison", "Difference", "Moved", "Standing", "compare", "defaults_of", "same_value"]


class Standing(StrEnum):
    """How a parameter of the left stands to the one of the same name on the right."""

    SAME = "same"
    DIFFERENT = "different"
    ONLY_LEFT = "only left"
    ONLY_RIGHT = "only right"


class Moved(StrEnum):
    """Who has another value than the base. A side that lacks the parameter has not moved."""

    NEITHER = "neither"
    LEFT = "left"
    RIGHT = "right"
    BOTH = "both"
    """Both, to the same value."""
    CONFLICT = "conflict"
    """Both, to different values."""


@dataclass(frozen=True, slots=True)
class Difference:
    """One name of either side.

    Attributes:
        name: param_id.
        left, right: as each side has it, or None; at least one of them has.
        base: as the base has it, or None.
        standing: how left and right stand to each other. It is about values alone, see `types_differ`.
        moved: who has moved away from the base; None where the base does not know the name, or there is none.
    """

    name: str
    left: WrittenParam | None
    right: WrittenParam | None
    base: WrittenParam | None
    standing: Standing
    moved: Moved | None

    @property
    def is_same(self) -> bool:
        return self.standing is Standing.SAME

    @property
    def is_news(self) -> bool:
        """Whether there is anything to see: another value or type, or one that has moved."""
        return not self.is_same or self.types_differ or self.moved not in (None, Moved.NEITHER)

    @property
    def types_differ(self) -> bool:
        """Whether both sides say a type, and not the same one. `INT32 1` and `REAL32 1.0` are one value."""
        return (
            self.left is not None
            and self.right is not None
            and None not in (self.left.type, self.right.type)
            and self.left.type != self.right.type
        )

    @property
    def is_rounding(self) -> bool:
        """Whether they are different integers, and one is what a float32 makes of the other.

        A vehicle with the C-cast encoding gives integers beyond 24 bits rounded so, and they may be the same
        on board; only a packed file could tell.
        """
        if self.standing is not Standing.DIFFERENT or self.left is None or self.right is None:
            return False
        left, right = self.left.value, self.right.value
        if not (isinstance(left, int) and isinstance(right, int)):
            return False
        rounded = _bits(left, ParamType.REAL32)
        return (
            rounded is not None
            and rounded == _bits(right, ParamType.REAL32)
            and from_bits(rounded, ParamType.REAL32) in (left, right)
        )


@dataclass(frozen=True, slots=True)
class Comparison:
    """What came of a comparison.

    Attributes:
        left, right: what was compared, whole.
        base: what both were held against, or None.
        entries: every name of either side that was asked for, also those that are the same, ordered by name.
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
        """Those that are not the same."""
        return tuple(entry for entry in self.entries if not entry.is_same)

    @property
    def counts(self) -> Mapping[Standing, int]:
        """How many there are of each standing, 0 for those that do not occur."""
        return Counter(entry.standing for entry in self.entries)

    @property
    def moves(self) -> Mapping[Moved, int]:
        """How many have moved in each way; those that the base does not know are not counted."""
        return Counter(entry.moved for entry in self.entries if entry.moved is not None)

    def __repr__(self) -> str:
        return f"<Comparison {len(self.differences)} of {len(self.entries)} params not the same>"


def compare(
    left: ParamSet, right: ParamSet, *, base: ParamSet | None = None, names: Iterable[str] | None = None
) -> Comparison:
    """Hold two sets against each other, by `same_value`.

    Args:
        base: a third one, to tell who has moved away from it: an earlier state, or `defaults_of` both.
            Names that only it has are of no interest.
        names: names, or patterns of the shell (`MC_*`, `SERVO?_TRIM`) in the spelling of the vehicle, to
            leave out all others. Only these are compared.

    Raises:
        UsageError: a pattern fits no name of either side. Whoever misspells one must not hear that all is
            the same.
    """
    chosen = left.keys() | right.keys()
    if names is not None:
        chosen = _chosen(chosen, [names] if isinstance(names, str) else names)
    return Comparison(left, right, base, tuple(_hold(name, left, right, base) for name in sorted(chosen)))


def same_value(left: WrittenParam, right: WrittenParam) -> bool:
    """Whether both stand for one parameter value, whatever form they are written in.

    Where one of them is REAL32, or neither has a type and one is no whole number, both are rounded to float32
    first: files seldom give more digits than that. A value without a type is otherwise read as the type of
    the other side; integers are compared exactly. −0 equals 0, a NaN equals only the same NaN, and raw bytes
    equal only the same bytes of the same type.

    It is symmetrical, and not transitive: 16777217 and 16777217.0 are the same, 16777217.0 and 16777216 too.
    """
    if isinstance(left.value, bytes) or isinstance(right.value, bytes):
        return left.value == right.value and (None in (left.type, right.type) or left.type == right.type)
    if left.value == right.value:  # then they are so in any type, and most are: what follows takes its time
        return True
    kind = _common_type(left, right)
    if kind is None:
        return _same_number(left.value, right.value)
    ours, theirs = _bits(left.value, kind), _bits(right.value, kind)
    if ours is None or theirs is None:
        return ours == theirs and _same_number(left.value, right.value)
    return same_bits(kind, ours, theirs)


def defaults_of(*sets: ParamSet) -> ParamSet:
    """The firmware's defaults, as far as the sets know them: a base for `compare`.

    A parameter for which two of them name different defaults, as after a change of the firmware, is left out:
    there is nothing that both could have moved away from.
    """
    known: dict[str, WrittenParam] = {}
    disputed: set[str] = set()
    for each in sets:
        for name, param in each.items():
            if param.default is not None:
                default = WrittenParam(name, param.default, param.type)
                if not same_value(known.setdefault(name, default), default):
                    disputed.add(name)
    kept = {name: param for name, param in known.items() if name not in disputed}
    return ParamSet(kept, source="the firmware's defaults")


def _chosen(known: Collection[str], patterns: Iterable[str]) -> set[str]:
    chosen, useless = NameChoice(patterns).choose(known)
    if useless:
        raise UsageError(f"no parameter of either side is called {useless}")
    return chosen


def _hold(name: str, left: ParamSet, right: ParamSet, base: ParamSet | None) -> Difference:
    ours, theirs = left.get(name), right.get(name)
    before = None if base is None else base.get(name)
    standing = _standing(ours, theirs)
    return Difference(name, ours, theirs, before, standing, _moved(ours, theirs, before, standing))


def _standing(left: WrittenParam | None, right: WrittenParam | None) -> Standing:
    if right is None:
        return Standing.ONLY_LEFT
    if left is None:
        return Standing.ONLY_RIGHT
    return Standing.SAME if same_value(left, right) else Standing.DIFFERENT


def _moved(
    left: WrittenParam | None, right: WrittenParam | None, base: WrittenParam | None, standing: Standing
) -> Moved | None:
    if base is None:
        return None
    left_moved = left is not None and not same_value(left, base)
    right_moved = right is not None and not same_value(right, base)
    if left_moved and right_moved:
        return Moved.BOTH if standing is Standing.SAME else Moved.CONFLICT
    return Moved.LEFT if left_moved else Moved.RIGHT if right_moved else Moved.NEITHER


def _common_type(left: WrittenParam, right: WrittenParam) -> ParamType | int | None:
    """The type in which two numbers are compared, or None where they are as numbers."""
    kinds = {param.type for param in (left, right) if param.type is not None}
    if ParamType.REAL32 in kinds:
        return ParamType.REAL32
    if kinds:
        return kinds.pop() if len(kinds) == 1 else None
    return None if isinstance(left.value, int) and isinstance(right.value, int) else ParamType.REAL32


def _bits(value: Value, number: ParamType | int) -> int | None:
    """The bits of a value in a type, or None where it does not fit."""
    try:
        return bits_of(value, number)
    except UsageError:
        return None


def _same_number(left: int | float, right: int | float) -> bool:
    """Whether two numbers are equal as they are written; NaN by its bits."""
    if isinstance(left, float) and isinstance(right, float):
        kind = ParamType.REAL64
        return same_bits(kind, bits_of(left, kind), bits_of(right, kind))
    return left == right
