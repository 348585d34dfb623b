"""Documents of one parameter: of a vehicle or the cache, of a file, and of its metadata."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from paramclient.documents.document import Document, Maybe, Scalar
from paramclient.model.notation import bits_text, bits_written, value_json, value_written
from paramclient.model.values import Param, ParamType, format_value, type_name

if TYPE_CHECKING:
    from paramclient.errors import ParamClientError
    from paramclient.metadata import Metadata, ParamInfo
    from paramclient.model.paramset import WrittenParam

__all__ = ["DescribedDoc", "GotDoc", "InfoDoc", "InfosDoc", "ParamDoc", "WrittenParamDoc"]


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


class ParamDoc(Document):
    """One parameter of a vehicle; in the JSON of the command line its name is the key of the document.

    `text` is the meaning of the value in a word. `trust`, `is_default` and `heard_at` (unix seconds) come
    with parameters of a table; `metadata` has all metadata of the parameter.
    """

    name: Maybe[str] = None
    value: Scalar
    type: str
    index: int | None
    bits: str
    default: Maybe[Scalar] = None
    is_default: Maybe[bool] = None
    trust: Maybe[str] = None
    heard_at: Maybe[float] = None
    text: Maybe[str] = None
    units: Maybe[str] = None
    metadata: Maybe[InfoDoc] = None

    @classmethod
    def of(cls, param: Param, info: ParamInfo | None = None, *, whole: bool = False) -> ParamDoc:
        """Return the document of a parameter, without its name.

        Args:
            param: the parameter.
            info: its metadata, or None.
            whole: whether to include all metadata.
        """
        return cls(
            value=value_json(param.value, param.type),
            type=type_name(param.type),
            index=param.index,
            bits=bits_text(param),
            default=None if param.default is None else value_json(param.default, param.type),
            text=None if info is None else info.text(param.value) or None,
            units=None if info is None else info.units or None,
            metadata=InfoDoc.of(info) if info is not None and whole else None,
        )

    @classmethod
    def kept(
        cls,
        param: Param,
        info: ParamInfo | None = None,
        *,
        heard_at: float | None = None,
        whole: bool = False,
    ) -> ParamDoc:
        """Return the document of a parameter of a table: with name, trust and the time of its reception.

        Args:
            param, info, whole: as in `of`.
            heard_at: unix time in seconds at which the value was received, or None.
        """
        return cls.of(param, info, whole=whole).model_copy(
            update={
                "name": param.name,
                "is_default": None if param.default is None else not param.is_changed,
                "trust": param.trust.value,
                "heard_at": heard_at,
            }
        )


class WrittenParamDoc(Document):
    """A parameter of a file; its name is the key of the document.

    Without a type, `value` is the number as the file has it, and `bits` is null.
    """

    value: Scalar
    type: str | None
    bits: str | None
    default: Maybe[Scalar] = None
    comment: Maybe[str] = None

    @classmethod
    def of(cls, param: WrittenParam) -> WrittenParamDoc:
        """Return the document of a `WrittenParam`, without its line number."""
        return cls(
            value=value_written(param.value, param),
            type=None if param.type is None else type_name(param.type),
            bits=bits_written(param),
            default=None if param.default is None else value_written(param.default, param),
            comment=param.comment or None,
        )


class GotDoc(Document):
    """Requested parameters by name, and the errors of those that were not received."""

    params: dict[str, ParamDoc]
    errors: Maybe[dict[str, str]] = None

    @classmethod
    def of(
        cls, params: Iterable[Param], metadata: Metadata | None, errors: Mapping[str, ParamClientError]
    ) -> GotDoc:
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


class DescribedDoc(Document):
    """The number of parameters, or groups of them, with metadata, and the origin of the metadata."""

    count: int
    source: str


def _number(number: int | float | None) -> Scalar | None:
    return None if number is None else value_json(number, ParamType.REAL64)
