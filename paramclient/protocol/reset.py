"""Reset of parameters to the firmware's defaults: the values to write."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass

from paramclient.errors import UsageError
from paramclient.model.values import Param, Trust, WireValue, bits_of, same_bits

__all__ = ["ResetChoice", "read_unconfirmed"]


@dataclass(frozen=True, slots=True)
class ResetChoice:
    """The values that a reset writes.

    Attributes:
        values: the defaults to write, by name, in the order of the names.
        unchanged: names of parameters that have their default already.
        without_default: names of parameters without a known default.
    """

    values: Mapping[str, WireValue]
    unchanged: tuple[str, ...]
    without_default: tuple[str, ...]

    @classmethod
    def of(cls, params: Iterable[Param], defaults: Mapping[str, WireValue]) -> ResetChoice:
        """Choose the values to write.

        Args:
            params: the current parameters.
            defaults: defaults of parameters whose default the vehicle has not given; the vehicle's own
                default has priority.
        """
        values: dict[str, WireValue] = {}
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


async def read_unconfirmed(
    table: Mapping[str, Param], read: Callable[[str], Awaitable[Param]], names: Iterable[str]
) -> list[Param]:
    """Return parameters of a fetched table in the order of the names; read those that are only cached.

    Args:
        table: `Component.params`.
        read: reads a parameter into the table.
        names: param_ids; of equal ones the first counts.

    Raises:
        UnknownParameter: the vehicle has no parameter with one of the names.
        ParamClientError: as from `Component.get`.
    """
    params = []
    for name in dict.fromkeys(names):
        param = table.get(name)
        if param is None or param.trust is Trust.CACHED:
            await read(name)
            param = table[name]
        params.append(param)
    return params


def _has_value(param: Param, value: WireValue) -> bool:
    """Return whether a parameter has this value, as far as its type can represent the value."""
    try:
        return same_bits(param.type_number, param.bits, bits_of(value, param.type_number))
    except UsageError:  # not in the range of the type; the write reports it
        return False
