"""ParamInfo and Metadata: units, range, names of values and bits of parameters."""

from __future__ import annotations

import difflib
import functools
import math
import operator
import re
from collections.abc import Iterable, Iterator, Mapping
from ctypes import c_float
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Final, TypeVar

from paramclient.errors import UsageError
from paramclient.model.names import counted
from paramclient.model.values import ParamType, Value, format_value, shortest_float

CHOICES_LISTED_MAX: Final = 12
"""Names that an error lists; of more names it lists the closest ones, so that the error stays readable."""
BITS_MAX: Final = 64
"""Bits of the widest type."""
INSTANCE: Final = "{n}"
"""Placeholder of the number in the name and texts of a group of equal parameters."""

Key = TypeVar("Key", int, int | float)


@dataclass(frozen=True, slots=True)
class ParamInfo:
    """The firmware's description of one parameter. Missing fields are None, "" or empty.

    Attributes:
        name: param_id; for a group of equal parameters with `{n}` in place of the number.
        type: its type, if given (ArduPilot does not give it).
        short_description, long_description: texts for users.
        units: such as `m/s` or `deg`.
        minimum, maximum: the range intended by the developers. Vehicles accept other values as well.
        increment: the recommended step for changes.
        decimals: the number of decimal places to show.
        default: the firmware's default; a particular vehicle may have another, see `Param.default`.
        values: the meaning of single values.
        bits: for a bit mask, the meaning of the bits by number from 0.
        reboot_required: whether a new value takes effect only after a reboot.
        is_read_only: whether only the vehicle sets the parameter.
        is_volatile: whether the vehicle changes the value on its own; PX4 excludes it from its hash.
        category, group: where ground stations show it.
    """

    name: str
    type: ParamType | None = None
    short_description: str = ""
    long_description: str = ""
    units: str = ""
    minimum: int | float | None = None
    maximum: int | float | None = None
    increment: int | float | None = None
    decimals: int | None = None
    default: int | float | None = None
    values: Mapping[int | float, str] = field(default_factory=dict, hash=False)
    bits: Mapping[int, str] = field(default_factory=dict, hash=False)
    reboot_required: bool = False
    is_read_only: bool = False
    is_volatile: bool = False
    category: str = ""
    group: str = ""

    def text(self, value: Value) -> str | None:
        """Return the name of a value: `Loiter`, or for a mask `GPS|Baro`. None without a name.

        Bits without a name, or with a number as name, are appended as one hexadecimal number. `parse`
        accepts the text, unless the name of a value is a number.
        """
        if isinstance(value, bytes | str) or not math.isfinite(value):
            return None
        number = shortest_float(value) if isinstance(value, float) else value
        named = self.values.get(number)
        if named is not None:
            return named
        if not self.bits or number != int(number):
            return None
        mask = self._unsigned(int(number))
        if mask is None or mask == 0:
            return None
        named_bits = {bit: name for bit, name in sorted(self.bits.items()) if number_of(name) is None}
        names = [name for bit, name in named_bits.items() if mask >> bit & 1]
        rest = mask & ~sum(1 << bit for bit in named_bits)
        return "|".join([*names, hex(rest)] if rest else names)

    def parse(self, text: str) -> int | float:
        """Return the value of a text: a number, the name of a value, or names of bits.

        A number always means itself, even if a name looks like it. Names are case-insensitive. Names of
        bits, and numbers among them, are joined with `|`, `+` or a comma.

        Raises:
            UsageError: the text is none of these; the error suggests names.
        """
        number = number_of(text)
        if number is not None:
            return number
        value = self._only(self.values, text)
        if value is None and self.bits:
            value = self._mask(text)
        if value is None:
            raise UsageError(f"{self.name}: {text!r} is not a number{self._suggestion(text)}")
        return value

    def problem(self, value: Value) -> str | None:
        """Return why a value is invalid: it is outside the range. None for a valid value.

        Fractions are compared as float32, the precision of vehicles.
        """
        if isinstance(value, bytes | str):
            return None
        if math.isnan(value):
            is_bounded = self.minimum is not None or self.maximum is not None
            return f"{self.name}: nan is outside every range" if is_bounded else None
        units = f" {self.units}" if self.units else ""
        shown = format_value(value)
        if self.minimum is not None and _is_below(value, self.minimum):
            return f"{self.name}: {shown} is below the minimum of {format_value(self.minimum)}{units}"
        if self.maximum is not None and _is_below(self.maximum, value):
            return f"{self.name}: {shown} is above the maximum of {format_value(self.maximum)}{units}"
        return None

    def instance(self, name: str, number: str) -> ParamInfo:
        """Return the description of one parameter of a group of equal parameters."""
        return replace(
            self,
            name=name,
            short_description=self.short_description.replace(INSTANCE, number),
            long_description=self.long_description.replace(INSTANCE, number),
        )

    def _unsigned(self, number: int) -> int | None:
        """Return the bits of a number; None for a negative one of unknown width."""
        if number >= 0:
            return number
        if self.type is None or not self.type.is_integer:
            return None
        return number & ((1 << 8 * self.type.size) - 1)

    def _mask(self, text: str) -> int | None:
        """Return the mask of the names of bits in a text; None if one of them is unknown.

        Raises:
            UsageError: the text is ambiguous.
        """
        bit = self._bit(text)
        if bit is not None:
            return self._as_typed(bit)
        for joints in ("|", "|+,"):
            bits = [self._bit(part) for part in re.split(f"[{joints}]", text)]
            if None in bits:
                continue
            for name in self.bits.values():
                if any(joint in name for joint in joints) and _folded(name) in _folded(text):
                    raise UsageError(f"{self.name}: {text!r} can mean several things; give the number")
            return self._as_typed(functools.reduce(operator.or_, (bit for bit in bits if bit is not None)))
        return None

    def _bit(self, text: str) -> int | None:
        """Return the mask of one name or number."""
        number = number_of(text)
        if number is not None:
            return number if isinstance(number, int) and 0 <= number < 1 << BITS_MAX else None
        bit = self._only(self.bits, text)
        return None if bit is None else 1 << bit

    def _as_typed(self, mask: int) -> int:
        """Return the number with these bits in a signed type."""
        if self.type is None or not self.type.is_integer:
            return mask
        over = 1 << 8 * self.type.size
        return mask - over if self.type.bounds[1] < mask < over else mask

    def _only(self, named: Mapping[Key, str], text: str) -> Key | None:
        """Return the number with this name; None if there is none.

        Raises:
            UsageError: several numbers have this name.
        """
        folded = _folded(text)
        found = [number for number, name in named.items() if folded and _folded(name) == folded]
        if len(found) > 1:
            listed = " and ".join(map(str, found))
            raise UsageError(f"{self.name}: {text.strip()!r} is the name of {listed}; give the number")
        return found[0] if found else None

    def _suggestion(self, text: str) -> str:
        """Return the end of an error, with the names that may have been meant."""
        if not self.bits:
            return _choice(", nor one of its values", self.values, text)
        parts = [part.strip() for part in re.split("[|+,]", text)]
        if len(parts) == 1:
            return _choice(", nor one of its bits", self.bits, text)
        wrong = next((part for part in parts if self._bit(part) is None), text)
        return _choice(f", nor is {wrong!r} one of its bits", self.bits, wrong)


@dataclass(frozen=True, slots=True, repr=False)
class Metadata(Mapping[str, ParamInfo]):
    """Descriptions of a firmware's parameters, by name. Immutable.

    A parameter that is described as one of a group (`FOO{n}_BAR` for FOO1_BAR, FOO2_BAR, …) is found by its
    own name; the group counts and is listed once.

    Attributes:
        params: the descriptions, as in the file.
        source: their origin, for users.
    """

    params: Mapping[str, ParamInfo]
    source: str = ""

    @classmethod
    def of(cls, infos: Iterable[ParamInfo], *, source: str = "") -> Metadata:
        """Return these descriptions; of two with the same name, the last one."""
        return cls(MappingProxyType({info.name: info for info in infos}), source)

    def __getitem__(self, name: str) -> ParamInfo:
        found = self.params.get(name)
        if found is not None:
            return found
        for digits in _DIGITS.finditer(name):
            group = self.params.get(f"{name[: digits.start()]}{INSTANCE}{name[digits.end() :]}")
            if group is not None:
                return group.instance(name, digits.group())
        raise KeyError(name)

    def find(self, name: str) -> ParamInfo | None:
        """Return the description of a parameter, also by its name in lower case, as ArduPilot accepts it."""
        return self.get(name) or self.get(name.upper())

    def defaults_of(self, names: Iterable[str]) -> dict[str, int | float]:
        """Return the firmware's defaults of those of the named parameters for which it is given."""
        found = ((name, info.default) for name in names if (info := self.get(name)) is not None)
        return {name: default for name, default in found if default is not None}

    def __iter__(self) -> Iterator[str]:
        return iter(self.params)

    def __len__(self) -> int:
        return len(self.params)

    def __repr__(self) -> str:
        origin = f" from {self.source}" if self.source else ""
        return f"<Metadata of {counted(len(self), 'param')}{origin}>"


def whole(number: int | float | None) -> int | float | None:
    """Return a whole number as int; other numbers, and None, unchanged."""
    return int(number) if isinstance(number, float) and number.is_integer() else number


def finite(number: int | float | None) -> int | float | None:
    """Return a finite number, a whole one as int; else None."""
    return None if number is None or not math.isfinite(number) else whole(number)


def number_of(text: str) -> int | float | None:
    """Return the number of a text, exactly: integers as int, others as float. None for other text.

    Hexadecimal numbers begin with `0x`; `nan` and `inf` are numbers.

    Raises:
        UsageError: the number is beyond the range of a float.
    """
    text = text.strip()
    if _INTEGER.fullmatch(text):
        return int(text, 16 if "x" in text.lower() else 10)
    if _REAL.fullmatch(text):
        value = float(text)
        if math.isinf(value) and "i" not in text.lower():
            raise UsageError(f"{text} is beyond the range of a float")
        return value
    return None


_INTEGER: Final = re.compile(r"[+-]?(0[xX][0-9a-fA-F]{1,32}|[0-9]{1,40})")
_REAL: Final = re.compile(
    r"[+-]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][+-]?[0-9]+)?|[+-]?(inf|infinity|nan)", re.IGNORECASE
)
_DIGITS: Final = re.compile(r"[0-9]+")


def _folded(name: str) -> str:
    """Return a name without case and repeated spaces, for comparison."""
    return " ".join(name.split()).casefold()


def _choice(sentence: str, named: Mapping[Key, str], text: str) -> str:
    """Return the end of an error with all names, or with those close to a text if there are many."""
    if not named:
        return ", and its values have no names"
    if len(named) <= CHOICES_LISTED_MAX:
        return f"{sentence}: {', '.join(f'{name} ({number})' for number, name in named.items())}"
    folded = {_folded(name): name for name in named.values()}
    nearest = [folded[each] for each in difflib.get_close_matches(_folded(text), folded, n=3, cutoff=0.5)]
    if nearest:
        return f"{sentence}; similar: {', '.join(nearest)}"
    return f"{sentence}, of which there are {len(named)}"


def _is_below(a: int | float, b: int | float) -> bool:
    if isinstance(a, int) and isinstance(b, int):
        return a < b
    return c_float(a).value < c_float(b).value  # infinite beyond the range
