"""A vehicle that serves a part of the protocol."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from paramclient import Encoding, ParamType
from paramclient.model.values import encode_value
from paramclient.wire import messages
from tests.conversations.virtual import Puppet

TABLE: dict[str, tuple[float, ParamType]] = {
    **{f"GAIN_{number}": (number / 2, ParamType.REAL32) for number in range(5)},
    "MODE": (5, ParamType.INT32),
    "OFFSET": (-7, ParamType.INT16),
    "NODE_ID": (3, ParamType.UINT8),
}
EVERYTHING = ("list", "names", "indices", "sets", "acks", "commands")


class Partial(Puppet):
    """A vehicle with the parts of the protocol that a test gives it.

    Args:
        table: values and types, by name.
        serves: of `EVERYTHING`; with "ends", an empty name to a read of any other index.
        first, step: the first index, and the interval between two.
        count: returns the param_count of an index.
        encoding: of the values.
        ack_type: the type in acknowledgements; None for the parameter's.
        on_set: returns the answers to a set, which changes nothing then; None for those of `serves`.
        version: answers requests for it; None for a refusal.
        asked_as: the component id under which it is asked, if that is not its own.
        options: as of `Puppet`.
    """

    def __init__(
        self,
        table: Mapping[str, tuple[float | bytes, ParamType]] = TABLE,
        *,
        serves: Iterable[str] = EVERYTHING,
        first: int = 0,
        step: int = 1,
        count: Callable[[int], int] | None = None,
        encoding: Encoding = Encoding.BYTEWISE,
        ack_type: ParamType | None = None,
        on_set: Callable[[messages.ParamSet], Iterable[messages.Message]] | None = None,
        version: messages.AutopilotVersion | None = None,
        asked_as: int | None = None,
        **options: Any,
    ) -> None:
        super().__init__(self.answers, **options)
        self.values = {name: encode_value(value, kind, encoding) for name, (value, kind) in table.items()}
        self.types = {name: kind for name, (_, kind) in table.items()}
        self.serves = set(serves)
        self._indices = {name: first + step * place for place, name in enumerate(table)}
        self.sent_as: dict[str, str] = {}  # other names of parameters
        self._count = count or (lambda index: len(table))
        self._ack_type = ack_type
        self._on_set = on_set
        self._version = version
        self._target = options.get("component", 1) if asked_as is None else asked_as

    def number_of(self, kind: type[messages.Message]) -> int:
        """Return the number of received messages of a kind."""
        return sum(isinstance(each, kind) for each in self.received)

    def _value(self, name: str, kind: ParamType | None = None) -> messages.ParamValue:
        index = self._indices[name]
        kind = self.types[name] if kind is None else kind
        sent_as = self.sent_as.get(name, name)
        return messages.ParamValue(sent_as, self.values[name], kind, self._count(index), index)

    def answers(self, message: messages.Message) -> Iterable[messages.Message]:
        if getattr(message, "target_component", self._target) != self._target:
            return
        match message:
            case messages.ParamRequestList() if "list" in self.serves:
                yield from map(self._value, self.values)
            case messages.ParamRequestRead(param_index=index, param_id=name):
                by_index = {at: each for each, at in self._indices.items() if "indices" in self.serves}
                name = by_index.get(index, "") if index >= 0 else name if "names" in self.serves else ""
                if name in self.values:
                    yield self._value(name)
                elif index >= 0 and "ends" in self.serves:
                    yield messages.ParamValue("", bytes(4), ParamType.REAL32, self._count(index), index)
            case messages.ParamSet() if self._on_set is not None:
                yield from self._on_set(message)
            case messages.ParamSet(param_id=name, raw=raw) if name in self.values:
                if "sets" in self.serves:
                    self.values[name] = raw
                if "acks" in self.serves:
                    yield self._value(name, self._ack_type)
            case messages.CommandLong(command=command) if "commands" in self.serves:
                yield messages.CommandAck(command, 3) if self._version is None else self._version
