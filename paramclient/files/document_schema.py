"""What the document of paramclient may hold, guarded field by field; only reading one loads this room."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from paramclient.errors import UsageError
from paramclient.files.param_file import TooManyParams
from paramclient.files.text import MOST_PROBLEMS, as_type
from paramclient.model.identity import Identity
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import ParamType, Value, check_name, from_bits, known_type

__all__ = ["Place", "Wrong", "parse"]

Place = tuple[str | int, ...]
"""Where in a document something stands: keys and positions from the top."""

_A_NUMBER = "expected a number (or NaN, Infinity, 0x and 8 digits for raw bytes)"
_WORDS = {"NaN": float("nan"), "Infinity": float("inf"), "-Infinity": float("-inf")}
_raw = re.compile(r"0x([0-9a-fA-F]{8})").fullmatch
_type_number = re.compile(r"TYPE_([0-9]{1,3})").fullmatch
_date = re.compile(r"[0-9]{4}-[0-9]{2}-").match
_bits = re.compile(r"[0-9a-fA-F]{8}(?:[0-9a-fA-F]{8})?").fullmatch


def parse(
    content: object, source: str, params_max: int | None = None
) -> tuple[tuple[ParamSet, ...], tuple[str, ...]]:
    """The sets and the header of a document that was read as JSON or YAML.

    Sets and parameters are validated one by one: pydantic would keep an error for each bad one, which is many
    times as large as what it is about, and would let no other thread run meanwhile.

    Raises:
        TooManyParams: it holds more than `params_max`.
        Wrong: it is not one.
    """
    faults = _Faults()
    document = faults.checked(_Document, content, ())
    raw_sets = content.get("sets") if isinstance(content, dict) else None
    sets_there = raw_sets if isinstance(raw_sets, list) else []
    named = [each.get("params") for each in sets_there if isinstance(each, dict)]
    TooManyParams.check(sum(len(each) for each in named if isinstance(each, dict)), params_max, source)
    found = [_Written.of(each, ("sets", number), faults) for number, each in enumerate(sets_there)]
    faults.raise_if_any()
    assert document is not None, "else there is a fault"
    sets = [each.params(source, faults) for each in found]
    faults.raise_if_any()
    return tuple(sets), tuple(document.header)


class Wrong(Exception):
    """A document is not as it should be.

    Attributes:
        problems: the first places in it, and what is wrong there.
        count: how many there are.
    """

    def __init__(self, problems: list[tuple[Place, str]], count: int) -> None:
        super().__init__(problems)
        self.problems = problems
        self.count = count


class _Faults:
    """What is wrong with a document: the first few in words, the others by their number."""

    def __init__(self) -> None:
        self._problems: list[tuple[Place, str]] = []
        self._count = 0

    def add(self, place: Place, told: Callable[[], str]) -> None:
        """One more."""
        self._count += 1
        if self._count <= MOST_PROBLEMS:
            self._problems.append((place, told()))

    def checked(self, model: type[_Known], content: object, place: Place) -> _Known | None:
        """The content as this model has it; None where it is wrong."""
        found = None
        try:
            found = model.model_validate(content)
        except ValidationError as error:
            for each in error.errors(include_url=False):
                self.add((*place, *each["loc"]), partial(_told, each))
        if isinstance(content, dict):
            for name in content:
                if name not in model.model_fields:
                    self.add((*place, name), lambda: "no such field is known")
        return found

    def raise_if_any(self) -> None:
        """Raise Wrong for all of it, if there is anything."""
        if self._count:
            raise Wrong(self._problems, self._count)


@dataclass(frozen=True, slots=True)
class _Written:
    """A set as it is written."""

    place: Place
    set: _Set | None
    identity: _Identity | None
    written: dict[str, _Param]

    @classmethod
    def of(cls, content: object, place: Place, faults: _Faults) -> _Written:
        """The set that stands at a place."""
        found = faults.checked(_Set, content, place)
        fields = content if isinstance(content, dict) else {}
        identity = fields.get("identity")
        named = fields.get("params")
        written = {}
        for name, each in (named if isinstance(named, dict) else {}).items():
            param = faults.checked(_Param, each, (*place, "params", name))
            if param is not None:
                written[name] = param
        who = None if identity is None else faults.checked(_Identity, identity, (*place, "identity"))
        return cls(place, found, who, written)

    def params(self, source: str, faults: _Faults) -> ParamSet:
        """Its parameters, where the fields of each agree."""
        assert self.set is not None, "else there was a fault"
        params = {}
        for name, written in self.written.items():
            try:
                params[check_name(name)] = written.param(name)
            except UsageError as error:
                faults.add((*self.place, "params", name), partial(str, error))
        identity = None if self.identity is None else Identity(**self.identity.model_dump())
        at = None if self.set.at is None else self.set.at.timestamp()
        return ParamSet(params, self.set.component, self.set.system, identity, at, source)


class _Model(BaseModel):
    model_config = ConfigDict(strict=True, allow_inf_nan=False)


_Known = TypeVar("_Known", bound=_Model)
_Id = Annotated[int, Field(ge=1, le=255)]
_Count = Annotated[int, Field(ge=0)]


class _Identity(_Model):
    system: _Id
    link: str = ""
    uid: str | None = None
    autopilot: _Count = 0
    vehicle_type: _Count = 0
    firmware: _Count = 0
    git_hash: str = ""
    board: _Count = 0
    vendor_id: _Count = 0
    product_id: _Count = 0
    capabilities: _Count = 0


def _is_scalar(content: object) -> object:
    if isinstance(content, bool) or not isinstance(content, int | float | str):
        raise ValueError(_A_NUMBER)
    return content


_Scalar = Annotated[int | float | str, BeforeValidator(_is_scalar)]


class _Param(_Model):
    value: _Scalar
    type: str | None = None
    bits: str | None = None
    default: _Scalar | None = None
    comment: str = ""

    def param(self, name: str) -> WrittenParam:
        """The parameter; UsageError where its fields contradict each other."""
        kind = None if self.type is None else _kind(self.type)
        value = _value(self.value)
        default = None if self.default is None else _value(self.default)
        if kind is not None:
            value = as_type(value, kind)
            default = None if default is None else as_type(default, kind)
        if self.bits is not None:
            value = _with_bits(value, kind, self.bits)
        return WrittenParam(name, value, kind, default, self.comment)


class _Set(_Model):
    system: _Id | None = None
    component: _Id | None = None
    identity: Any = None
    at: Annotated[datetime | None, Field(strict=False)] = None
    source: str = ""
    params: dict[str, Any]

    @model_validator(mode="before")
    @classmethod
    def _time_is_text(cls, content: Any) -> Any:
        """A bare number could be seconds or milliseconds."""
        at = content.get("at") if isinstance(content, dict) else None
        if at is not None and not (isinstance(at, str) and _date(at)):
            raise ValueError("the time `at` is written as 2026-01-31T12:00:00Z")
        return content

    @model_validator(mode="after")
    def _time_has_zone(self) -> _Set:
        if self.at is not None and self.at.tzinfo is None:
            raise ValueError("the time `at` needs its zone, as in 2026-01-31T12:00:00Z")
        return self


class _Document(_Model):
    paramclient: Literal[1]
    header: Annotated[list[str], Field(fail_fast=True)] = []
    sets: list[Any]


def _kind(text: str) -> ParamType | int:
    if text in ParamType.__members__:
        return ParamType[text]
    if match := _type_number(text):
        number = int(match[1])
        if number <= 255 and not isinstance(known_type(number), ParamType):
            return number
    raise UsageError(f"no type is called {text!r}; types are {', '.join(ParamType.__members__)}")


def _value(written: int | float | str) -> Value:
    if not isinstance(written, str):
        return written
    if written in _WORDS:
        return _WORDS[written]
    if match := _raw(written):
        return int(match[1], 16).to_bytes(4, "little")
    raise UsageError(f"{_A_NUMBER}, found {written!r}")


def _with_bits(value: Value, kind: ParamType | int | None, text: str) -> Value:
    """The value that the bits say, if that is the value which stands beside them."""
    if kind is None:
        raise UsageError("bits say nothing without a type")
    if not _bits(text):
        raise UsageError(f"bits are 8 or 16 hexadecimal digits, not {text!r}")
    bits = int(text, 16)
    size = kind.size if isinstance(kind, ParamType) and not isinstance(value, bytes) else 4
    if bits >= 1 << 8 * size:
        raise UsageError(f"bits {text} are more than the type has")
    exact = from_bits(bits, kind, is_raw=isinstance(value, bytes))
    both_nan = value != value and exact != exact
    if exact != value and not both_nan:
        raise UsageError(f"value {value!r} and bits {text} ({exact!r}) contradict each other; leave out one")
    return exact


def _told(error: Any) -> str:
    """What pydantic found, in a sentence."""
    if error["type"] == "missing":
        return "the field is missing"
    found = error["input"]
    text = error["msg"].removeprefix("Value error, ").replace("Input should", "it should")
    return text if isinstance(found, dict | list) else f"{text}, found {found!r}"
