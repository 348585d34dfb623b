"""Documents of the results of fetches and writes of extended parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING

from paramclient.documents.document import Document, Maybe, Scalar
from paramclient.documents.extended_param import ExtParamDoc, ext_value_json
from paramclient.documents.problem import Problem
from paramclient.documents.results import NotSetDoc
from paramclient.model.ext_params import ExtParamType

if TYPE_CHECKING:
    from paramclient.model.ext_paramset import ExtParamSet
    from paramclient.protocol.fetch import FetchResult
    from paramclient.protocol.set_results import SetResult
    from paramclient.provision import ExtPlan

__all__ = [
    "ExtApplyResultDoc",
    "ExtFetchResultDoc",
    "ExtPlanDoc",
    "ExtSetManyDoc",
    "ExtSetResultDoc",
    "ExtStateDoc",
    "StoredExtSnapshotDoc",
]


class ExtFetchResultDoc(Document):
    """The result of a fetch of extended parameters; see `FetchResult`.

    The parameters are in the component's table. `count` is null if the component has not announced it.
    """

    link: str
    system: int
    component: int
    source: str
    count: int | None
    received: int
    missing: list[int]
    elapsed_s: float
    notes: list[str]

    @classmethod
    def of(cls, result: FetchResult, *, link: str) -> ExtFetchResultDoc:
        """Return the document of an `FetchResult`, without the parameters."""
        return cls(
            link=link,
            system=result.system,
            component=result.component,
            source=result.source,
            count=result.count,
            received=len(result.params),
            missing=list(result.missing),
            elapsed_s=round(result.elapsed, 4),
            notes=list(result.notes),
        )


class ExtSetResultDoc(Document):
    """The result of a write of an extended parameter: accepted, or adjusted; see `SetResult`.

    `requested` and `actual` are null for bytes that are no text; `param` has the bytes of the actual value.
    """

    name: str
    status: str
    requested: Scalar | None
    actual: Scalar | None
    attempts: int
    param: ExtParamDoc

    @classmethod
    def of(cls, result: SetResult) -> ExtSetResultDoc:
        """Return the document of an `SetResult`."""
        return cls(
            name=result.name,
            status=result.status,
            requested=ext_value_json(result.requested, ExtParamType.REAL64),
            actual=ext_value_json(result.actual, result.param.type),
            attempts=result.attempts,
            param=ExtParamDoc.kept(result.param),
        )


class ExtStateDoc(Document):
    """An earlier state of the extended parameters of a component; `at` is in unix seconds."""

    system: int | None
    component: int | None
    at: float | None
    source: str
    params: dict[str, ExtParamDoc]

    @classmethod
    def of(cls, state: ExtParamSet) -> ExtStateDoc:
        """Return the document of a set."""
        return cls(
            system=state.system,
            component=state.component,
            at=state.at,
            source=state.source,
            params={name: ExtParamDoc.of(param) for name, param in state.params.items()},
        )


class StoredExtSnapshotDoc(Document):
    """The number of a stored snapshot; null if the service has no cache."""

    snapshot: int | None


class ExtPlanDoc(Document):
    """What a set-up of extended parameters would write; see `ExtPlan`. `changes` has the wanted values."""

    system: int
    component: int
    is_met: bool
    changes: dict[str, ExtParamDoc]
    missing: list[str]
    mistyped: list[str]

    @classmethod
    def of(cls, plan: ExtPlan) -> ExtPlanDoc:
        """Return the document of an `ExtPlan`."""
        return cls(
            system=plan.system,
            component=plan.component,
            is_met=plan.is_met,
            changes={name: ExtParamDoc.of(param) for name, param in plan.changes.items()},
            missing=list(plan.missing),
            mistyped=list(plan.mistyped),
        )


class ExtApplyResultDoc(Document):
    """The result of a set-up of extended parameters; see `ExtApplyResult`."""

    system: int
    component: int
    complete: bool
    plan: ExtPlanDoc
    results: dict[str, ExtSetResultDoc | NotSetDoc]
    different: list[str]
    snapshot: int | None
    elapsed_s: float
    problem: Maybe[Problem] = None


class ExtSetManyDoc(Document):
    """The results of several writes by name, and why not all were tried."""

    results: dict[str, ExtSetResultDoc | NotSetDoc]
    problem: Maybe[Problem] = None
