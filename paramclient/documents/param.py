"""Documents of one parameter: of a vehicle or the cache, of a file, and of its metadata."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from paramclient.documents.document import Document, Maybe, Scalar
from paramclient.model.defaults import DefaultSource, default_of
from paramclient.model.notation import (
    bits_text,
    bits_written,
    parse_number,
    parse_value,
    value_json,
    value_written,
)
from paramclient.model.values import (
    Param,
    ParamType,
    Trust,
    format_value,
    from_bits,
    type_name,
    type_of_name,
)

if TYPE_CHECKING:
    from paramclient.errors import ParamClientError
    from paramclient.metadata import Metadata, ParamInfo
    from paramclient.model.paramset import WrittenParam

__all__ = [
    "DescribedDoc",
    "ReadOutputDoc",
    "InfoDoc",
    "InfosDoc",
    "ParamDoc",
    "WrittenParamDoc",
    "short_text",
]

SHORT_TEXT_LENGTH_MAX: Final = 400
"""Maximum number of characters of the members `text` and `units`, which thousands of rows may repeat. No
request to the service accepts a longer name of a value."""

"""The types by name."""


class InfoDoc(Document):
    """The metadata of a parameter; members without a value are left out."""

    short_description: Maybe[str] = None
    long_description: Maybe[str] = None
    units: Maybe[str] = None
    minimum: Maybe[Scalar] = None
    maximum: Maybe[Scalar] = None
    increment: Maybe[Scalar] = None
    decimals: Maybe[int] = None
    default: Maybe[Scalar] = None
    values: Maybe[dict[str, str]] = None
    bits: Maybe[dict[str, str]] = None
    reboot_required: Maybe[bool] = None
    is_read_only: Maybe[bool] = None
    is_volatile: Maybe[bool] = None
    category: Maybe[str] = None
    group: Maybe[str] = None

    @classmethod
    def of(cls, info: ParamInfo) -> InfoDoc:
        """Return the document of a `ParamInfo`."""
        return cls(
            short_description=info.short_description or None,
            long_description=info.long_description or None,
            units=info.units or None,
            minimum=_number(info.minimum),
            maximum=_number(info.maximum),
            increment=_number(info.increment),
            decimals=info.decimals,
            default=_number(info.default),
            values={format_value(value): name for value, name in info.values.items()} or None,
            bits={str(bit): name for bit, name in info.bits.items()} or None,
            reboot_required=info.reboot_required or None,
            is_read_only=info.is_read_only or None,
            is_volatile=info.is_volatile or None,
            category=info.category or None,
            group=info.group or None,
        )

    def info(self, name: str) -> ParamInfo:
        """Return the `ParamInfo` of a parameter, without its type.

        Raises:
            ArithmeticError, TypeError, ValueError: a member is not valid.
        """
        from paramclient.metadata.info import ParamInfo, number_of  # only here: loads the clients

        def number(given: Scalar | None) -> int | float | None:
            value = None if given is None else parse_number(given)
            return None if isinstance(value, bytes) else value

        named = {
            value: text for key, text in (self.values or {}).items() if (value := number_of(key)) is not None
        }
        return ParamInfo(
            name,
            short_description=self.short_description or "",
            long_description=self.long_description or "",
            units=self.units or "",
            minimum=number(self.minimum),
            maximum=number(self.maximum),
            increment=number(self.increment),
            decimals=self.decimals,
            default=number(self.default),
            values=MappingProxyType(named),
            bits=MappingProxyType({int(bit): text for bit, text in (self.bits or {}).items()}),
            reboot_required=bool(self.reboot_required),
            is_read_only=bool(self.is_read_only),
            is_volatile=bool(self.is_volatile),
            category=self.category or "",
            group=self.group or "",
        )


class ParamDoc(Document):
    """One parameter of a vehicle; in the JSON of the command line its name is the key of the document.

    `default_source` is the origin of `default`: `vehicle` or `metadata`. `text` is the meaning of the value
    in a word; above 400 characters, it is left out, and so are `units`. `trust`, `is_default` and `heard_at`
    (unix seconds) come with parameters of a table; `metadata` has all metadata of the parameter.
    """

    name: Maybe[str] = None
    value: Scalar
    type: str
    index: int | None
    bits: str
    default: Maybe[Scalar] = None
    default_source: Maybe[DefaultSource] = None
    is_default: Maybe[bool] = None
    trust: Maybe[str] = None
    heard_at: Maybe[float] = None
    text: Maybe[str] = None
    units: Maybe[str] = None
    metadata: Maybe[InfoDoc] = None

    @classmethod
    def of(
        cls,
        param: Param,
        info: ParamInfo | None = None,
        *,
        whole: bool = False,
        described: int | float | None = None,
    ) -> ParamDoc:
        """Return the document of a parameter, without its name.

        Args:
            param: the parameter.
            info: its metadata, or None.
            whole: whether to include all metadata.
            described: its default in the metadata where `info` is None, or None; see `default_of`.
        """
        known, source = _with_default(param, info, described)
        return cls(**_members(known, source, info, whole=whole))

    @classmethod
    def kept(
        cls,
        param: Param,
        info: ParamInfo | None = None,
        *,
        heard_at: float | None = None,
        whole: bool = False,
        described: int | float | None = None,
    ) -> ParamDoc:
        """Return the document of a parameter of a table: with name, trust and the time of its reception.

        Args:
            param, info, whole, described: as in `of`.
            heard_at: unix time in seconds at which the value was received, or None.
        """
        known, source = _with_default(param, info, described)
        is_changed = known.is_changed
        return cls(
            name=param.name,
            is_default=None if is_changed is None else not is_changed,
            trust=param.trust.value,
            heard_at=heard_at,
            **_members(known, source, info, whole=whole),
        )

    def param(self, name: str) -> Param:
        """Return the parameter, without loss; without trust in the document, it is *cached*.

        A default of the metadata is left out, as `Param.default` is what the vehicle has given.

        Args:
            name: param_id.

        Raises:
            ArithmeticError, LookupError, TypeError, ValueError: a member is not valid.
        """
        kind = type_of_name(self.type)
        bits = int(self.bits, 16)
        is_raw = isinstance(self.value, str) and self.value.startswith("0x")
        default = None if self.default_source is DefaultSource.METADATA else self.default
        return Param(
            name,
            from_bits(bits, kind, is_raw=is_raw),
            kind,
            self.index,
            bits,
            Trust.CACHED if self.trust is None else Trust(self.trust),
            None if default is None else parse_value(default, kind),
        )


class WrittenParamDoc(Document):
    """A parameter of a file or of another set; its name is the key of the document.

    Without a type, `value` is the number as the file has it, and `bits` is null. In a comparison, `text` is
    the meaning of the value in a word, if known, and `default` and `comment` are left out. `default_source`
    is the origin of `default` where that of the metadata counts too.
    """

    value: Scalar
    type: str | None
    bits: str | None
    default: Maybe[Scalar] = None
    default_source: Maybe[DefaultSource] = None
    comment: Maybe[str] = None
    text: Maybe[str] = None

    @classmethod
    def of(cls, param: WrittenParam, source: DefaultSource | None = None) -> WrittenParamDoc:
        """Return the document of a `WrittenParam`, without its line number.

        Args:
            param: the parameter.
            source: the origin of its default, if that is to be included.
        """
        return cls(
            value=value_written(param.settable, param),
            type=None if param.type_number is None else type_name(param.type_number),
            bits=bits_written(param),
            default=None if param.default is None else value_written(param.default, param),
            default_source=source,
            comment=param.comment or None,
        )

    @classmethod
    def compared(cls, param: WrittenParam, metadata: Metadata | None = None) -> WrittenParamDoc:
        """Return the document of a parameter of one side of a comparison, with the metadata of that side."""
        info = None if metadata is None else metadata.find(param.name)
        text = None if info is None else short_text(info.text(param.settable))
        return cls.of(param).model_copy(update={"default": None, "comment": None, "text": text})


class ReadOutputDoc(Document):
    """Requested parameters by name, and the errors of those that were not received."""

    params: dict[str, ParamDoc]
    errors: Maybe[dict[str, str]] = None

    @classmethod
    def of(
        cls, params: Iterable[Param], metadata: Metadata | None, errors: Mapping[str, ParamClientError]
    ) -> ReadOutputDoc:
        """Return the document of parameters with all their metadata, and of errors by name."""
        return cls(
            params={
                param.name: ParamDoc.of(
                    param, None if metadata is None else metadata.find(param.name), whole=True
                )
                for param in params
            },
            errors={name: str(error) for name, error in errors.items()} or None,
        )


class InfosDoc(Document):
    """Metadata of parameters by name; `source` is its origin."""

    source: str
    params: dict[str, InfoDoc]

    @classmethod
    def of(cls, metadata: Metadata, names: Iterable[str]) -> InfosDoc:
        """Return the document of the metadata of these names; names without metadata are left out."""
        found = {name: metadata.find(name) for name in names}
        return cls(
            source=metadata.source,
            params={name: InfoDoc.of(info) for name, info in found.items() if info is not None},
        )

    def metadata(self) -> Metadata:
        """Return the metadata; see `InfoDoc.info`."""
        from paramclient.metadata.info import Metadata  # only here: loads the clients

        return Metadata.of((each.info(name) for name, each in self.params.items()), source=self.source)


class DescribedDoc(Document):
    """The number of parameters, or groups of them, with metadata, and the origin of the metadata."""

    count: int
    source: str


def short_text(text: str | None) -> str | None:
    """Return a text of metadata; None if it is empty or longer than `SHORT_TEXT_LENGTH_MAX`."""
    return text if text and len(text) <= SHORT_TEXT_LENGTH_MAX else None


def _with_default(
    param: Param, info: ParamInfo | None, described: int | float | None
) -> tuple[Param, DefaultSource | None]:
    """Return a parameter with its default, and the origin of the default; see `default_of`."""
    default = default_of(param, described if info is None else info.default)
    if default is None or param.default is not None:
        return param, None if default is None else default.source
    return replace(param, default=default.value), default.source


def _members(
    param: Param, source: DefaultSource | None, info: ParamInfo | None, *, whole: bool
) -> dict[str, Any]:
    """Return the members of every `ParamDoc`, of a parameter with its default."""
    members: dict[str, Any] = {
        "value": value_json(param.settable, param.type_number),
        "type": type_name(param.type_number),
        "index": param.index,
        "bits": bits_text(param),
    }
    if param.default is not None:
        members["default"] = value_json(param.default, param.type_number)
        members["default_source"] = source
    if info is not None:
        members |= {"text": short_text(info.text(param.settable)), "units": short_text(info.units)}
        if whole:
            members["metadata"] = InfoDoc.of(info)
    return members


def _number(number: int | float | None) -> Scalar | None:
    return None if number is None else value_json(number, ParamType.REAL64)
