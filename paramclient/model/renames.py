"""Parameters that firmware versions name differently: the rules, and the conversion of names and values."""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Iterator
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Final

from paramclient.errors import FileError, UsageError
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import ParamType, WireValue, check_name, shortest_float

__all__ = ["Rename", "Renames"]

PARAM_NAMES_MAX: Final = 16
"""Maximum number of names of one parameter. Each conversion multiplies the factors between two of them."""
FACTOR_MAX: Final = 10**308
"""Largest factor: the next power of ten is no float."""


@dataclass(frozen=True, slots=True)
class Rename:
    """One parameter that a firmware version gave another name.

    Attributes:
        old: the name in older firmware.
        new: the name in newer firmware.
        factor: the number by which a value of the old name is multiplied to get that of the new one.
        line: the line in the file of the rules, from 1; None for other sources. Takes no part in equality.
    """

    old: str
    new: str
    factor: int | float = 1
    line: int | None = field(default=None, compare=False)


class Renames:
    """Parameters that firmware versions name differently, for `plan`, `apply`, `verify` and `compare`.

    A parameter may be renamed several times: A to B in one entry, and B to C in another one.

    Args:
        entries: the renamed parameters.
        source: the file of the rules, for messages.

    Attributes:
        entries: the renamed parameters.
        source: as given.

    Raises:
        FileError: an entry has an invalid name, or a factor that is 0 or not finite; a name has two new names
            or two old ones; the entries return to a name; or a parameter has more than 16 names. `line` is
            that of the entry.
    """

    def __init__(self, entries: Iterable[Rename] = (), source: str = "") -> None:
        self.entries = tuple(entries)
        self.source = source
        self._newer: dict[str, Rename] = {}
        self._older: dict[str, Rename] = {}
        for entry in self.entries:
            self._add(entry)

    def other_names(self, name: str) -> tuple[str, ...]:
        """Return the other names of a parameter: newer ones, then older ones, in each case nearest first."""
        return tuple(other for other, _ in self._others(name))

    def renamed(self, params: ParamSet, names: Container[str]) -> dict[str, WrittenParam]:
        """Return the parameters that have another name among `names`, under that name, by their own names.

        A parameter whose name is among `names` is left out. Of several other names, the nearest newer one
        counts, else the nearest older one.

        Args:
            params: the parameters, such as those of a file.
            names: the names to find, such as those of a vehicle.

        Raises:
            UsageError: two parameters would get one name, or raw bytes would have to be multiplied.
        """
        found: dict[str, WrittenParam] = {}
        taken: dict[str, str] = {}
        for name, param in params.items():
            other = None if name in names else self.find(name, names)
            if other is None:
                continue
            before = other if other in params else taken.setdefault(other, name)
            if before != name:
                of = f" of {params.source}" if params.source else ""
                raise UsageError(
                    f"{before} and {name}{of} are both {other} by {self._place}; remove one of the two"
                )
            found[name] = self.convert(param, other)
        return found

    def apply_to(self, params: ParamSet, names: Container[str]) -> ParamSet:
        """Return a set with the parameters of `renamed` in place of the original ones.

        Raises:
            UsageError: as from `renamed`.
        """
        found = self.renamed(params, names)
        kept = (found.get(name, param) for name, param in params.items())
        return replace(params, params={param.name: param for param in kept}) if found else params

    def find(self, name: str, names: Container[str]) -> str | None:
        """Return the other name of a parameter that is among `names`; None if there is none."""
        return next((other for other, _ in self._others(name) if other in names), None)

    def factor(self, name: str, other: str) -> Fraction:
        """Return the number by which a value of `name` is multiplied to get that of `other`.

        Raises:
            UsageError: the names are not those of one parameter.
        """
        for known, ratio in self._others(name):
            if known == other:
                return ratio
        raise UsageError(f"{name} and {other} are two parameters by {self._place}")

    def convert(self, param: WrittenParam, other: str) -> WrittenParam:
        """Return a parameter under another one of its names, with value and default multiplied.

        Computes with the decimal digits of the numbers, so that 0.07 / 0.01 is 7. If the factor is not 1, the
        result has no type, because the type belongs to the values of the old name.

        Raises:
            UsageError: the names are not those of one parameter, or raw bytes would have to be multiplied.
        """
        ratio = self.factor(param.name, other)
        if ratio == 1:
            return replace(param, name=other)
        try:
            value = _multiplied(param.settable, param.type_number, ratio)
            default = None if param.default is None else _multiplied(param.default, param.type_number, ratio)
        except UsageError as error:
            raise UsageError(f"{param.name} cannot become {other}: {error}") from None
        return replace(param, name=other, value=value, type=None, default=default)

    def missing_note(self, name: str) -> str:
        """Return the words about the other names of a parameter that a vehicle has under none of them.

        "" if it has no other names.
        """
        newer = [entry.new for entry in self._walk(name, newer=True)]
        older = [entry.old for entry in self._walk(name, newer=False)]
        known = [f"{word} {' and '.join(names)}" for word, names in (("to", newer), ("from", older)) if names]
        if not known:
            return ""
        return f"renamed {' and '.join(known)} in {self._place}, which this vehicle does not have either"

    def __len__(self) -> int:
        return len(self.entries)

    def __repr__(self) -> str:
        return f"<Renames {len(self.entries)} from {self._place}>"

    @property
    def _place(self) -> str:
        return self.source or "the renames"

    def _add(self, entry: Rename) -> None:
        def error(message: str) -> FileError:
            return FileError(message, source=self.source, line=entry.line)

        for name in (entry.old, entry.new):
            try:
                check_name(name)
            except UsageError as problem:
                raise error(str(problem)) from None
        factor = entry.factor
        if isinstance(factor, bool) or not isinstance(factor, int | float):
            raise error(f"the factor of {entry.old} is not a number: {factor!r:.60}")
        if isinstance(factor, int) and abs(factor) > FACTOR_MAX:
            raise error(f"the factor of {entry.old} is beyond the range of a float")
        if factor == 0 or not math.isfinite(factor):
            raise error(
                f"the factor of {entry.old} is {factor!r}; a value must be convertible in both directions"
            )
        if entry.old in self._newer:
            raise error(f"{entry.old} has two new names: {self._newer[entry.old].new} and {entry.new}")
        if entry.new in self._older:
            raise error(f"{entry.new} has two old names: {self._older[entry.new].old} and {entry.old}")
        chain = [entry.new, *(each.new for each in self._walk(entry.new, newer=True))]
        if entry.old in chain:
            raise error(f"the renames return to {entry.old}: {' to '.join([entry.old, *chain])}")
        if len(chain) + 1 + sum(1 for _ in self._walk(entry.old, newer=False)) > PARAM_NAMES_MAX:
            raise error(f"{entry.old} is one of more than {PARAM_NAMES_MAX} names of one parameter")
        self._newer[entry.old] = self._older[entry.new] = entry

    def _walk(self, name: str, *, newer: bool) -> Iterator[Rename]:
        """Yield the entries from a name to ever newer or ever older names."""
        entries = self._newer if newer else self._older
        while (entry := entries.get(name)) is not None:
            yield entry
            name = entry.new if newer else entry.old

    def _others(self, name: str) -> Iterator[tuple[str, Fraction]]:
        """Yield the other names, nearest first, each with the factor from `name` to it."""
        ratio = Fraction(1)
        for entry in self._walk(name, newer=True):
            ratio *= _exact(entry.factor)
            yield entry.new, ratio
        ratio = Fraction(1)
        for entry in self._walk(name, newer=False):
            ratio /= _exact(entry.factor)
            yield entry.old, ratio


def _multiplied(value: WireValue, kind: ParamType | int | None, ratio: Fraction) -> int | float:
    """Return the product, as an int if it is a whole number.

    Raises:
        UsageError: the value is no number.
    """
    if isinstance(value, bytes | str):
        raise UsageError("its value is no number, and cannot be multiplied")
    if isinstance(value, float) and not math.isfinite(value):
        return math.copysign(value, value * (1 if ratio > 0 else -1))
    if isinstance(value, float) and kind != ParamType.REAL64:
        value = shortest_float(value)  # the digits that a file or a user would write
    product = _exact(value) * ratio
    try:
        number = float(product)
    except OverflowError:
        return math.inf if product > 0 else -math.inf
    return int(product) if product.denominator == 1 else number


def _exact(number: int | float) -> Fraction:
    """Return a number as its shortest decimal digits denote it: 0.1 is a tenth."""
    return Fraction(number) if isinstance(number, int) else Fraction(repr(number))
