"""Documents of the results of fetches and writes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from paramclient.documents.document import Document, Maybe, Scalar
from paramclient.documents.param import ParamDoc
from paramclient.documents.problem import Problem
from paramclient.model.notation import hash_text, rounded, value_json
from paramclient.model.values import ParamType

if TYPE_CHECKING:
    from paramclient.protocol.fetch import FetchResult
    from paramclient.protocol.set_results import SetResult

__all__ = [
    "FetchResultDoc",
    "FetchedAllDoc",
    "NotSetDoc",
    "SetManyDoc",
    "SetResultDoc",
    "SilentDoc",
]


class FetchResultDoc(Document):
    """The result of a fetch; see `FetchResult`. The parameters are in the component's table."""

    link: str
    system: int
    component: int
    source: str
    count: int
    received: int
    missing: list[int]
    hash: str | None
    elapsed_s: float
    notes: list[str]
    resumed: int
    lost: int
    repeated: int
    round_trip_s: float | None

    @classmethod
    def of(cls, result: FetchResult, *, link: str) -> FetchResultDoc:
        """Return the document of a `FetchResult`, without the parameters."""
        return cls(
            link=link,
            system=result.system,
            component=result.component,
            source=result.source,
            count=result.count,
            received=result.received,
            missing=list(result.missing),
            hash=hash_text(result.hash),
            elapsed_s=round(result.elapsed, 4),
            notes=list(result.notes),
            resumed=result.resumed,
            lost=result.lost,
            repeated=result.repeated,
            round_trip_s=rounded(result.round_trip),
        )


class SilentDoc(Document):
    """A component that did not answer a fetch of several components."""

    link: str
    system: int
    component: int
    problem: Problem


class FetchedAllDoc(Document):
    """The results of a fetch of several components."""

    results: list[FetchResultDoc]
    silent: list[SilentDoc]


class SetResultDoc(Document):
    """The result of a write: accepted, or adjusted by the vehicle; see `SetResult`."""

    name: str
    status: Literal["accepted", "adjusted"]
    requested: Scalar
    actual: Scalar
    attempts: int
    param: ParamDoc
    note: Maybe[str] = None

    @classmethod
    def of(cls, result: SetResult) -> SetResultDoc:
        """Return the document of a `SetResult`."""
        requested = result.requested
        kind = ParamType.REAL64 if isinstance(requested, float) else result.param.type_number
        return cls(
            name=result.name,
            status=result.status,
            requested=value_json(requested, kind),
            actual=value_json(result.param.settable, result.param.type_number),
            attempts=result.attempts,
            param=ParamDoc.kept(result.param),
            note=result.note or None,
        )


class NotSetDoc(Document):
    """The error of a write that failed; see `SetOutcome`.

    With status `accepted` or `adjusted`, the vehicle has acknowledged the value, and it is not on the disk.
    """

    status: str
    problem: Problem


class SetManyDoc(Document):
    """The results of several writes by name, and why not all were tried."""

    results: dict[str, SetResultDoc | NotSetDoc]
    problem: Maybe[Problem] = None
