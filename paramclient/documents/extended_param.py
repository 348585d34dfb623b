"""The document of one extended parameter, and the JSON form of its value."""

from __future__ import annotations

import math

from paramclient.documents.document import Document, Maybe, Scalar
from paramclient.model.ext_params import ExtParam, ExtParamType, ExtValue, ext_type_name, ext_type_number
from paramclient.model.values import Trust, shortest_float

__all__ = ["ExtParamDoc", "ext_value_json"]


class ExtParamDoc(Document):
    """One extended parameter; in the JSON of the command line its name is the key of the document.

    `value` is null for bytes that are no text; `hex` has the bytes of every value. `trust` and `heard_at`
    (unix seconds) come with parameters of a table.
    """

    name: Maybe[str] = None
    value: Scalar | None
    type: str
    index: int | None
    hex: str
    trust: Maybe[str] = None
    heard_at: Maybe[float] = None

    @classmethod
    def of(cls, param: ExtParam) -> ExtParamDoc:
        """Return the document of a parameter, without its name."""
        return cls(
            value=ext_value_json(param.value, param.type),
            type=ext_type_name(param.type),
            index=param.index,
            hex=param.raw.hex(),
        )

    @classmethod
    def kept(cls, param: ExtParam, *, heard_at: float | None = None) -> ExtParamDoc:
        """Return the document of a parameter of a table: with name, trust and the time of its reception.

        Args:
            param: the parameter.
            heard_at: unix time in seconds at which the value was received, or None.
        """
        return cls(
            name=param.name,
            value=ext_value_json(param.value, param.type),
            type=ext_type_name(param.type),
            index=param.index,
            hex=param.raw.hex(),
            trust=param.trust.value,
            heard_at=heard_at,
        )

    def param(self, name: str) -> ExtParam:
        """Return the parameter, without loss; without trust in the document, it is *cached*.

        Args:
            name: param_id.

        Raises:
            ValueError: a member is not valid.
        """
        trust = Trust.CACHED if self.trust is None else Trust(self.trust)
        return ExtParam.of(name, bytes.fromhex(self.hex), ext_type_number(self.type), self.index, trust)


def ext_value_json(value: ExtValue, number: int) -> Scalar | None:
    """Return a value in strict JSON: NaN and infinities as text; None for bytes."""
    if isinstance(value, bytes):
        return None
    if not isinstance(value, float):
        return value
    if math.isfinite(value):
        return shortest_float(value) if number == ExtParamType.REAL32 else value
    return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
