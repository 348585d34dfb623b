"""Routes of parameters: known values, reads, writes.

Known values are sent as encoded in `followed_component`, without validation.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Final

import anyio
import anyio.lowlevel
from fastapi import APIRouter, Depends, Query, Request, Response
from pydantic import Field

from paramclient.client.arguments import SETTLE_MAX, check_writes
from paramclient.documents.document import Body, Document, InParts
from paramclient.documents.param import ParamDoc
from paramclient.documents.results import NotSetDoc, SetManyDoc, SetResultDoc
from paramclient.errors import ParamClientError, UnknownParameter, UsageError
from paramclient.model.defaults import add_default
from paramclient.model.params import copy_params
from paramclient.model.patterns import NameChoice
from paramclient.model.similar_names import did_you_mean, nearest_names
from paramclient.model.values import Param, WireValue
from paramclient.protocol.set_results import SetManyResult, SetOutcome, SetStatus
from paramclient.service.followed_component import FollowedComponent
from paramclient.service.param_sources import PATTERNS_MAX, REQUEST_VALUES_MAX, Pattern
from paramclient.service.problems import problem_of
from paramclient.service.request_body import BodyRoute
from paramclient.service.responses import JSON, streamed_response
from paramclient.service.route_context import (
    HubArgument,
    Seconds,
    Target,
    ValueInput,
    author_of,
    require_write,
    resolve_value,
    run_until_disconnect,
)

if TYPE_CHECKING:
    from paramclient.metadata import ParamInfo

__all__ = ["PARAMS_PER_TURN", "Durable", "Name", "ReadByPathRequest", "ReadRequest", "read_key", "router"]

router = APIRouter(
    prefix="/api/v1/components/{system}/{component}", tags=["parameters"], route_class=BodyRoute
)


PARAMS_PER_TURN: Final = 250
"""Number of parameters encoded in one turn of the event loop: 2.5 ms. Several tables may be requested at
once."""

Name = Annotated[str, Field(min_length=1, max_length=16)]


class ParamsDoc(Document):
    """Parameters by name, and the number of the last event included."""

    run: str
    seq: int
    params: dict[str, ParamDoc]


class ReadByPathRequest(Body):
    """Timeout of the vehicle's response."""

    timeout_s: Seconds = None


class ReadRequest(Body):
    """One parameter, by name or index."""

    name: Name | None = None
    index: Annotated[int, Field(ge=0, le=65_535)] | None = None
    timeout_s: Seconds = None


Settle = Annotated[
    float,
    Field(
        ge=0, le=SETTLE_MAX, description="Seconds for which the value is observed before it is read again."
    ),
]
Force = Annotated[bool, Field(description="Send NaN and infinity to autopilots that cannot store them.")]

Durable = Annotated[bool, Field(description="Respond after value and history are on the disk.")]


class WriteRequest(Body):
    """One value."""

    value: ValueInput
    settle_s: Settle = 0.0
    force: Force = False
    durable: Durable = False
    timeout_s: Seconds = None


class WriteManyRequest(Body):
    """Several values, by name."""

    values: Annotated[dict[Name, ValueInput], InParts, Field(min_length=1, max_length=REQUEST_VALUES_MAX)]
    settle_s: Settle = 0.0
    force: Force = False
    durable: Durable = False
    timeout_s: Seconds = None


@router.get("/params", responses={200: {"model": ParamsDoc}}, response_class=Response)
async def known_params(
    hub: HubArgument,
    target: Target,
    names: Annotated[
        list[Pattern], Query(max_length=PATTERNS_MAX, description="Names or patterns such as MC_*.")
    ] = [],  # noqa: B006 - FastAPI copies it
    changed: Annotated[
        bool, Query(description="Only parameters that differ from the firmware's default.")
    ] = False,
    metadata: Annotated[bool, Query(description="Include the descriptions of the parameters.")] = False,
) -> Response:
    """Return all known parameters, without traffic."""
    target.publish_changes()
    place, table = hub.feed.position, copy_params(target.component.params)
    chosen = await hub.run_in_file_thread(lambda: _named(table, names)) if names else list(table)
    head = f'{{"run":"{place.run}","seq":{place.seq},"params":{{'
    described = target.metadata if metadata else None
    if described is None:
        texts = await _texts(target, table, chosen, changed=changed)
        return Response(f"{head}{texts}}}}}", media_type=JSON)
    entries = (
        f"{json.dumps(each.name)}:{_described(each, described.get(each.name), target.received_at(each.name))}"
        for each in _params_of(target, table, chosen, changed=changed)
    )
    return streamed_response(head, entries, "}}")


@router.get("/params/{name:path}", responses={200: {"model": ParamDoc}}, response_class=Response)
async def known_param(target: Target, name: str) -> Response:
    """Return one known parameter, without traffic."""
    param = target.component.params.get(name)
    if param is None:
        raise _unknown(target, name)
    return Response(_text_with_metadata(target, param), media_type=JSON)


@router.post("/read", responses={200: {"model": ParamDoc}}, response_class=Response)
async def read(request: Request, target: Target, body: ReadRequest) -> Response:
    """Read one parameter from the vehicle. The response has the name that the vehicle sends."""
    key = body.index if body.name is None else body.name
    if key is None or None not in (body.name, body.index):
        raise UsageError("the body needs either `name` or `index`")
    return await _read(request, target, key, body.timeout_s)


@router.post("/params/{name:path}/read", responses={200: {"model": ParamDoc}}, response_class=Response)
async def read_by_path(request: Request, target: Target, name: str, body: ReadByPathRequest) -> Response:
    """Read one parameter whose name is in the path; `#17` is an index."""
    return await _read(request, target, read_key(name), body.timeout_s)


@router.put("/params/{name:path}", dependencies=[Depends(require_write)])
async def write(request: Request, target: Target, name: str, body: WriteRequest) -> SetResultDoc:
    """Write one parameter, and verify the value that the vehicle reports."""
    author = author_of(request)
    return await run_until_disconnect(request, lambda: _write(target, name, body.value, body, author), target)


@router.patch("/params", dependencies=[Depends(require_write)])
async def write_many(request: Request, target: Target, body: WriteManyRequest) -> SetManyDoc:
    """Write several parameters in order, many at a time, and verify each. The response has each result.

    A refused value does not stop the others. After the loss of the vehicle or the timeout, `problem` says why
    the remaining values were not tried.
    """
    author = author_of(request)
    results: dict[str, SetResultDoc | NotSetDoc] = {}
    resolved: dict[str, WireValue] = {}

    async def resolve(name: str) -> None:
        try:
            value = await resolve_value(target, name, body.values[name])
            ((_, resolved[name]),) = check_writes({name: value})
        except ParamClientError as error:
            status = SetStatus.REFUSED if isinstance(error, UsageError) else SetStatus.NOT_TRIED
            results[name] = NotSetDoc(status=status, problem=problem_of(error))

    async def work() -> SetManyResult:
        async with anyio.create_task_group() as tasks:
            for name in body.values:
                tasks.start_soon(resolve, name)
        return await target.component.set_many(
            [(name, resolved[name]) for name in body.values if name in resolved],
            timeout=body.timeout_s,
            settle=body.settle_s,
            force=body.force,
            durable=body.durable,
            author=author,
        )

    done = await run_until_disconnect(request, work, target)
    for outcome in done.outcomes:
        results[outcome.name] = _document_of(outcome)
        if outcome.result is not None:
            target.record_received(outcome.result.param.name)
    problem = None if done.error is None else problem_of(done.error)
    return SetManyDoc(results={name: results[name] for name in body.values}, problem=problem)


def read_key(name: str) -> str | int:
    """Return the name or index that a path names: `#17` is an index."""
    digits = name[1:] if name.startswith("#") else ""
    return int(digits) if digits.isascii() and digits.isdecimal() and len(digits) <= 5 else name


async def _read(
    request: Request, target: FollowedComponent, key: str | int, timeout: float | None
) -> Response:
    param = await run_until_disconnect(request, lambda: target.component.get(key, timeout=timeout), target)
    target.record_received(param.name)
    return Response(_text_with_metadata(target, param), media_type=JSON)


def _document_of(outcome: SetOutcome) -> SetResultDoc | NotSetDoc:
    if outcome.error is not None:
        return NotSetDoc(status=outcome.status, problem=problem_of(outcome.error))
    assert outcome.result is not None
    return SetResultDoc.of(outcome.result)


async def _write(
    target: FollowedComponent, name: str, given: ValueInput, body: WriteRequest, author: str
) -> SetResultDoc:
    value = await resolve_value(target, name, given)
    result = await target.component.set(
        name,
        value,
        timeout=body.timeout_s,
        settle=body.settle_s,
        force=body.force,
        durable=body.durable,
        author=author,
    )
    target.record_received(result.param.name)
    return SetResultDoc.of(result)


def _text_with_metadata(target: FollowedComponent, param: Param) -> str:
    info = None if target.metadata is None else target.metadata.get(param.name)
    if info is None:
        return target.json_of(param)
    return _described(param, info, target.received_at(param.name))


def _described(param: Param, info: ParamInfo | None, received_at: float | None) -> str:
    return ParamDoc.kept(param, info, heard_at=received_at, whole=True).model_dump_json()


def _named(known: Iterable[str], names: list[str]) -> list[str]:
    choice = NameChoice(names)
    return [name for name in known if choice.has(name)]


def _params_of(
    target: FollowedComponent, table: Mapping[str, Param], names: Iterable[str], *, changed: bool
) -> Iterator[Param]:
    """Yield the parameters with these names, each created on demand to keep garbage collections short."""
    for name in names:
        param = table.get(name)
        if param is not None and (
            not changed or add_default(param, target.described_default(name)).is_changed
        ):
            yield param


async def _texts(
    target: FollowedComponent, table: Mapping[str, Param], names: Sequence[str], *, changed: bool
) -> str:
    """Return the members of a JSON object, encoded in parts between which other tasks run."""
    parts = []
    for start in range(0, len(names), PARAMS_PER_TURN):
        params = _params_of(target, table, names[start : start + PARAMS_PER_TURN], changed=changed)
        parts.append(target.object_of(params)[1:-1])
        await anyio.lowlevel.checkpoint()
    return ",".join(filter(None, parts))


def _unknown(target: FollowedComponent, name: str) -> UnknownParameter:
    system, component = target.address
    nearest = nearest_names(name, target.component.params)
    what = f"{system}/{component} has no known parameter {name!r}. POST …/read requests it from the vehicle"
    what += f".{did_you_mean(nearest)}" if nearest else ""
    return UnknownParameter(what, system=system, component=component, name=name, nearest=nearest)
