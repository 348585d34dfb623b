"""Schema and validation of paramclient's own file format. Loads pydantic; only reading imports it."""

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
from paramclient.files.text import PROBLEMS_MAX, as_type
from paramclient.model.identity import Identity
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import TYPES_BY_NAME, ParamType, WireValue, check_name, from_bits, known_type

__all__ = ["InvalidDocument", "Place", "parse"]

Place = tuple[str | int, ...]
"""Position in a document: keys and list indices from the top."""

_NUMBER_EXPECTED = "expected a number (or NaN, Infinity, 0x and 8 digits for raw bytes)"
_WORDS = {"NaN": float("nan"), "Infinity": float("inf"), "-Infinity": float("-inf")}
_raw = re.compile(r"0x([0-9a-fA-F]{8})").fullmatch
_type_number = re.compile(r"TYPE_([0-9]{1,3})").fullmatch
_date = re.compile(r"[0-9]{4}-[0-9]{2}-").match
_bits = re.compile(r"[0-9a-fA-F]{8}(?:[0-9a-fA-F]{8})?").fullmatch


def parse(
    content: object, source: str, params_max: int | None = None
) -> tuple[tuple[ParamSet, ...], tuple[str, ...]]:
    """Return the sets and the header of a document that was parsed from JSON or YAML.

    Validates sets and parameters one by one: for a whole document, pydantic would keep an error for each bad
    parameter, each error many times larger than the parameter, and would block all other threads.

    Raises:
        TooManyParams: the document has more parameters than `params_max`.
        InvalidDocument: the content is not a valid document.
    """
    faults = _Faults()
    document = faults.checked(_Document, content, ())
    raw_sets = content.get("sets") if isinstance(content, dict) else None
    sets_there = raw_sets if isinstance(raw_sets, list) else []
    named = [each.get("params") for each in sets_there if isinstance(each, dict)]
    TooManyParams.check(sum(len(each) for each in named if isinstance(each, dict)), params_max, source)
    found = [_Written.of(each, ("sets", number), faults) for number, each in enumerate(sets_there)]
    faults.raise_if_any()
    assert document is not None, "otherwise raise_if_any has raised"
    sets = [each.params(source, faults) for each in found]
    faults.raise_if_any()
    return tuple(sets), tuple(document.header)


class InvalidDocument(Exception):
    """A document does not follow the schema.

    Attributes:
        problems: the first positions with a problem, each with its description.
        count: the number of all problems.
    """

    def __init__(self, problems: list[tuple[Place, str]], count: int) -> None:
        super().__init__(problems)
        self.problems = problems
        self.count = count


class _Faults:
    """Problems of a document: a description of the first ones, and their total number."""

    def __init__(self) -> None:
        self._problems: list[tuple[Place, str]] = []
        self._count = 0

    def add(self, place: Place, describe: Callable[[], str]) -> None:
        """Add a problem."""
        self._count += 1
        if self._count <= PROBLEMS_MAX:
            self._problems.append((place, describe()))

    def checked(self, model: type[_Known], content: object, place: Place) -> _Known | None:
        """Return the content as an instance of the model; None if it is invalid."""
        found = None
        try:
            found = model.model_validate(content)
        except ValidationError as error:
            for each in error.errors(include_url=False):
                self.add((*place, *each["loc"]), partial(_description, each))
        if isinstance(content, dict):
            for name in content:
                if name not in model.model_fields:
                    self.add((*place, name), lambda: "unknown field")
        return found

    def raise_if_any(self) -> None:
        """Raise InvalidDocument if there is a problem."""
        if self._count:
            raise InvalidDocument(self._problems, self._count)


@dataclass(frozen=True, slots=True)
class _Written:
    """One set of a document, with its fields validated one by one."""

    place: Place
    set: _Set | None
    identity: _Identity | None
    written: dict[str, _Param]

    @classmethod
    def of(cls, content: object, place: Place, faults: _Faults) -> _Written:
        """Validate the set at a position of the document."""
        found = faults.checked(_Set, content, place)
        fields = content if isinstance(content, dict) else {}
        identity = fields.get("identity")
        named = fields.get("params")
        written = {}
        for name, each in (named if isinstance(named, dict) else {}).items():
            param = faults.checked(_Param, each, (*place, "params", name))
            if param is not None:
                written[name] = param
        parsed_identity = (
            None if identity is None else faults.checked(_Identity, identity, (*place, "identity"))
        )
        return cls(place, found, parsed_identity, written)

    def params(self, source: str, faults: _Faults) -> ParamSet:
        """Return the parameter set; add a problem for each parameter with contradictory fields."""
        assert self.set is not None, "otherwise the caller has raised its problem"
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
        raise ValueError(_NUMBER_EXPECTED)
    return content


_Scalar = Annotated[int | float | str, BeforeValidator(_is_scalar)]


class _Param(_Model):
    value: _Scalar
    type: str | None = None
    bits: str | None = None
    default: _Scalar | None = None
    comment: str = ""

    def param(self, name: str) -> WrittenParam:
        """Return the parameter; raise UsageError if its fields contradict each other."""
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
        """Reject a number: it could be seconds or milliseconds."""
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
    if text in TYPES_BY_NAME:
        return TYPES_BY_NAME[text]
    if match := _type_number(text):
        number = int(match[1])
        if number <= 255 and not isinstance(known_type(number), ParamType):
            return number
    raise UsageError(f"unknown type {text!r}; the types are {', '.join(TYPES_BY_NAME)}")


def _value(written: int | float | str) -> WireValue:
    if not isinstance(written, str):
        return written
    if written in _WORDS:
        return _WORDS[written]
    if match := _raw(written):
        return int(match[1], 16).to_bytes(4, "little")
    raise UsageError(f"{_NUMBER_EXPECTED}, found {written!r}")


def _with_bits(value: WireValue, kind: ParamType | int | None, text: str) -> WireValue:
    """Return the value of the bits, if it agrees with the given value; else raise UsageError."""
    if kind is None:
        raise UsageError("bits need a type")
    if not _bits(text):
        raise UsageError(f"bits are 8 or 16 hexadecimal digits, not {text!r}")
    bits = int(text, 16)
    size = kind.size if isinstance(kind, ParamType) and not isinstance(value, bytes) else 4
    if bits >= 1 << 8 * size:
        raise UsageError(f"bits {text} exceed the size of the type")
    exact = from_bits(bits, kind, is_raw=isinstance(value, bytes))
    both_nan = value != value and exact != exact
    if exact != value and not both_nan:
        raise UsageError(f"value {value!r} and bits {text} ({exact!r}) contradict each other; leave out one")
    return exact


def _description(error: Any) -> str:
    """Return one of pydantic's errors as a sentence."""
    if error["type"] == "missing":
        return "the field is missing"
    found = error["input"]
    text = error["msg"].removeprefix("Value error, ").replace("Input should", "it should")
    return text if isinstance(found, dict | list) else f"{text}, found {found!r}"
