"""Routes with their request bodies: the service, vehicles, parameters, files, apply, snapshots, history.

With `?ext=true`, the routes of parameters are about the extended parameters of a component.
"""

from __future__ import annotations

import json
import re
import time
from base64 import b64decode
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from datetime import datetime
from functools import partial
from typing import Annotated, Any, ClassVar, Final, Self

import anyio
import anyio.to_thread
from fastapi import APIRouter, Depends, Header, Path, Query, Request
from fastapi.responses import PlainTextResponse, Response
from fastapi.security import HTTPBearer
from fastapi.sse import EventSourceResponse, ServerSentEvent
from pydantic import AwareDatetime, BaseModel, BeforeValidator, Field, StrictFloat, StrictInt, model_validator

from paramclient.cache import ParamCache
from paramclient.cli import json_output
from paramclient.cli.json_output import JsonObject, apply_json, plan_json
from paramclient.client.component import Component
from paramclient.errors import UsageError
from paramclient.files import FileFormat, ParamFile, dumps, loads, writable
from paramclient.files.formats import ENDINGS
from paramclient.model.names import NameChoice
from paramclient.model.paramset import ParamSet
from paramclient.protocol.set_results import SetOutcome, SetStatus
from paramclient.provision import ApplyProgress, apply, restore
from paramclient.provision import plan as plan_of
from paramclient.provision.apply_restore import load_restore_point
from paramclient.provision.sources import choose, fetched_set, select_non_defaults
from paramclient.service.hub import Hub, Target
from paramclient.service.problems import ServiceError
from paramclient.version import __version__

VEHICLE: Final = "/api/vehicles/{system}/{component}"
PROGRESS_INTERVAL: Final = 0.25
"""Seconds between two progress events of an apply or restore."""
FILE_BYTES_MAX: Final = 2 * 2**20
"""Maximum size of a parameter file in bytes; a table of 10,000 parameters takes 1 MB."""
VALUES_MAX: Final = 10_000
"""Maximum number of values of a request: more than a vehicle has."""
FILE: Final[dict[int | str, dict[str, Any]]] = {200: {"content": {"application/octet-stream": {}}}}
"""The response with a file, for the OpenAPI document."""
_PAGE_NAME: Final = re.compile(r"[A-Za-z0-9._ -]{1,64}")

# request bodies


class Body(BaseModel, extra="forbid"):
    """A request body. An unknown member is refused, so that a misspelt one is not ignored.

    Attributes:
        one_of: members of which exactly one is needed.
    """

    one_of: ClassVar[tuple[str, ...]] = ()

    @model_validator(mode="after")
    def _has_one(self) -> Self:
        if self.one_of and sum(getattr(self, each) is not None for each in self.one_of) != 1:
            raise ValueError(f"exactly one of {', '.join(self.one_of)} is needed")
        return self


def _decode(given: object) -> object:
    return b64decode(given, validate=True) if isinstance(given, str) else given


def _parse_moment(given: object) -> object:
    text = str(given)
    return int(text) if text.isdecimal() else datetime.fromisoformat(text)


Name = Annotated[str, Field(min_length=1, max_length=16)]
Value = Annotated[
    StrictInt | Annotated[StrictFloat, Field(allow_inf_nan=False)] | Annotated[str, Field(max_length=400)],
    Field(
        description='A number, also as text such as "NaN", or the name of a value in the metadata; of an '
        "extended parameter also text, or bytes as hex:00ff."
    ),
]
Values = Annotated[dict[Name, Value], Field(min_length=1, max_length=VALUES_MAX)]
Seconds = Annotated[float | None, Field(gt=0, le=86_400, description="Timeout in seconds.")]
Pattern = Annotated[str, Field(min_length=1, max_length=64)]
Patterns = Annotated[tuple[Pattern, ...], Field(max_length=VALUES_MAX)]
Moment = Annotated[
    Annotated[StrictInt, Field(ge=1, lt=1 << 62)] | Annotated[AwareDatetime, Field(strict=True)],
    BeforeValidator(_parse_moment),
    Field(description="The number of a snapshot, or a time with its zone."),
]
Durable = Annotated[bool, Field(description="Respond after value and history are on the disk.")]


class WriteOptions(Body):
    """Options of writes; see `Component.set`."""

    settle: Annotated[float, Field(ge=0, le=60, alias="settle_s")] = 0.0
    force: Annotated[bool, Field(description="Write values out of range, NaN and infinities.")] = False
    durable: Durable = False
    timeout: Annotated[Seconds, Field(alias="timeout_s")] = None


class WriteRequest(WriteOptions):
    """One value."""

    value: Value


class WriteManyRequest(WriteOptions):
    """Several values, by name; written in this order, many at a time."""

    values: Values


class FetchRequest(Body):
    """Options of a fetch; see `Component.fetch_all`. `metadata` also loads the metadata from the vehicle."""

    refresh: bool = False
    metadata: bool = False
    timeout_s: Seconds = None


class UploadedFile(Body):
    """A parameter file, as text or in base64. Its name can indicate its format; `component` selects a set."""

    one_of = ("text", "base64")
    name: Annotated[str, Field(max_length=255)] = ""
    text: Annotated[str, Field(max_length=FILE_BYTES_MAX)] | None = None
    base64: Annotated[bytes, BeforeValidator(_decode), Field(max_length=FILE_BYTES_MAX)] | None = None
    format: FileFormat | None = None
    component: Annotated[int, Field(ge=0, le=255)] | None = None

    def read(self, *, partial: bool = False) -> ParamFile:
        """Parse the file; see `files.loads`. Blocks for up to seconds.

        Raises:
            FileError: the file is invalid.
        """
        data = (self.text or "").encode("utf-8", "surrogatepass") if self.base64 is None else self.base64
        return loads(data, source=self.name, file_format=self.format, partial=partial)

    def read_set(self, component: Component) -> ParamSet:
        """Parse the file, and return its set for a component; see `read`."""
        chosen = component.component if self.component is None else self.component
        return choose(self.read(), chosen, component.system)


class PlanOptions(Body):
    """What else is written; `include` takes names, patterns and categories, such as out-of-range."""

    include: Patterns = ()
    force: Annotated[bool, Field(description="Write values out of range, NaN and infinities.")] = False


class PlanRequest(PlanOptions):
    """Wanted parameters: exactly one of `values`, `file` and `at`, limited to `only`."""

    one_of = ("values", "file", "at")
    values: Values | None = None
    file: UploadedFile | None = None
    at: Moment | None = None
    only: Patterns | None = None


class RunOptions(PlanOptions):
    """Options of an apply or restore; see `paramclient.provision.apply`."""

    reboot: bool = False
    allow_armed: bool = False
    timeout: Annotated[Seconds, Field(alias="timeout_s")] = None


class ApplyRequest(RunOptions, PlanRequest):
    """Wanted parameters with options."""

    partial: bool = False
    durable: Durable = False


class RestoreRequest(RunOptions):
    """The state to restore; without `at`, the state before the last apply."""

    at: Moment | None = None


class SnapshotRequest(Body):
    """Reason of a snapshot."""

    reason: Annotated[str, Field(min_length=1, max_length=200)]


# the subject and the author of a request


async def author_of(request: Request) -> str:
    """Return the author of the changes of a request: the name of the token, and that in X-Author, if any."""
    name: str = request.state.holder.name
    page = request.headers.get("x-author", "")
    return f"{name} ({page})" if _PAGE_NAME.fullmatch(page) else name


async def require_write(request: Request) -> None:
    """Reject a request with a token that may not write.

    Raises:
        ServiceError: 403, it may not.
    """
    if request.state.holder.role != "write":
        raise ServiceError(403, "forbidden", "This request requires a token that may write.")


bearer = Depends(HTTPBearer(auto_error=False))  # described here, and checked before
public = APIRouter()
reading = APIRouter(dependencies=[bearer])
writing = APIRouter(dependencies=[bearer, Depends(require_write)])


async def _hub_of(request: Request) -> Hub:
    hub: Hub = request.app.state.hub
    return hub


Author = Annotated[str, Depends(author_of)]
HubArgument = Annotated[Hub, Depends(_hub_of)]
System = Annotated[int, Path(ge=1, le=255)]
ComponentId = Annotated[int, Path(ge=0, le=255)]
LinkName = Annotated[str | None, Query(max_length=200, description="The link, if several have the ids.")]
At = Annotated[Moment | None, Query(description="An earlier state: a snapshot's number, or a time.")]
Names = Annotated[list[Pattern] | None, Query(max_length=64, description="Names, or patterns such as MC_*.")]
Ext = Annotated[bool, Query(description="The extended parameters (PARAM_EXT_*).")]


async def _target_of(
    hub: HubArgument, system: System, component: ComponentId, link: LinkName = None, ext: Ext = False
) -> Target:
    return hub.target(system, component, link, extended=ext)


TargetArgument = Annotated[Target, Depends(_target_of)]
"""The plain parameters of a component on a link; with `ext`, the extended ones."""


# the service


@public.get("/health")
async def health(request: Request, hub: HubArgument) -> dict[str, Any]:
    """Return that the service responds; with a valid token also its role, and the links."""
    holder = request.state.holder
    found: dict[str, Any] = {"status": "ok", "version": __version__}
    if holder is None:
        return found | {"role": None}
    links = [{"name": link.name, "state": link.state, "error": link.error} for link in hub.links.values()]
    return found | {"role": holder.role, "up_s": round(time.monotonic() - hub.started, 1), "links": links}


@reading.get("/api/events", response_class=EventSourceResponse)
async def events(
    hub: HubArgument, last_event_id: Annotated[str | None, Header(max_length=100)] = None
) -> AsyncIterator[ServerSentEvent]:
    """Stream all events (server-sent events); with Last-Event-ID, those that were missed first."""
    async for event in hub.feed.follow(last_event_id):
        yield event


@reading.get("/api/stations")
async def stations(hub: HubArgument) -> list[dict[str, Any]]:
    """Return the ground stations at the endpoints, with what the answers to them have saved."""
    return [each.state for each in hub.gateway.stations]


@reading.get("/api/vehicles")
async def vehicles(hub: HubArgument) -> dict[str, Any]:
    """Return the components on the links, the lowest ids first."""
    return {**hub.feed.position, "vehicles": [target.state for target in hub.targets]}


# parameters


@reading.get(f"{VEHICLE}/params")
async def params(
    target: TargetArgument,
    names: Names = None,
    metadata: Annotated[bool, Query(description="Include the whole metadata of the parameters.")] = False,
    at: At = None,
) -> JsonObject:
    """Return the known parameters by name, and the last event whose effects they include, without traffic."""
    position = target.hub.feed.position
    choice = NameChoice(names or ["*"])
    if at is not None:
        state = await target.state_at(at)
        earlier = {name: json_output.written_json(each) for name, each in state.items() if choice.has(name)}
        return {**position, "params": earlier}
    known = [each for name, each in target.component.params.items() if choice.has(name)]

    def encode() -> JsonObject:
        return {**position, "params": {each.name: target.shown(each, whole=metadata) for each in known}}

    return await anyio.to_thread.run_sync(encode)


@reading.get(f"{VEHICLE}/params/{{name:path}}")
async def param(
    target: TargetArgument,
    name: str,
    live: Annotated[bool, Query(description="Read it from the vehicle, also if it is known.")] = False,
) -> JsonObject:
    """Return one parameter: the known value, else that of the vehicle."""
    known = None if live else target.component.params.get(name)
    return target.shown(known or await target.component.get(name), whole=True)


@writing.put(f"{VEHICLE}/params/{{name:path}}")
async def set_param(author: Author, target: TargetArgument, name: str, body: WriteRequest) -> JsonObject:
    """Write one parameter, and verify the value that the vehicle reports."""
    values = await target.values({name: body.value}, force=body.force)
    done = await target.component.set(name, values[name], **body.model_dump(exclude={"value"}), author=author)
    outcome = SetOutcome(name, values[name], SetStatus(done.status), done)
    return json_output.outcome_json(outcome, target.component, target.metadata)


@writing.patch(f"{VEHICLE}/params")
async def set_params(author: Author, target: TargetArgument, body: WriteManyRequest) -> dict[str, Any]:
    """Write several parameters in order, many at a time, and verify each.

    If a value is invalid or out of range, nothing is written. A value that the vehicle refuses does not stop
    the others. `error` says why not all could be tried, if so.
    """
    values = await target.values(body.values, force=body.force)
    result = await target.component.set_many(values, **body.model_dump(exclude={"values"}), author=author)
    error = {} if result.error is None else {"error": str(result.error)}
    return json_output.results_json(result.outcomes, target.component, target.metadata) | error


@reading.post(f"{VEHICLE}/fetch")
async def fetch(target: TargetArgument, body: FetchRequest) -> JsonObject:
    """Fetch all parameters. Simultaneous requests share one download; the progress is in the events."""
    result = await target.fetch(refresh=body.refresh, timeout=body.timeout_s)
    if body.metadata:
        await target.load_metadata(timeout=body.timeout_s)
    return json_output.fetch_json(target.component, result, target.component.params.values(), target.metadata)


# files


@reading.post("/api/files")
async def read_file(body: UploadedFile) -> dict[str, Any]:
    """Parse a parameter file of any format, without lines that cannot be read. It is not stored."""
    file = await anyio.to_thread.run_sync(partial(body.read, partial=True))
    sets = [json_output.set_json(each) for each in file.sets]
    return {"file": file.source, "format": file.file_format, "notes": file.notes, "components": sets}


@reading.get(f"{VEHICLE}/file", response_class=Response, responses=FILE)
async def file(
    target: TargetArgument,
    file_format: Annotated[FileFormat, Query(alias="format")] = FileFormat.QGC,
    changed: Annotated[bool, Query(description="Only parameters that differ from the defaults.")] = False,
    at: At = None,
) -> Response:
    """Return the parameters as a file. They are fetched first, unless they are in sync."""
    if at is not None:
        found = await target.state_at(at)
    else:
        fetched = await target.component.fetch_all()
        found = fetched_set(target.component, fetched, source=f"link {target.link.name}")
    if changed:
        metadata = target.metadata if at is None else None
        found = select_non_defaults(found, {} if metadata is None else metadata.defaults_of(found))
    name = _file_name(target.component, found.at, file_format)
    found, _ = writable(found, file_format)
    data = await anyio.to_thread.run_sync(lambda: dumps(found, file_format=file_format, target=name))
    headers = {"content-disposition": f'attachment; filename="{name}"'}
    return Response(data, media_type="application/octet-stream", headers=headers)


def _file_name(component: Component, at: float | None, file_format: FileFormat) -> str:
    """Return a name with firmware, ids and time, in characters that are safe in headers and files."""
    written = time.strftime("%Y%m%d-%H%M%S", time.gmtime(at))
    ending = next(ending for ending, each in ENDINGS.items() if each is file_format)
    name = f"{component.autopilot}-{component.system}-{component.component}-{written}"
    return re.sub(r"[^A-Za-z0-9._-]", "_", name) + ending


# apply and restore


async def _only_apply(target: TargetArgument) -> AsyncIterator[None]:
    """Run one apply or restore of a component at a time: two would undo each other's changes."""
    if target.applying.locked():
        raise ServiceError(409, "busy", "Another apply or restore of this vehicle is running.")
    async with target.applying:
        yield


@reading.post(f"{VEHICLE}/plan")
async def plan(target: TargetArgument, body: PlanRequest) -> JsonObject:
    """Return which values an apply would write, in which order, and which it would skip, and why."""
    component, wanted = target.component, await _wanted(target, body)
    found = await plan_of(component, wanted, include=body.include, info=target.metadata, force=body.force)
    return plan_json(found, component)


@writing.post(f"{VEHICLE}/apply", dependencies=[Depends(_only_apply)])
async def apply_(author: Author, target: TargetArgument, body: ApplyRequest) -> JsonObject:
    """Write the wanted values in a working order, and verify each of them.

    The progress is in the events. If the client disconnects, the apply ends; written values stay.
    """
    wanted = await _wanted(target, body)
    options = body.model_dump(exclude={"values", "file", "at", "only"}) | _context(author, target)
    return apply_json(await apply(target.component, wanted, **options), target.component)


@writing.post(f"{VEHICLE}/restore", dependencies=[Depends(_only_apply)])
async def restore_(author: Author, target: TargetArgument, body: RestoreRequest) -> JsonObject:
    """Restore an earlier state, with the vehicle's own identity and calibration."""
    if body.at is None:
        state = (await target.cached(load_restore_point)).state
    else:
        state = await target.state_at(body.at)
    options = body.model_dump(exclude={"at"}) | _context(author, target)
    return apply_json(await restore(target.component, state, **options), target.component)


async def _wanted(target: Target, body: PlanRequest) -> ParamSet:
    """Return the wanted parameters of a request."""
    if body.file is not None:
        found = await anyio.to_thread.run_sync(body.file.read_set, target.component)
    elif body.at is not None:
        found = await target.state_at(body.at)
    else:
        found = ParamSet(await target.values(body.values or {}), is_extended=target.component.is_extended)
    return found if body.only is None else await anyio.to_thread.run_sync(found.only, body.only)


def _context(author: str, target: Target) -> dict[str, Any]:
    """Return the arguments of `apply` and `restore` that are not in the body.

    Each phase is published, and its progress at an interval.
    """
    phase, due_at = "", 0.0

    def progress(now: ApplyProgress) -> None:
        nonlocal phase, due_at
        if now.phase != phase or time.monotonic() >= due_at:
            phase, due_at = now.phase, time.monotonic() + PROGRESS_INTERVAL
            target.publish("apply", phase=now.phase, done=now.done, total=now.total)

    return {"info": target.metadata, "author": author, "progress": progress}


# the past


@reading.get(f"{VEHICLE}/snapshots")
async def snapshots(target: TargetArgument) -> JsonObject:
    """Return the snapshots, the newest last."""
    return {"snapshots": [*map(json_output.snapshot_json, await target.cached(ParamCache.snapshots))]}


@writing.post(f"{VEHICLE}/snapshots", status_code=201)
async def create_snapshot(target: TargetArgument, body: SnapshotRequest) -> JsonObject:
    """Store a snapshot of the known table."""
    if not target.component.params:
        raise UsageError("no parameter of the vehicle is known")
    await target.component.core.cache_writer.write_all()
    stored = await target.cached(partial(ParamCache.store_snapshot, reason=body.reason))
    return json_output.snapshot_json(stored)


@reading.get(f"{VEHICLE}/history")
async def history(
    target: TargetArgument,
    name: Annotated[str | None, Query(max_length=16)] = None,
    limit: Annotated[int, Query(ge=1, le=1_000)] = 100,
    since: Annotated[AwareDatetime | None, Query(description="Only from this time on.")] = None,
) -> JsonObject:
    """Return the newest changes of values, the newest last."""
    entries = await target.cached(ParamCache.history, name, limit, since and since.timestamp())
    return {"history": [json_output.history_json(each) for each in entries]}


# metrics


@reading.get("/metrics", response_class=PlainTextResponse)
async def metrics(hub: HubArgument) -> PlainTextResponse:
    """Return the metrics for Prometheus in text format."""
    lines = []
    for name, samples in _metrics(hub):
        lines.append(f"# TYPE paramclient_{name} {'counter' if name.endswith('_total') else 'gauge'}")
        for labels, value in samples:
            pairs = [f"{label}={json.dumps(str(each), ensure_ascii=False)}" for label, each in labels.items()]
            lines.append(f"paramclient_{name}{{{','.join(pairs)}}} {float(value)}")
    return PlainTextResponse("\n".join([*lines, ""]))


def _metrics(hub: Hub) -> Iterator[tuple[str, Sequence[tuple[Mapping[str, object], float]]]]:
    """Yield the name of each metric, with labels and values. The name of a counter ends with `_total`."""
    yield "info", [({"version": __version__}, 1)]

    links = [({"link": link.name}, link) for link in hub.links.values()]
    yield "link_open", [(at, link.state == "open") for at, link in links]
    clients = [(at, link.client) for at, link in links if link.client is not None]
    yield "link_bytes_received_total", [(at, each.bytes_received) for at, each in clients]
    yield "link_bytes_sent_total", [(at, each.bytes_sent) for at, each in clients]

    yield "component_synced", [(each.address, each.component.sync_state == "synced") for each in hub.targets]

    endpoints = [({"endpoint": each.address}, each.stations.values()) for each in hub.gateway.endpoints]
    yield "stations", [(at, len(stations)) for at, stations in endpoints]
    for name in ("relayed", "answered", "saved", "dropped"):
        sums = [(at, sum(getattr(each, name) for each in stations)) for at, stations in endpoints]
        yield f"stations_{name}", sums
