"""Reset of parameters to the firmware's defaults: the values to write, and the result."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from paramclient.errors import UsageError
from paramclient.model.values import Param, Value, bits_of, same_bits
from paramclient.protocol.params.write_batch import SetManyResult

__all__ = ["ResetChoice", "ResetResult"]


@dataclass(frozen=True, slots=True)
class ResetChoice:
    """What a reset writes.

    Attributes:
        values: the defaults to write, by name, in the order of the names.
        unchanged: names of parameters that have their default already.
        without_default: names of parameters without a known default.
    """

    values: Mapping[str, Value]
    unchanged: tuple[str, ...]
    without_default: tuple[str, ...]

    @classmethod
    def of(cls, params: Iterable[Param], defaults: Mapping[str, Value]) -> ResetChoice:
        """Choose the values to write.

        Args:
            params: the present parameters.
            defaults: defaults of parameters whose default the vehicle has not given; the vehicle's own
                default has priority.
        """
        values: dict[str, Value] = {}
        unchanged, unknown = [], []
        for param in params:
            default = defaults.get(param.name) if param.default is None else param.default
            if default is None:
                unknown.append(param.name)
            elif _has_value(param, default):
                unchanged.append(param.name)
            else:
                values[param.name] = default
        return cls(values, tuple(unchanged), tuple(unknown))


@dataclass(frozen=True, slots=True)
class ResetResult:
    """The result of a reset to the firmware's defaults.

    Attributes:
        written: the outcomes of the values that were written; see `Component.set_many`.
        unchanged: names of parameters that had their default already; nothing was written to them.
        without_default: names of parameters without a known default; nothing was written to them.
    """

    written: SetManyResult
    unchanged: tuple[str, ...]
    without_default: tuple[str, ...]

    @property
    def is_complete(self) -> bool:
        """Whether each named parameter has its default now, as far as the vehicle stores it."""
        return not self.without_default and self.written.is_complete

    def __repr__(self) -> str:
        counts = ", ".join(f"{count} {status}" for status, count in self.written.counts.items())
        return (
            f"<ResetResult {self.written.system}/{self.written.component} {counts or 'nothing written'}, "
            f"{len(self.unchanged)} unchanged, {len(self.without_default)} without default>"
        )


def _has_value(param: Param, value: Value) -> bool:
    """Return whether a parameter has this value, as far as its type can represent the value."""
    try:
        return same_bits(param.type, param.bits, bits_of(value, param.type))
    except UsageError:  # not in the range of the type; the write reports it
        return False
