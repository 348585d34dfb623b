"""Documents of extended parameters that subcommands print."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from paramclient.documents.document import Document, Maybe, Scalar
from paramclient.documents.extended_param import ExtParamDoc, ext_value_json
from paramclient.model.ext_params import ExtParam, ExtParamType
from paramclient.model.notation import time_text

if TYPE_CHECKING:
    from paramclient.cache import ExtHistoryEntry
    from paramclient.files import FileFormat
    from paramclient.model.ext_paramset import ExtParamSet
    from paramclient.protocol.events import Change
    from paramclient.protocol.fetch import FetchResult
    from paramclient.protocol.set_results import SetOutcome

__all__ = [
    "ExtChangeDoc",
    "ExtChangeLineDoc",
    "ExtDiffDoc",
    "ExtDifferenceDoc",
    "ExtFetchOutputDoc",
    "ExtHistoryDoc",
    "ExtParamsOutputDoc",
    "ExtSavedDoc",
    "ExtWriteDoc",
    "ExtWritesOutputDoc",
]


class ExtParamsOutputDoc(Document):
    """Extended parameters by name."""

    extended: dict[str, ExtParamDoc]

    @classmethod
    def of(cls, params: Iterable[ExtParam]) -> ExtParamsOutputDoc:
        """Return the document of parameters."""
        return cls(extended={param.name: ExtParamDoc.of(param) for param in params})


class ExtFetchOutputDoc(Document):
    """A fetched table of extended parameters; `missing` are indices that were not received."""

    system: int
    component: int
    count: int | None
    source: str
    missing: list[int]
    elapsed_s: float
    extended: dict[str, ExtParamDoc]

    @classmethod
    def of(cls, result: FetchResult, params: Iterable[ExtParam]) -> ExtFetchOutputDoc:
        """Return the document of a fetch."""
        return cls(
            system=result.system,
            component=result.component,
            count=result.count,
            source=result.source,
            missing=list(result.missing),
            elapsed_s=round(result.elapsed, 3),
            extended={param.name: ExtParamDoc.of(param) for param in params},
        )


class ExtWriteDoc(Document):
    """The outcome of one write of an extended parameter.

    `requested` and `actual` are null for bytes that are no text; `requested_hex` has such requested bytes,
    and `actual_hex` the bytes of every actual value.
    """

    name: str
    requested: Scalar | None
    actual: Scalar | None
    status: str
    requested_hex: Maybe[str] = None
    actual_hex: Maybe[str] = None
    reason: Maybe[str] = None

    @classmethod
    def of(cls, outcome: SetOutcome) -> ExtWriteDoc:
        """Return the document of an outcome."""
        result = outcome.result
        return cls(
            name=outcome.name,
            requested=ext_value_json(outcome.requested, ExtParamType.REAL64),
            actual=None if result is None else ext_value_json(result.actual, result.param.type),
            status=outcome.status.value,
            requested_hex=outcome.requested.hex() if isinstance(outcome.requested, bytes) else None,
            actual_hex=None if result is None else result.param.raw.hex(),
            reason=None if outcome.error is None else str(outcome.error),
        )


class ExtWritesOutputDoc(Document):
    """The outcomes of writes of extended parameters, in order."""

    results: list[ExtWriteDoc]

    @classmethod
    def of(cls, outcomes: Iterable[SetOutcome]) -> ExtWritesOutputDoc:
        """Return the document of outcomes."""
        return cls(results=[ExtWriteDoc.of(each) for each in outcomes])


class ExtDifferenceDoc(Document):
    """One compared extended parameter."""

    name: str
    left: ExtParamDoc | None
    right: ExtParamDoc | None
    comparison: str = Field(validation_alias="is", serialization_alias="is")


class ExtDiffDoc(Document):
    """A comparison of extended parameters."""

    is_same: bool
    extended: list[ExtDifferenceDoc]

    @classmethod
    def of(
        cls, entries: Sequence[tuple[str, ExtParam | None, ExtParam | None, str]], *, is_same: bool
    ) -> ExtDiffDoc:
        """Return the document of a comparison: name, left, right and comparison of each entry."""
        return cls(
            is_same=is_same,
            extended=[
                ExtDifferenceDoc(
                    name=name,
                    left=None if left is None else ExtParamDoc.of(left),
                    right=None if right is None else ExtParamDoc.of(right),
                    comparison=comparison,
                )
                for name, left, right, comparison in entries
            ],
        )


class ExtChangeDoc(Document):
    """One change of an extended parameter; see `ExtHistoryEntry`. `at` is in unix seconds."""

    time: str
    at: float
    component: int
    name: str
    old: ExtParamDoc
    new: ExtParamDoc | None
    by: str


class ExtChangeLineDoc(Document):
    """One line of `watch`: a changed value, or an added or removed extended parameter."""

    time: str
    name: str
    old: ExtParamDoc | None
    new: ExtParamDoc | None
    by: str
    kind: Literal["changed", "added", "removed"]

    @classmethod
    def of(cls, change: Change, at: float) -> ExtChangeLineDoc:
        """Return the document of a change that was received `at` this unix time in seconds."""
        return cls(
            time=time_text(at),
            name=change.name,
            old=None if change.old is None else ExtParamDoc.of(change.old),
            new=None if change.new is None else ExtParamDoc.of(change.new),
            by=change.by,
            kind="removed" if change.new is None else "added" if change.is_added else "changed",
        )


class ExtHistoryDoc(Document):
    """Changes of extended parameters, the newest last."""

    history: list[ExtChangeDoc]

    @classmethod
    def of(cls, entries: Iterable[ExtHistoryEntry]) -> ExtHistoryDoc:
        """Return the document of lines of history."""
        return cls(
            history=[
                ExtChangeDoc(
                    time=time_text(each.at),
                    at=each.at,
                    component=each.component,
                    name=each.name,
                    old=ExtParamDoc.of(each.old),
                    new=None if each.new is None else ExtParamDoc.of(each.new),
                    by=each.by,
                )
                for each in entries
            ]
        )


class ExtSavedDoc(Document):
    """A written file of extended parameters."""

    file: str
    format: str
    system: int | None
    component: int | None
    count: int

    @classmethod
    def of(cls, file: str, file_format: FileFormat, content: ExtParamSet) -> ExtSavedDoc:
        """Return the document of a written file."""
        count = len(content.params)
        return cls(
            file=file,
            format=file_format.value,
            system=content.system,
            component=content.component,
            count=count,
        )
