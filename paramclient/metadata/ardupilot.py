"""ArduPilot's metadata files apm.pdef.xml and apm.pdef.json, which its build generates from source comments.

Source of the formats: `Tools/autotest/param_metadata` of ArduPilot (xmlemit.py, jsonemit.py). The texts are
written by hand, so a range or a list that cannot be parsed as numbers is left out. A file with another
structure is rejected.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Final
from xml.parsers import expat

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from paramclient.errors import MetadataError, UsageError
from paramclient.metadata.info import (
    BITS_MAX,
    DESCRIPTION_LENGTH_MAX,
    Metadata,
    ParamInfo,
    names_of,
    number_of,
    too_long_texts,
)
from paramclient.metadata.px4 import PARAMS_MAX, VALUE_NAMES_MAX, error_text, whole

__all__ = ["read_json", "read_xml"]

GROUP_DEPTH_MAX: Final = 16
"""Levels of elements; the files have six."""
XML_TAG_BYTES_MAX: Final = 65_536
"""Bytes of a tag or a comment, which the parser handles in one call; the longest of ArduPilot has 7,000."""
XML_BYTES_PER_CALL: Final = 16_384
"""Bytes parsed in one call, in which no other thread runs for about 2 ms."""


def read_xml(content: bytes, *, source: str) -> Metadata:
    """Read an apm.pdef.xml.

    Rejects document type declarations, and with them entities: the files have none.

    Raises:
        MetadataError: the file is invalid.
    """
    reader = _XmlReader(source)
    try:
        reader.parse(content)
    except MetadataError:
        raise
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise MetadataError(f"{source}: not XML: {error}", source=source) from None
    return _gathered(reader.found, source)


def read_json(document: object, *, source: str) -> Metadata:
    """Read an apm.pdef.json that has been parsed as JSON.

    Raises:
        MetadataError: the document is invalid.
    """
    groups = {} if not isinstance(document, dict) else {**document}
    if groups.pop("json", None) is None:
        raise MetadataError(f'{source}: has no "json" member, which ArduPilot\'s files have', source=source)
    count = 0
    for group, described in groups.items():
        if not isinstance(described, dict):
            raise MetadataError(f"{source}, {group:.40}: Input should be a valid dictionary", source=source)
        count += len(described)
        if count > PARAMS_MAX:
            raise _too_many(source)
    # one by one: pydantic lets no other thread run while it validates all in one call
    infos = (
        _described(each, source, (group, name)).info(name, group)
        for group, described in groups.items()
        for name, each in described.items()
    )
    return _gathered(infos, source)


def _described(content: object, source: str, within: tuple[str, str]) -> _Described:
    try:
        return _Described.model_validate(content)
    except ValidationError as error:
        raise MetadataError(f"{source}{error_text(error, within)}", source=source) from None


@dataclass(slots=True)
class _Row:
    """One parameter, with its fields as text."""

    name: str
    short: str = ""
    long: str = ""
    user: str = ""
    fields: dict[str, str] = field(default_factory=dict)
    values: dict[str, str] = field(default_factory=dict)
    bits: dict[str, str] = field(default_factory=dict)

    def info(self, group: str) -> ParamInfo:
        fields = self.fields
        low, high = _range(fields.get("Range", ""))
        values = self.values or _items(fields.get("Values", ""))
        bits = self.bits or _items(fields.get("Bitmask", ""))
        return ParamInfo(
            self.name,
            None,
            self.short,
            self.long,
            fields.get("Units", ""),
            low,
            high,
            _number(fields.get("Increment", "")),
            None,
            None,
            _values(values),
            _bits(bits),
            _is_true(fields.get("RebootRequired", "")),
            _is_true(fields.get("ReadOnly", "")),
            _is_true(fields.get("Volatile", "")),
            self.user,
            group,
        )


_Names = Annotated[dict[str, str], Field(max_length=VALUE_NAMES_MAX)]


class _Described(BaseModel):
    """A parameter in the JSON. A field that the build could not parse is one text."""

    model_config = ConfigDict(extra="ignore")

    short: str = Field("", alias="DisplayName")
    long: str = Field("", alias="Description")
    user: str = Field("", alias="User")
    units: str = Field("", alias="Units")
    range: _Names | str = Field("", alias="Range")
    increment: str = Field("", alias="Increment")
    values: _Names | str = Field("", alias="Values")
    bits: _Names | str = Field("", alias="Bitmask")
    reboot_required: str = Field("", alias="RebootRequired")
    is_read_only: str = Field("", alias="ReadOnly")
    is_volatile: str = Field("", alias="Volatile")

    def info(self, name: str, group: str) -> ParamInfo:
        span = self.range
        fields = {
            "Units": self.units,
            "Range": span if isinstance(span, str) else f"{span.get('low', '')} {span.get('high', '')}",
            "Increment": self.increment,
            "Values": self.values if isinstance(self.values, str) else "",
            "Bitmask": self.bits if isinstance(self.bits, str) else "",
            "RebootRequired": self.reboot_required,
            "ReadOnly": self.is_read_only,
            "Volatile": self.is_volatile,
        }
        values = {} if isinstance(self.values, str) else self.values
        bits = {} if isinstance(self.bits, str) else self.bits
        return _Row(name.rpartition(":")[2], self.short, self.long, self.user, fields, values, bits).info(
            group
        )


class _XmlReader:
    """Reads the parameters of an XML file, element by element.

    Attributes:
        found: the parameters; the group of each is its vehicle or library.
    """

    def __init__(self, source: str) -> None:
        self.found: list[ParamInfo] = []
        self._source = source
        self._depth = 0
        self._group = ""
        self._row: _Row | None = None
        # Receives the text of the current element, under _key.
        self._store: dict[str, str] | None = None
        self._key = ""
        self._text: list[str] = []
        self._text_length = 0  # of the current parameter

    def parse(self, content: bytes) -> None:
        """Parse the file.

        Raises:
            MetadataError: the file has a document type, or is not a parameter file.
            ExpatError, ValueError, LookupError: the file is not XML.
        """
        parser = expat.ParserCreate()
        parser.buffer_text = True
        if hasattr(parser, "SetReparseDeferralEnabled"):
            parser.SetReparseDeferralEnabled(False)  # a tag is examined four times at most
        parser.StartDoctypeDeclHandler = self._refuse_doctype
        parser.StartElementHandler = self._begin
        parser.EndElementHandler = self._end
        parser.CharacterDataHandler = self._take
        parsed = 0
        for start in range(0, len(content), XML_BYTES_PER_CALL):
            parser.Parse(content[start : start + XML_BYTES_PER_CALL], False)
            parsed = max(parsed, parser.CurrentByteIndex)
            if start - parsed > XML_TAG_BYTES_MAX:
                raise self._error(f"has a tag or a comment of more than {XML_TAG_BYTES_MAX:,} bytes")
        parser.Parse(b"", True)

    def _refuse_doctype(self, *_: object) -> None:
        raise self._error("has a document type (<!DOCTYPE …>), which ArduPilot's files do not have")

    def _begin(self, tag: str, attributes: dict[str, str]) -> None:
        self._depth += 1
        if self._depth == 1 and tag != "paramfile":
            raise self._error(f"begins with <{tag}>, not with <paramfile> as ArduPilot's files")
        if self._depth > GROUP_DEPTH_MAX:
            raise self._error(f"has more than {GROUP_DEPTH_MAX} levels")
        row = self._row
        if tag == "parameters":
            self._group = attributes.get("name", "")
        elif tag == "param":
            if row is not None:
                raise self._error(f"has a parameter inside {row.name}")
            name = attributes.get("name", "").rpartition(":")[2]
            if not name:
                raise self._error("has a parameter without a name")
            self._row = _Row(
                name,
                attributes.get("humanName", ""),
                attributes.get("documentation", ""),
                attributes.get("user", ""),
            )
        elif row is not None and tag in _KEYS:
            self._store = {"field": row.fields, "value": row.values, "bit": row.bits}[tag]
            self._key = attributes.get(_KEYS[tag], "")
            self._text = []

    def _take(self, text: str) -> None:
        if self._store is not None:
            self._text.append(text)
            self._text_length += len(text)
            if self._row is not None and self._text_length > DESCRIPTION_LENGTH_MAX:
                raise self._error(too_long_texts(self._row.name))

    def _end(self, tag: str) -> None:
        self._depth -= 1
        if tag == "param" and self._row is not None:
            if len(self.found) >= PARAMS_MAX:
                raise _too_many(self._source)
            self.found.append(self._row.info(self._group))
            self._row = None
            self._text_length = 0
        elif self._store is not None and tag in _KEYS:
            self._store[self._key] = "".join(self._text)
            self._store = None

    def _error(self, text: str) -> MetadataError:
        return MetadataError(f"{self._source}: {text}", source=self._source)


_KEYS: Final = {"field": "name", "value": "code", "bit": "code"}
_ITEM: Final = re.compile(r",(?=\s*[+-]?[0-9.]+\s*:)")
"""Separator of items: a comma before a number and a colon, as a name may contain commas."""


def _gathered(found: Iterable[ParamInfo], source: str) -> Metadata:
    """Return the parameters of all groups. Leaves out those that two vehicles describe differently."""
    infos: dict[str, ParamInfo] = {}
    doubtful = set()
    for info in found:
        before = infos.setdefault(info.name, info)
        if replace(before, group="") != replace(info, group=""):
            doubtful.add(info.name)
    if not infos:
        raise MetadataError(f"{source}: describes no parameters", source=source)
    return Metadata.of((info for info in infos.values() if info.name not in doubtful), source=source)


def _too_many(source: str) -> MetadataError:
    return MetadataError(f"{source}: describes more than {PARAMS_MAX} parameters", source=source)


def _range(text: str) -> tuple[int | float | None, int | float | None]:
    parts = text.replace(",", " ").split()
    low, high = (_number(part) for part in parts) if len(parts) == 2 else (None, None)
    return (None, None) if low is None or high is None or low > high else (low, high)


def _number(text: str) -> int | float | None:
    """Return a finite number, whole numbers as int; None for other text."""
    try:
        number = number_of(text)
    except UsageError:
        return None
    return None if number is None or not math.isfinite(number) else whole(number)


def _items(text: str) -> dict[str, str]:
    """Parse `0:Disabled,1:Enabled`; empty if any part has another format."""
    items = {}
    for each in _parts(text):
        code, colon, name = each.partition(":")
        if not colon:
            return {}
        items[code] = name
    return items


def _parts(text: str) -> Iterator[str]:
    """Split a text at `_ITEM`. Part by part: `re.split` lets no other thread run until it has ended."""
    start = 0
    for separator in _ITEM.finditer(text):
        yield text[start : separator.start()]
        start = separator.end()
    yield text[start:]


def _values(items: Mapping[str, str]) -> Mapping[int | float, str]:
    named = {_number(code): name.strip() for code, name in items.items()}
    return names_of({code: name for code, name in named.items() if code is not None and name})


def _bits(items: Mapping[str, str]) -> Mapping[int, str]:
    named = {_number(code): name.strip() for code, name in items.items()}
    return names_of(
        {
            code: name
            for code, name in named.items()
            if isinstance(code, int) and 0 <= code < BITS_MAX and name
        }
    )


def _is_true(text: str) -> bool:
    return text.strip().lower() == "true"
