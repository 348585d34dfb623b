"""Routes of extended parameters: known values, reads, writes, fetches, parallel to those of `params`."""

from __future__ import annotations

from typing import Annotated, Final

import anyio
from fastapi import APIRouter, Depends, Query, Request, Response
from pydantic import Field, StrictInt

from paramclient.documents.document import Body, Document, InParts
from paramclient.documents.extended_param import ExtParamDoc
from paramclient.documents.extended_results import (
    ExtApplyResultDoc,
    ExtFetchResultDoc,
    ExtPlanDoc,
    ExtSetManyDoc,
    ExtSetResultDoc,
    ExtStateDoc,
    StoredExtSnapshotDoc,
)
from paramclient.documents.history import SnapshotsDoc
from paramclient.documents.job import JobDoc
from paramclient.documents.results import NotSetDoc
from paramclient.errors import ParamClientError, UnknownParameter, UsageError
from paramclient.files.json_format import ext_param_of_fields
from paramclient.model.ext_params import EXT_VALUE_SIZE, ExtParamType, ExtValue, check_ext_value
from paramclient.model.ext_paramset import ExtParamSet
from paramclient.model.patterns import NameChoice
from paramclient.model.similar_names import did_you_mean, nearest_names
from paramclient.model.values import check_name
from paramclient.protocol.set_results import SetManyResult, SetOutcome, SetStatus
from paramclient.provision import (
    ExtApplyResult,
    apply_extended,
    load_extended_state,
    restore_extended,
    verify_extended,
)
from paramclient.service.followed_component import FollowedComponent
from paramclient.service.param_sources import (
    PATTERNS_MAX,
    REQUEST_VALUES_MAX,
    EarlierState,
    Pattern,
)
from paramclient.service.problems import problem_of
from paramclient.service.request_body import BodyRoute
from paramclient.service.responses import JSON, document_response, streamed_response
from paramclient.service.route_context import (
    Finite,
    HubArgument,
    Seconds,
    Target,
    author_of,
    holder_of,
    require_write,
    run_until_disconnect,
)
from paramclient.service.routes.fetches import job_response, wait_for_job
from paramclient.service.routes.params import (
    Durable,
    Name,
    ReadByPathRequest,
    ReadRequest,
    read_key,
)

__all__ = ["router"]

router = APIRouter(
    prefix="/api/v1/components/{system}/{component}/extended",
    tags=["extended parameters"],
    route_class=BodyRoute,
)

WORDS: Final = {"NaN": float("nan"), "Infinity": float("inf"), "-Infinity": float("-inf")}
"""Numbers that JSON does not have."""


class ExtParamsDoc(Document):
    """Extended parameters by name, and the number of the last event included."""

    run: str
    seq: int
    params: dict[str, ExtParamDoc]


class HexValue(Body):
    """The bytes of a CUSTOM value, or of a type that MAVLink does not define, as in `hex` of a parameter."""

    hex: Annotated[str, Field(pattern="^([0-9a-fA-F]{2}){0,128}$")]


class NumberValue(Body):
    """A number as text: digits of a 64-bit integer, which JavaScript cannot hold as a number, or `NaN`."""

    number: Annotated[str, Field(pattern="^(-?[0-9]{1,20}|NaN|-?Infinity)$")]


ExtValueInput = Annotated[
    StrictInt | Finite | Annotated[str, Field(max_length=EXT_VALUE_SIZE)] | HexValue | NumberValue,
    Field(
        description=(
            'A number for a numeric type, text for CUSTOM, {"hex": "00ff"} for other bytes. "NaN", "Infinity"'
            ' and "-Infinity" are numbers for REAL32 and REAL64. {"number": "9007199254740993"} is a number.'
        )
    ),
]


class ExtWriteRequest(Body):
    """One value."""

    value: ExtValueInput
    durable: Durable = False
    timeout_s: Seconds = None


class ExtWriteManyRequest(Body):
    """Several values, by name."""

    values: Annotated[dict[Name, ExtValueInput], InParts, Field(min_length=1, max_length=REQUEST_VALUES_MAX)]
    durable: Durable = False
    timeout_s: Seconds = None


class WantedExtParam(Body):
    """A wanted value: a number, or text; or the bytes in `hex`, as in a file of extended parameters."""

    type: Annotated[str, Field(max_length=20)]
    value: StrictInt | Finite | Annotated[str, Field(max_length=EXT_VALUE_SIZE)] | None = None
    hex: Annotated[str, Field(pattern="^([0-9a-fA-F]{2}){0,128}$")] | None = None


class ExtPlanRequest(Body):
    """Wanted extended parameters by name."""

    wanted: Annotated[dict[Name, WantedExtParam], InParts, Field(min_length=1, max_length=REQUEST_VALUES_MAX)]
    timeout_s: Seconds = None

    @property
    def wanted_set(self) -> ExtParamSet:
        """The wanted parameters.

        Raises:
            UsageError: a value or type is not valid.
        """
        params = {}
        for name, each in self.wanted.items():
            try:
                params[name] = ext_param_of_fields(name, each.model_dump(exclude_none=True))
            except ValueError as error:
                raise UsageError(f"{name}: {error}") from None
        return ExtParamSet(params)


class ExtApplyRequest(ExtPlanRequest):
    """Wanted extended parameters, with options."""

    durable: Durable = False


class ExtRestoreRequest(EarlierState):
    """The state to restore, with options."""

    durable: Durable = False
    timeout_s: Seconds = None


class SnapshotRequest(Body):
    """Reason of a snapshot."""

    reason: Annotated[str, Field(min_length=1, max_length=200)]


class ExtFetchRequest(Body):
    """Options of a fetch; see `ExtParams.fetch_all`. With `wait` false, the response is a job."""

    timeout_s: Seconds = None
    wait: bool = True


@router.get("/params", responses={200: {"model": ExtParamsDoc}}, response_class=Response)
async def known_extended_params(
    hub: HubArgument,
    target: Target,
    names: Annotated[
        list[Pattern], Query(max_length=PATTERNS_MAX, description="Names or patterns such as CAM_*.")
    ] = [],  # noqa: B006 - FastAPI copies it
) -> Response:
    """Return all known extended parameters, without traffic."""
    target.publish_changes()
    place, table = hub.feed.position, dict(target.extended.ext.params)
    chosen = (
        await hub.run_in_file_thread(lambda: NameChoice(names).choose(table)[0]) if names else table.keys()
    )
    entries = (target.extended.member_of(param) for name, param in table.items() if name in chosen)
    return streamed_response(f'{{"run":"{place.run}","seq":{place.seq},"params":{{', entries, "}}")


@router.get("/params/{name:path}", responses={200: {"model": ExtParamDoc}}, response_class=Response)
async def known_extended_param(target: Target, name: str) -> Response:
    """Return one known extended parameter, without traffic."""
    param = target.extended.ext.params.get(name)
    if param is None:
        raise _unknown(target, name)
    return Response(target.extended.json_of(param), media_type=JSON)


@router.post("/read", responses={200: {"model": ExtParamDoc}}, response_class=Response)
async def read_extended(request: Request, target: Target, body: ReadRequest) -> Response:
    """Read one extended parameter from the component, by name or index."""
    key = body.index if body.name is None else body.name
    if key is None or None not in (body.name, body.index):
        raise UsageError("the body needs either `name` or `index`")
    return await _read(request, target, key, body.timeout_s)


@router.post("/params/{name:path}/read", responses={200: {"model": ExtParamDoc}}, response_class=Response)
async def read_extended_by_path(
    request: Request, target: Target, name: str, body: ReadByPathRequest
) -> Response:
    """Read one extended parameter whose name is in the path; `#17` is an index."""
    return await _read(request, target, read_key(name), body.timeout_s)


@router.put("/params/{name:path}", dependencies=[Depends(require_write)])
async def write_extended(
    request: Request, target: Target, name: str, body: ExtWriteRequest
) -> ExtSetResultDoc:
    """Write one extended parameter, and wait until the component has acknowledged the value."""
    author = author_of(request)

    async def work() -> ExtSetResultDoc:
        value = await _resolve(target, name, body.value)
        result = await target.extended.ext.set(
            name, value, timeout=body.timeout_s, durable=body.durable, author=author
        )
        return ExtSetResultDoc.of(result)

    return await run_until_disconnect(request, work, target)


@router.patch("/params", dependencies=[Depends(require_write)])
async def write_many_extended(request: Request, target: Target, body: ExtWriteManyRequest) -> ExtSetManyDoc:
    """Write several extended parameters in order, several at a time. The response has each result.

    A refused value does not stop the others. After the loss of the component or the timeout, `problem` says
    why the remaining values were not tried.
    """
    author = author_of(request)
    results: dict[str, ExtSetResultDoc | NotSetDoc] = {}
    resolved: dict[str, ExtValue] = {}

    async def resolve(name: str) -> None:
        try:
            resolved[check_name(name)] = await _resolve(target, name, body.values[name])
        except ParamClientError as error:
            status = SetStatus.REFUSED if isinstance(error, UsageError) else SetStatus.NOT_TRIED
            results[name] = NotSetDoc(status=status, problem=problem_of(error))

    async def work() -> SetManyResult:
        async with anyio.create_task_group() as tasks:
            for name in body.values:
                tasks.start_soon(resolve, name)
        pairs = [(name, resolved[name]) for name in body.values if name in resolved]
        return await target.extended.ext.set_many(
            pairs, timeout=body.timeout_s, durable=body.durable, author=author
        )

    done = await run_until_disconnect(request, work, target)
    results |= {outcome.name: _document_of(outcome) for outcome in done.outcomes}
    problem = None if done.error is None else problem_of(done.error)
    return ExtSetManyDoc(results={name: results[name] for name in body.values}, problem=problem)


@router.post(
    "/fetch",
    response_model=ExtFetchResultDoc,
    responses={202: {"model": JobDoc, "description": "The started job"}},
)
async def fetch_extended(
    request: Request, hub: HubArgument, target: Target, body: ExtFetchRequest
) -> ExtFetchResultDoc | Response:
    """Download all extended parameters. Simultaneous requests share one download."""
    job = hub.start_extended_fetch(target, author_of(request), holder_of(request), timeout=body.timeout_s)
    if not body.wait:
        return job_response(job)
    result = await wait_for_job(request, job)
    assert isinstance(result, ExtFetchResultDoc)
    return result


@router.get("/snapshots")
async def extended_snapshots(request: Request, target: Target) -> SnapshotsDoc:
    """Return the snapshots of the extended parameters of a component, the newest last."""
    kept = await run_until_disconnect(request, target.extended.ext.snapshots)
    return SnapshotsDoc.of(kept, exact=True)


@router.post("/snapshots", status_code=201, dependencies=[Depends(require_write)])
async def create_extended_snapshot(
    request: Request, target: Target, body: SnapshotRequest
) -> StoredExtSnapshotDoc:
    """Create a snapshot of the known extended parameters of a component."""
    ext = target.extended.ext
    number = await run_until_disconnect(request, lambda: ext.store_snapshot(reason=body.reason))
    return StoredExtSnapshotDoc(snapshot=number)


@router.post("/state", response_model=ExtStateDoc)
async def extended_state(request: Request, hub: HubArgument, target: Target, body: EarlierState) -> Response:
    """Return the extended parameters of a component as they were: of a snapshot, or at a time."""

    async def work() -> Response:
        state = await load_extended_state(target.component, body.when)
        return await document_response(hub.run_in_file_thread, lambda: ExtStateDoc.of(state))

    return await run_until_disconnect(request, work)


@router.post("/plan")
async def plan_extended(request: Request, target: Target, body: ExtPlanRequest) -> ExtPlanDoc:
    """Compare a component with wanted extended parameters. Nothing is written."""

    async def work() -> ExtPlanDoc:
        return ExtPlanDoc.of(await verify_extended(target.component, body.wanted_set, timeout=body.timeout_s))

    return await run_until_disconnect(request, work, target)


@router.post("/apply", dependencies=[Depends(require_write)])
async def apply_extended_(request: Request, target: Target, body: ExtApplyRequest) -> ExtApplyResultDoc:
    """Write the wanted extended parameters that differ, and verify them by another download."""
    author = author_of(request)

    async def work() -> ExtApplyResultDoc:
        result = await apply_extended(
            target.component, body.wanted_set, durable=body.durable, timeout=body.timeout_s, author=author
        )
        return _applied(result)

    return await run_until_disconnect(request, work, target)


@router.post("/restore", dependencies=[Depends(require_write)])
async def restore_extended_(request: Request, target: Target, body: ExtRestoreRequest) -> ExtApplyResultDoc:
    """Restore an earlier state of the extended parameters of a component."""
    author = author_of(request)

    async def work() -> ExtApplyResultDoc:
        state = await load_extended_state(target.component, body.when)
        result = await restore_extended(
            target.component, state, durable=body.durable, timeout=body.timeout_s, author=author
        )
        return _applied(result)

    return await run_until_disconnect(request, work, target)


def _applied(result: ExtApplyResult) -> ExtApplyResultDoc:
    """Return the document of a result."""
    return ExtApplyResultDoc(
        system=result.plan.system,
        component=result.plan.component,
        complete=result.complete,
        plan=ExtPlanDoc.of(result.plan),
        results={outcome.name: _document_of(outcome) for outcome in result.outcomes},
        different=list(result.different),
        snapshot=result.snapshot,
        elapsed_s=round(result.elapsed, 4),
        problem=None if result.error is None else problem_of(result.error),
    )


async def _read(
    request: Request, target: FollowedComponent, key: str | int, timeout: float | None
) -> Response:
    ext = target.extended.ext
    param = await run_until_disconnect(request, lambda: ext.get(key, timeout=timeout), target)
    return Response(target.extended.json_of(param), media_type=JSON)


def _document_of(outcome: SetOutcome) -> ExtSetResultDoc | NotSetDoc:
    if outcome.error is not None:
        return NotSetDoc(status=outcome.status, problem=problem_of(outcome.error))
    assert outcome.result is not None
    return ExtSetResultDoc.of(outcome.result)


async def _resolve(
    target: FollowedComponent, name: str, given: int | float | str | HexValue | NumberValue
) -> ExtValue:
    """Return the value of a request.

    Raises:
        UsageError: the value is too long.
        ParamClientError: the component did not send the type of the parameter, where it is needed.
    """
    if isinstance(given, HexValue):
        return bytes.fromhex(given.hex)
    if isinstance(given, NumberValue):
        return WORDS[given.number] if given.number in WORDS else int(given.number)
    if isinstance(given, str) and given in WORDS:
        ext = target.extended.ext
        known = ext.params.get(name) or await ext.get(name)
        return WORDS[given] if known.type in (ExtParamType.REAL32, ExtParamType.REAL64) else given
    return check_ext_value(given)


def _unknown(target: FollowedComponent, name: str) -> UnknownParameter:
    system, component = target.address
    nearest = nearest_names(name, target.extended.ext.params)
    what = f"{system}/{component} has no known extended parameter {name!r}. POST …/read requests it"
    what += f".{did_you_mean(nearest)}" if nearest else ""
    return UnknownParameter(what, system=system, component=component, name=name, nearest=nearest)
