"""The read-only mapping in which users see a table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from paramclient.values import Param

__all__ = ["ParamMap"]


class ParamMap(Mapping[str, Param]):
    """Parameters by name: a read-only view of a table that may go on changing.

    Take a copy, `dict(params)`, to iterate over it across an `await`: names may come and go meanwhile.

    Args:
        params: what to show. It is not copied; its order is kept.
    """

    __slots__ = ("_params",)

    def __init__(self, params: Mapping[str, Param]) -> None:
        self._params = params

    def __getitem__(self, name: str) -> Param:
        return self._params[name]

    def __contains__(self, name: object) -> bool:
        return name in self._params

    def __iter__(self) -> Iterator[str]:
        return iter(self._params)

    def __len__(self) -> int:
        return len(self._params)

    def changed(self) -> dict[str, Param]:
        """Those whose value differs from the firmware's default, by name: a copy.

        None where the vehicle has not said what its defaults are (see `Param.default`).
        """
        return {name: param for name, param in self._params.items() if param.is_changed}

    def __repr__(self) -> str:
        count = len(self._params)
        return f"<ParamMap {count} {'param' if count == 1 else 'params'}>"
