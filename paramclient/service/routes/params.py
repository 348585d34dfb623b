"""The parameters of a component: as they are known, asked for, and written.

What is known goes out as it stands written in `following`; nothing is validated on the way.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Final

import anyio
import anyio.lowlevel
from fastapi import APIRouter, Depends, Query, Request, Response
from pydantic import Field

from paramclient.client.arguments import SETTLE_MAX
from paramclient.documents.document import Body, Document, InParts
from paramclient.documents.param import ParamDoc
from paramclient.documents.results import NotSetDoc, SetManyDoc, SetResultDoc
from paramclient.errors import ParamClientError, UnknownParameter, UsageError
from paramclient.model.params import copy_params
from paramclient.model.patterns import NameChoice
from paramclient.model.values import Param
from paramclient.service.answering import JSON
from paramclient.service.followed_component import Followed
from paramclient.service.param_sources import MOST_PATTERNS, MOST_VALUES
from paramclient.service.problems import problem_of
from paramclient.service.reading import BodyRoute
from paramclient.service.route_context import (
    Seconds,
    Target,
    TheHub,
    ValueGiven,
    answered,
    asker_of,
    may_write,
    value_of,
)

if TYPE_CHECKING:
    from paramclient.metadata import Metadata, ParamInfo

__all__ = ["router"]

router = APIRouter(
    prefix="/api/v1/components/{system}/{component}", tags=["parameters"], route_class=BodyRoute
)


AT_ONCE: Final = 250
"""Parameters that are written out before others are served: that takes 2.5 ms, and several tables may be
asked for at once."""

Name = Annotated[str, Field(min_length=1, max_length=16)]


class ParamsDoc(Document):
    """Parameters by name, and the number of the event up to which they hold."""

    run: str
    seq: int
    params: dict[str, ParamDoc]


class Asked(Body):
    """How long to wait for an answer."""

    timeout_s: Seconds = None


class Read(Body):
    """One parameter, by its name or by its index."""

    name: Name | None = None
    index: Annotated[int, Field(ge=0, le=65_535)] | None = None
    timeout_s: Seconds = None


Settle = Annotated[
    float,
    Field(
        ge=0, le=SETTLE_MAX, description="Seconds for which the value is watched; then it is read once more."
    ),
]
Force = Annotated[
    bool, Field(description="Whether NaN and infinity are sent to autopilots that cannot store them.")
]

Durable = Annotated[
    bool, Field(description="Whether it is answered only when value and history are on the disk.")
]


class Write(Body):
    """One value."""

    value: ValueGiven
    settle_s: Settle = 0.0
    force: Force = False
    durable: Durable = False
    timeout_s: Seconds = None


class WriteMany(Body):
    """Several values, by name."""

    values: Annotated[dict[Name, ValueGiven], InParts, Field(min_length=1, max_length=MOST_VALUES)]
    settle_s: Settle = 0.0
    force: Force = False
    durable: Durable = False
    timeout_s: Seconds = None


@router.get("/params", responses={200: {"model": ParamsDoc}}, response_class=Response)
async def known_params(
    hub: TheHub,
    target: Target,
    names: Annotated[
        list[str], Query(max_length=MOST_PATTERNS, description="Such as MC_*; any of them.")
    ] = [],  # noqa: B006 - FastAPI copies it
    changed: Annotated[
        bool, Query(description="Only those that differ from the firmware's default.")
    ] = False,
    metadata: Annotated[bool, Query(description="With what is known beside the values.")] = False,
) -> Response:
    """All that is known of the parameters, with no traffic."""
    target.look()
    place, table = hub.feed.place, copy_params(target.component.params)
    chosen = await hub.aside(lambda: _named(table, names)) if names else list(table)
    head = f'{{"run":"{place.run}","seq":{place.seq},"params":{{'
    described = target.metadata if metadata else None
    if described is None:
        texts = await _texts(target, table, chosen, changed=changed)
        return Response(f"{head}{texts}}}}}", media_type=JSON)
    heard_at = {name: target.heard_at(name) for name in chosen}
    texts = await hub.aside(
        lambda: _texts_with_metadata(_params_of(table, chosen, changed=changed), described, heard_at)
    )
    return Response(f"{head}{texts}}}}}", media_type=JSON)


@router.get("/params/{name:path}", responses={200: {"model": ParamDoc}}, response_class=Response)
async def known_param(target: Target, name: str) -> Response:
    """What is known of one parameter, with no traffic."""
    param = target.component.params.get(name)
    if param is None:
        raise _unknown(target, name)
    return Response(_text_with_metadata(target, param), media_type=JSON)


@router.post("/read", responses={200: {"model": ParamDoc}}, response_class=Response)
async def read(request: Request, target: Target, body: Read) -> Response:
    """Ask the vehicle for one parameter. The answer has the name that the vehicle gives it."""
    key = body.index if body.name is None else body.name
    if key is None or None not in (body.name, body.index):
        raise UsageError("give either a name or an index")
    return await _read(request, target, key, body.timeout_s)


@router.post("/params/{name:path}/read", responses={200: {"model": ParamDoc}}, response_class=Response)
async def read_by_path(request: Request, target: Target, name: str, body: Asked) -> Response:
    """The same for one whose name can stand in an address; `#17` is the one with this index."""
    digits = name[1:] if name.startswith("#") else ""
    key = int(digits) if digits.isascii() and digits.isdecimal() and len(digits) <= 5 else name
    return await _read(request, target, key, body.timeout_s)


@router.put("/params/{name:path}", dependencies=[Depends(may_write)])
async def write(request: Request, target: Target, name: str, body: Write) -> SetResultDoc:
    """Write one parameter, and prove by its value that the vehicle has taken it."""
    asker = asker_of(request)
    return await answered(request, lambda: _write(target, name, body.value, body, asker), target)


@router.patch("/params", dependencies=[Depends(may_write)])
async def write_many(request: Request, target: Target, body: WriteMany) -> SetManyDoc:
    """Write several side by side. All are tried; the answer says of each what became of it."""
    asker = asker_of(request)
    results: dict[str, SetResultDoc | NotSetDoc] = {}

    async def write_one(name: str) -> None:
        try:
            results[name] = await _write(target, name, body.values[name], body, asker)
        except ParamClientError as error:
            results[name] = NotSetDoc(problem=problem_of(error))

    async def work() -> None:
        async with anyio.create_task_group() as tasks:
            for name in body.values:
                tasks.start_soon(write_one, name)

    await answered(request, work, target)
    return SetManyDoc(results={name: results[name] for name in body.values})


async def _read(request: Request, target: Followed, key: str | int, timeout: float | None) -> Response:
    param = await answered(request, lambda: target.component.get(key, timeout=timeout), target)
    target.was_heard(param.name)
    return Response(_text_with_metadata(target, param), media_type=JSON)


async def _write(
    target: Followed, name: str, given: ValueGiven, body: Write | WriteMany, asker: str
) -> SetResultDoc:
    value = await value_of(target, name, given)
    result = await target.component.set(
        name,
        value,
        timeout=body.timeout_s,
        settle=body.settle_s,
        force=body.force,
        durable=body.durable,
        asker=asker,
    )
    target.was_heard(result.param.name)
    return SetResultDoc.of(result)


def _text_with_metadata(target: Followed, param: Param) -> str:
    info = None if target.metadata is None else target.metadata.get(param.name)
    if info is None:
        return target.text_of(param)
    return _described(param, info, target.heard_at(param.name))


def _described(param: Param, info: ParamInfo | None, heard_at: float | None) -> str:
    return ParamDoc.kept(param, info, heard_at=heard_at, whole=True).model_dump_json()


def _named(known: Iterable[str], names: list[str]) -> list[str]:
    choice = NameChoice(names)
    return [name for name in known if choice.has(name)]


def _params_of(table: Mapping[str, Param], names: Iterable[str], *, changed: bool) -> Iterator[Param]:
    """The parameters with these names, each made when it is needed: thousands at once are much to collect."""
    for name in names:
        param = table.get(name)
        if param is not None and (not changed or param.is_changed):
            yield param


async def _texts(target: Followed, table: Mapping[str, Param], names: Sequence[str], *, changed: bool) -> str:
    """The members of a JSON object, a part at a time: others are served in between."""
    parts = []
    for start in range(0, len(names), AT_ONCE):
        params = _params_of(table, names[start : start + AT_ONCE], changed=changed)
        parts.append(target.texts(params)[1:-1])
        await anyio.lowlevel.checkpoint()
    return ",".join(filter(None, parts))


def _texts_with_metadata(
    params: Iterable[Param], metadata: Metadata, heard_at: Mapping[str, float | None]
) -> str:
    """The same with what is known of each; in any thread."""
    return ",".join(
        f"{json.dumps(each.name)}:{_described(each, metadata.get(each.name), heard_at[each.name])}"
        for each in params
    )


def _unknown(target: Followed, name: str) -> UnknownParameter:
    system, component = target.address
    what = f"no parameter {name!r} of {system}/{component} is known here; it can be asked for"
    return UnknownParameter(what, system=system, component=component, name=name)
