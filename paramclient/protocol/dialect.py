"""The two parameter protocols of MAVLink, plain and extended: their messages, values and acknowledgements."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from paramclient.model.values import (
    Encoding,
    Param,
    Value,
    bits_of_wire,
    encode_ext_value,
    encode_value,
    ext_param,
    from_bits,
)
from paramclient.wire import messages
from paramclient.wire.messages import Message

ReportedValue: TypeAlias = messages.ParamValue | messages.ParamExtValue
"""The message with a value, in either protocol."""


@dataclass(frozen=True, slots=True)
class Digest:
    """What a vehicle announced of its table.

    Attributes:
        hash: PX4's.
        count: of the parameters.
    """

    hash: int
    count: int

    @classmethod
    def of(cls, message: ReportedValue) -> Digest:
        """Return the digest in a `_HASH_CHECK`."""
        return cls(int.from_bytes(message.raw, "little"), message.param_count)


@dataclass(frozen=True, slots=True)
class Dialect:
    """One of the two protocols.

    Attributes:
        value: the message with a value: the first part of its key in a channel.
        list_request, read_request, set_request: the messages for all values, for one, and with a new one.
        has_ack: whether a set is acknowledged by a message of its own, in place of the value.
        encode: returns the bytes of a value of this type for the message. It raises UsageError where the
            value does not fit the type.
        param: returns the parameter of this name with the value in these bytes, its type and index.
    """

    value: type[ReportedValue]
    list_request: type[messages.ParamRequestList | messages.ParamExtRequestList]
    read_request: type[messages.ParamRequestRead | messages.ParamExtRequestRead]
    set_request: type[messages.ParamSet | messages.ParamExtSet]
    has_ack: bool
    encode: Callable[[Value, int, Encoding], bytes]
    param: Callable[[str, bytes, int, int | None, Encoding], Param]

    def request_list(self, target: tuple[int, int]) -> Message:
        """Return the request for all parameters."""
        return self.list_request(*target)

    def request_read(self, target: tuple[int, int], which: str | int) -> Message:
        """Return the request for one parameter, by name or index."""
        name, index = (which, -1) if isinstance(which, str) else ("", which)
        return self.read_request(*target, name, index)


def _plain_param(name: str, raw: bytes, number: int, index: int | None, encoding: Encoding) -> Param:
    bits, is_raw = bits_of_wire(raw, number, encoding)
    return Param(name, from_bits(bits, number, is_raw=is_raw), number, index, bits, is_raw=is_raw)


PLAIN = Dialect(
    *(messages.ParamValue, messages.ParamRequestList, messages.ParamRequestRead, messages.ParamSet),
    has_ack=False,
    encode=encode_value,
    param=_plain_param,
)
"""PARAM_REQUEST_READ, PARAM_REQUEST_LIST, PARAM_SET, and PARAM_VALUE, which is also the acknowledgement."""
EXTENDED = Dialect(
    messages.ParamExtValue,
    messages.ParamExtRequestList,
    messages.ParamExtRequestRead,
    messages.ParamExtSet,
    has_ack=True,
    encode=lambda value, number, encoding: encode_ext_value(value, number),
    param=lambda name, raw, number, index, encoding: ext_param(name, raw, number, index),
)
"""PARAM_EXT_REQUEST_READ, …; PARAM_EXT_ACK acknowledges a set."""
