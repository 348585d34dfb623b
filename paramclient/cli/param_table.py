"""Parameters of a vehicle as a table and as JSON: with their defaults, or with meaning and units."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence

from paramclient.cli.json_output import JsonObject, param_json
from paramclient.cli.metadata import DESCRIBED_COLUMNS, described_cells, info_of
from paramclient.metadata import Metadata
from paramclient.model.defaults import Default, add_default, default_of
from paramclient.model.values import Param, format_value

__all__ = ["RIGHT", "ParamTable"]

RIGHT = "value index default"
"""The right-aligned columns."""


class ParamTable:
    """The parameters of one component.

    Args:
        params: the parameters.
        metadata: describes them, or None.
        described: the defaults of metadata by name, for parameters whose default the vehicle has not given.
        more: a further column, and its cell for each parameter.
    """

    def __init__(
        self,
        params: Iterable[Param],
        *,
        metadata: Metadata | None = None,
        described: Mapping[str, int | float] | None = None,
        more: tuple[str, Callable[[Param], object]] | None = None,
    ) -> None:
        self.params = list(params)
        self.metadata, self.described, self._more = metadata, described or {}, more
        self._shows_defaults = False

    @property
    def defaults(self) -> list[Default]:
        """The known defaults of the parameters."""
        found = (default_of(param, self.described.get(param.name)) for param in self.params)
        return [default for default in found if default is not None]

    def keep(self, names: Collection[str]) -> None:
        """Leave out all other parameters."""
        self.params = [param for param in self.params if param.name in names]

    def keep_changed(self) -> None:
        """Leave out parameters that do not differ from a known default, and show the defaults."""
        self.params = [param for param in self.params if self._known(param).is_changed]
        self._shows_defaults = True

    @property
    def columns(self) -> list[str]:
        """The headings."""
        more = [] if self._more is None else [self._more[0]]
        default = ["default"] * self._shows_defaults
        described = [] if self.metadata is None else DESCRIBED_COLUMNS
        return ["name", "value", "type", "index", *more, *default, *described]

    def rows(self) -> Iterator[Sequence[object]]:
        """Yield the cells of each parameter."""
        for param in self.params:
            yield (
                param.name,
                format_value(param.settable, param.type),
                param.type.name,
                param.index,
                *([] if self._more is None else [self._more[1](param)]),
                *([_default_text(self._known(param))] * self._shows_defaults),
                *(() if self.metadata is None else described_cells(self.metadata, param)),
            )

    def as_json(self, *, whole: bool) -> JsonObject:
        """Return the parameters by name; with `whole`, with all their metadata."""
        return {
            each.name: param_json(each, info_of(self.metadata, each.name), whole=whole)
            for each in self.params
        }

    def _known(self, param: Param) -> Param:
        return add_default(param, self.described.get(param.name))


def _default_text(param: Param) -> str | None:
    return None if param.default is None else format_value(param.default, param.type)
