"""Documents of the comparison of two parameter sets."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from pydantic import Field

from paramclient.documents.document import Document, Maybe
from paramclient.documents.param import WrittenParamDoc, short_text
from paramclient.documents.paramset import OriginDoc
from paramclient.model.comparison import ChangedSide, DifferenceStatus
from paramclient.model.defaults import DefaultSource

if TYPE_CHECKING:
    from paramclient.metadata import Metadata
    from paramclient.model.comparison import Comparison, Difference

__all__ = ["DiffDoc", "DifferenceDoc"]


class DifferenceDoc(Document):
    """The comparison of one name; see `Difference`.

    If the base are the firmware's defaults, `default_source` is the origin of this one: `vehicle` or
    `metadata`. If the right side has the parameter under another name, `right_name` is that name, and
    `renamed` has the left value as it compares with the right one.
    """

    status: DifferenceStatus = Field(validation_alias="is", serialization_alias="is")
    types_differ: bool
    rounding: bool
    left: WrittenParamDoc | None
    right: WrittenParamDoc | None
    base: WrittenParamDoc | None
    default_source: Maybe[DefaultSource] = None
    changed_side: ChangedSide | None
    units: Maybe[str] = None
    renamed: Maybe[WrittenParamDoc] = None
    right_name: Maybe[str] = None

    @classmethod
    def of(
        cls,
        entry: Difference,
        left: Metadata | None = None,
        right: Metadata | None = None,
        base: Metadata | None = None,
        default_source: DefaultSource | None = None,
    ) -> DifferenceDoc:
        """Return the document of a `Difference`.

        Args:
            entry: the comparison of the name.
            left, right, base: the metadata of each side, or None.
            default_source: the origin of the base if it is the firmware's default, or None.
        """
        right_name = entry.name if entry.renamed is None else entry.renamed.name
        sides = ((left, entry.name), (right, right_name))
        infos = [side.find(name) for side, name in sides if side is not None]
        return cls(
            status=entry.status,
            types_differ=entry.types_differ,
            rounding=entry.is_rounding,
            left=None if entry.left is None else WrittenParamDoc.compared(entry.left, left),
            right=None if entry.right is None else WrittenParamDoc.compared(entry.right, right),
            base=None if entry.base is None else WrittenParamDoc.compared(entry.base, base),
            default_source=default_source,
            changed_side=entry.changed_side,
            units=short_text(next((info.units for info in infos if info is not None and info.units), None)),
            renamed=None if entry.renamed is None else WrittenParamDoc.compared(entry.renamed, right),
            right_name=None if entry.renamed is None else right_name,
        )


class DiffDoc(Document):
    """A comparison; see `Comparison`. `params` has the names that differ, or all names."""

    same: bool
    left: OriginDoc
    right: OriginDoc
    base: OriginDoc | None
    counts: dict[DifferenceStatus, int]
    changed_sides: dict[ChangedSide, int] | None
    params: dict[str, DifferenceDoc]

    @classmethod
    def of(
        cls,
        outcome: Comparison,
        left: Metadata | None = None,
        right: Metadata | None = None,
        base: Metadata | None = None,
        *,
        everything: bool = False,
        has_defaults: bool = False,
    ) -> DiffDoc:
        """Return the document of a `Comparison`.

        Args:
            outcome: the comparison.
            left, right, base: the metadata of each side, or None.
            everything: include names that do not differ.
            has_defaults: whether the base are the firmware's defaults.
        """
        head = cls.without_params(outcome)
        rows = cls.rows(outcome, left, right, base, everything=everything, has_defaults=has_defaults)
        return head.model_copy(update={"params": dict(rows)})

    @classmethod
    def rows(
        cls,
        outcome: Comparison,
        left: Metadata | None = None,
        right: Metadata | None = None,
        base: Metadata | None = None,
        *,
        everything: bool = False,
        has_defaults: bool = False,
    ) -> Iterator[tuple[str, DifferenceDoc]]:
        """Yield the members of `params`, each created when it is needed; see `of`."""
        for entry in outcome.entries:
            if everything or entry.is_shown:
                source = _source(entry) if has_defaults and entry.base is not None else None
                yield entry.name, DifferenceDoc.of(entry, left, right, base, source)

    @classmethod
    def without_params(cls, outcome: Comparison) -> DiffDoc:
        """Return the document of a `Comparison` with an empty `params`."""
        return cls(
            same=outcome.is_same,
            left=OriginDoc.of(outcome.left),
            right=OriginDoc.of(outcome.right),
            base=None if outcome.base is None else OriginDoc.of(outcome.base),
            counts={status: outcome.counts[status] for status in DifferenceStatus},
            changed_sides=None
            if outcome.base is None
            else {changed_side: outcome.changed_sides[changed_side] for changed_side in ChangedSide},
            params={},
        )


def _source(entry: Difference) -> DefaultSource:
    """Return the origin of a default: one of the sides has it, else the metadata."""
    is_given = any(side is not None and side.default is not None for side in (entry.left, entry.right))
    return DefaultSource.VEHICLE if is_given else DefaultSource.METADATA
