"""The two parameter protocols of MAVLink, plain and extended: their messages, values and acknowledgements."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TypeAlias

from paramclient.model.ext_values import encode_ext_value, ext_param
from paramclient.model.values import (
    Encoding,
    Param,
    WireValue,
    bits_of_wire,
    encode_value,
    from_bits,
    known_type,
)
from paramclient.wire import messages
from paramclient.wire.messages import Message

__all__ = ["EXTENDED", "PLAIN", "Dialect", "Digest", "ReportedValue"]

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


class Dialect(ABC):
    """One of the two protocols.

    Attributes:
        name: "plain" or "extended".
        value: the message with a value: the first part of its key in a channel.
        has_ack: whether a set is acknowledged by a message of its own, in place of the value.
    """

    name: str
    value: type[ReportedValue]
    has_ack: bool

    @abstractmethod
    def request_list(self, target: tuple[int, int]) -> Message:
        """Return the request for all parameters."""

    @abstractmethod
    def request_read(self, target: tuple[int, int], which: str | int) -> Message:
        """Return the request for one parameter, by name or index."""

    @abstractmethod
    def request_set(self, target: tuple[int, int], name: str, raw: bytes, number: int) -> Message:
        """Return the request to set a parameter to these bytes, in this type."""

    @abstractmethod
    def encode(self, value: WireValue, number: int, encoding: Encoding) -> bytes:
        """Return the bytes of a value for the message.

        Raises:
            UsageError: the value does not fit the type.
        """

    @abstractmethod
    def param(self, name: str, raw: bytes, number: int, index: int | None, encoding: Encoding) -> Param:
        """Return the parameter with the value in these bytes."""


class _Plain(Dialect):
    name = "plain"
    value = messages.ParamValue
    has_ack = False

    def request_list(self, target: tuple[int, int]) -> Message:
        return messages.ParamRequestList(*target)

    def request_read(self, target: tuple[int, int], which: str | int) -> Message:
        name, index = (which, -1) if isinstance(which, str) else ("", which)
        return messages.ParamRequestRead(*target, name, index)

    def request_set(self, target: tuple[int, int], name: str, raw: bytes, number: int) -> Message:
        return messages.ParamSet(*target, name, raw, number)

    def encode(self, value: WireValue, number: int, encoding: Encoding) -> bytes:
        return encode_value(value, number, encoding)

    def param(self, name: str, raw: bytes, number: int, index: int | None, encoding: Encoding) -> Param:
        bits, is_raw = bits_of_wire(raw, number, encoding)
        value = from_bits(bits, number, is_raw=is_raw)
        return Param(name, value, known_type(number), index, bits, is_raw=is_raw)


class _Extended(Dialect):
    name = "extended"
    value = messages.ParamExtValue
    has_ack = True

    def request_list(self, target: tuple[int, int]) -> Message:
        return messages.ParamExtRequestList(*target)

    def request_read(self, target: tuple[int, int], which: str | int) -> Message:
        name, index = (which, -1) if isinstance(which, str) else ("", which)
        return messages.ParamExtRequestRead(*target, name, index)

    def request_set(self, target: tuple[int, int], name: str, raw: bytes, number: int) -> Message:
        return messages.ParamExtSet(*target, name, raw, number)

    def encode(self, value: WireValue, number: int, encoding: Encoding) -> bytes:
        return encode_ext_value(value, number)

    def param(self, name: str, raw: bytes, number: int, index: int | None, encoding: Encoding) -> Param:
        return ext_param(name, raw, number, index)


PLAIN = _Plain()
"""PARAM_REQUEST_READ, PARAM_REQUEST_LIST, PARAM_SET, and PARAM_VALUE, which is also the acknowledgement."""
EXTENDED = _Extended()
"""PARAM_EXT_REQUEST_READ, …; PARAM_EXT_ACK acknowledges a set."""
