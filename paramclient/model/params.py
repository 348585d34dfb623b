"""ParamMap: the read-only mapping of parameters that users see."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TypeVar, overload

from paramclient.model.defaults import add_default
from paramclient.model.names import unknown_name
from paramclient.model.values import Param, WireValue
from paramclient.model.wording import counted

__all__ = ["ParamMap"]

T = TypeVar("T")


class ParamMap(Mapping[str, Param]):
    """Parameters by name: a read-only view of a table that may still change.

    An iteration is over the names at its start.

    Args:
        params: the table. It is not copied; its order is kept.
    """

    __slots__ = ("_params",)

    def __init__(self, params: Mapping[str, Param]) -> None:
        self._params = params

    def __getitem__(self, name: str) -> Param:
        try:
            return self._params[name]
        except KeyError:
            raise unknown_name(name, self._params, among=True) from None

    @overload
    def get(self, name: str, /) -> Param | None: ...
    @overload
    def get(self, name: str, default: Param, /) -> Param: ...
    @overload
    def get(self, name: str, default: T, /) -> Param | T: ...
    def get(self, name: str, default: Param | T | None = None, /) -> Param | T | None:
        """Return the parameter with this name, or `default`."""
        return self._params.get(name, default)

    def __contains__(self, name: object) -> bool:
        return name in self._params

    def __iter__(self) -> Iterator[str]:
        return iter(tuple(self._params))

    def __len__(self) -> int:
        return len(self._params)

    def changed(self, defaults: Mapping[str, WireValue] | None = None) -> dict[str, Param]:
        """Return a copy of the parameters whose value differs from the firmware's default.

        Parameters without a known default are left out.

        Args:
            defaults: defaults of parameters whose default the vehicle has not given (see `Param.default`), by
                name, such as `Metadata.defaults_of`. They become the `default` of the returned parameters.
        """
        described = defaults or {}
        known = (add_default(param, described.get(name)) for name, param in tuple(self._params.items()))
        return {param.name: param for param in known if param.is_changed}

    def __repr__(self) -> str:
        count = len(self._params)
        return f"<ParamMap {counted(count, 'param')}>"
