"""ParamMap: the read-only mapping of parameters that users see."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from paramclient.model.defaults import add_default
from paramclient.model.names import ByName
from paramclient.model.values import Param, WireValue
from paramclient.model.wording import counted


class ParamMap(ByName[Param]):
    """Parameters by name: a read-only view of a table that may still change.

    An iteration is over the names at its start.

    Args:
        params: the table. It is not copied; its order is kept.
    """

    __slots__ = ("params",)

    def __init__(self, params: Mapping[str, Param]) -> None:
        self.params = MappingProxyType(params)

    def changed(self, defaults: Mapping[str, WireValue] | None = None) -> dict[str, Param]:
        """Return a copy of the parameters whose value differs from the firmware's default.

        Parameters without a known default are left out.

        Args:
            defaults: defaults of parameters whose default the vehicle has not given (see `Param.default`), by
                name, such as `Metadata.defaults_of`. They become the `default` of the returned parameters.
        """
        described = defaults or {}
        known = (add_default(param, described.get(name)) for name, param in tuple(self.params.items()))
        return {param.name: param for param in known if param.is_changed}

    def __repr__(self) -> str:
        return f"<ParamMap {counted(len(self), 'param')}>"
