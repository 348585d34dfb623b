"""Routes of vehicles, parameters, fetches, events, health and metrics.

With `?ext=true`, the routes of parameters are about the extended parameters of a component.
With `?key=KEY`, the routes that read are about a vehicle in the cache.
"""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Final, TypeVar

import anyio
import anyio.to_thread
from fastapi import APIRouter, Depends, Path, Query, Request
from fastapi.responses import JSONResponse, Response
from starlette.types import Receive, Scope, Send

from paramclient.errors import NotInCache, UnknownParameter
from paramclient.metadata import Metadata
from paramclient.model.names import NameChoice, did_you_mean, nearest_names
from paramclient.model.values import Param, WireValue
from paramclient.protocol.set_results import SetManyResult, SetOutcome, SetStatus
from paramclient.service import documents
from paramclient.service.access import author_of, holder_of, require_write
from paramclient.service.hub import Hub
from paramclient.service.metrics import METRICS_MEDIA_TYPE, metrics_text
from paramclient.service.problems import ServiceError
from paramclient.service.request_bodies import (
    FetchRequest,
    MetadataRequest,
    SnapshotNumber,
    Timestamp,
    WriteManyRequest,
    WriteOptions,
    WriteRequest,
    range_faults,
    resolve_value,
)
from paramclient.service.targets import Target
from paramclient.version import __version__

__all__ = [
    "ROUTERS",
    "HubArgument",
    "Snapshot",
    "SourceArgument",
    "TargetArgument",
    "VEHICLE",
    "run_until_disconnect",
]

VEHICLE: Final = "/api/vehicles/{system}/{component}"
SEND_TIMEOUT: Final = 30.0
"""Seconds after which an event stream whose reader takes nothing is closed."""

Result = TypeVar("Result")

reading = APIRouter(tags=["vehicles and parameters"])
writing = APIRouter(tags=["vehicles and parameters"], dependencies=[Depends(require_write)])
ROUTERS: Final = (reading, writing)


async def _hub_of(request: Request) -> Hub:
    hub: Hub = request.app.state.hub
    return hub


HubArgument = Annotated[Hub, Depends(_hub_of)]
System = Annotated[int, Path(ge=1, le=255)]
ComponentId = Annotated[int, Path(ge=0, le=255)]
LinkName = Annotated[
    str | None, Query(max_length=200, description="Name of the link, if several have the ids.")
]
Snapshot = Annotated[SnapshotNumber | None, Query(description="The parameters of this snapshot.")]
Names = Annotated[list[str] | None, Query(max_length=64, description="Names, or patterns such as MC_*.")]
Key = Annotated[str | None, Query(max_length=400, description="Key of a vehicle in the cache.")]
Ext = Annotated[bool, Query(description="The extended parameters (PARAM_EXT_*).")]


async def _vehicle_of(
    hub: HubArgument, system: System, component: ComponentId, link: LinkName = None
) -> Target:
    return hub.target(system, component, link)


VehicleArgument = Annotated[Target, Depends(_vehicle_of)]
"""A component on a link."""


async def _target_of(vehicle: VehicleArgument, ext: Ext = False) -> Target:
    return vehicle.extended or vehicle if ext else vehicle


TargetArgument = Annotated[Target, Depends(_target_of)]
"""The plain parameters of a component on a link; with `ext`, the extended ones."""


@dataclass(frozen=True, slots=True)
class Source:
    """The plain or the extended parameters of a connected vehicle, or of one in the cache.

    Attributes:
        key: the key of its table in the cache.
        component: its component id.
        extended: whether the parameters are the extended ones.
        target: the connected component, or None.
    """

    key: str
    component: int
    extended: bool
    target: Target | None


async def _source_of(
    hub: HubArgument,
    system: System,
    component: ComponentId,
    link: LinkName = None,
    key: Key = None,
    ext: Ext = False,
) -> Source:
    if key is not None:
        return Source(key, component, ext, None)
    target = await _target_of(hub.target(system, component, link), ext)
    return Source(target.component.identity.key, component, ext, target)


SourceArgument = Annotated[Source, Depends(_source_of)]


# the service


@reading.get("/health")
async def health(request: Request, hub: HubArgument) -> dict[str, Any]:
    """Return that the service responds; with a valid token also its role, and the links."""
    holder = holder_of(request)
    found: dict[str, Any] = {"status": "ok", "version": __version__}
    if holder is not None:
        links = [{"name": link.name, "state": link.state, "error": link.error} for link in hub.links.values()]
        found |= {"up_s": round(time.monotonic() - hub.started, 1), "links": links}
    return found | {"role": None if holder is None else holder.role}


@reading.get("/metrics", response_class=Response)
async def metrics(hub: HubArgument) -> Response:
    """Return the metrics for Prometheus in text format."""
    return Response(metrics_text(hub), media_type=METRICS_MEDIA_TYPE)


@reading.get("/api/events", response_class=Response)
async def events(request: Request, hub: HubArgument) -> Response:
    """Stream all events (server-sent events); with Last-Event-ID, those that were missed first."""
    return _EventStream(hub.feed.follow(request.headers.get("last-event-id")))


# vehicles


@reading.get("/api/stations")
async def list_stations(hub: HubArgument) -> list[dict[str, Any]]:
    """Return the ground stations at the endpoints, with what the answers to them have saved."""
    return [documents.station(each) for each in hub.gateway.stations]


@reading.get("/api/vehicles")
async def vehicles(hub: HubArgument) -> Any:
    """Return the components on the links, the lowest ids first, and the tables in the cache."""
    found = {**hub.feed.position, "vehicles": [documents.vehicle(target) for target in hub.targets]}
    if hub.cache is None:
        return {**found, "cached": []}
    known, tables = await hub.read_cache(lambda cache: (cache.vehicles(), cache.components()))
    return {**found, "cached": documents.cached_vehicles(known, tables)}


@reading.get(VEHICLE)
async def vehicle(target: VehicleArgument) -> dict[str, Any]:
    """Return one component."""
    return documents.vehicle(target)


@reading.post(f"{VEHICLE}/fetch")
async def fetch(request: Request, hub: HubArgument, target: TargetArgument, body: FetchRequest) -> Any:
    """Fetch the whole table. Simultaneous requests share one download; the progress is in the events."""
    component = target.component
    work = component.fetch_all if component.is_extended else partial(hub.fetch, target)
    result = await run_until_disconnect(request, lambda: work(refresh=body.refresh, timeout=body.timeout_s))
    return documents.fetch_result(result, target)


@reading.post(f"{VEHICLE}/metadata")
async def load_metadata(
    request: Request, hub: HubArgument, target: VehicleArgument, body: MetadataRequest
) -> dict[str, Any]:
    """Load units, ranges, names of values and descriptions from the vehicle; they are stored."""
    found = await run_until_disconnect(request, lambda: hub.load_metadata(target, timeout=body.timeout_s))
    return {"count": len(found), "source": found.source}


# parameters


@reading.get(f"{VEHICLE}/params")
async def params(
    hub: HubArgument,
    source: SourceArgument,
    names: Names = None,
    metadata: Annotated[bool, Query(description="Include the whole metadata of the parameters.")] = False,
    snapshot: Snapshot = None,
    at: Annotated[Timestamp | None, Query(description="The parameters at this time.")] = None,
) -> Response:
    """Return the known parameters by name, without traffic."""
    position = hub.feed.position
    when = at if snapshot is None else snapshot
    if when is not None:
        place = source.key, source.component, when
        state = await hub.read_cache(lambda cache: cache.state_at(*place, extended=source.extended))
        return JSONResponse({**position, "params": _chosen(documents.param_set(state), names)})
    described, known = await _known_params(hub, source)
    chosen = _chosen(known, names).values()

    def encode() -> Response:
        found = documents.params(chosen, described, whole=metadata)
        return JSONResponse({**position, "params": found})

    return await anyio.to_thread.run_sync(encode)


async def _known_params(hub: Hub, source: Source) -> tuple[Metadata | None, dict[str, Param]]:
    """Return the metadata and the parameters of a vehicle.

    Raises:
        NotInCache: the cache has no such table.
    """
    if source.target is not None:
        return source.target.metadata, dict(source.target.component.params)
    key, component, store = source.key, source.component, hub.metadata_store
    table = await hub.read_cache(lambda cache: cache.load(key, component, extended=source.extended))
    if table is None:
        raise NotInCache(f"The cache has no table of component {component} of vehicle {key!r}.")
    described = None
    if store is not None:
        described = await anyio.to_thread.run_sync(store.known, table.identity, component)
    return described, dict(table.params)


@reading.get(f"{VEHICLE}/params/{{name:path}}")
async def param(
    request: Request,
    target: TargetArgument,
    name: str,
    live: Annotated[bool, Query(description="Read it from the vehicle.")] = False,
) -> dict[str, Any]:
    """Return one parameter: the known value, or with `live` that of the vehicle."""
    component = target.component
    known = component.params.get(name)
    if live:
        known = await run_until_disconnect(request, lambda: component.get(name))
    if known is None:
        nearest = tuple(nearest_names(name, component.params))
        why = f"no value of {name} has been received yet.{did_you_mean(nearest)}"
        ids = {"system": component.system, "component": component.component}
        raise UnknownParameter(why, **ids, name=name, index=None, nearest=nearest)
    return documents.param(known, target.metadata)


@writing.put(f"{VEHICLE}/params/{{name:path}}")
async def set_param(
    request: Request, target: TargetArgument, name: str, body: WriteRequest
) -> dict[str, Any]:
    """Write one parameter, and verify the value that the vehicle reports."""
    author, component = author_of(request), target.component

    async def work() -> SetOutcome:
        value = await resolve_value(target, name, body.value)
        _check_ranges(target, {name: value}, body)
        result = await component.set(name, value, **_write_options(body, author))
        return SetOutcome(name, value, SetStatus(result.status), result)

    return documents.write(await run_until_disconnect(request, work), target)


@writing.patch(f"{VEHICLE}/params")
async def set_params(request: Request, target: TargetArgument, body: WriteManyRequest) -> dict[str, Any]:
    """Write several parameters in order, many at a time, and verify each.

    If a value is invalid or out of range, nothing is written. A value that the vehicle refuses does not stop
    the others. `error` is present if not all could be tried.
    """
    author, component = author_of(request), target.component

    async def work() -> SetManyResult:
        values = {name: await resolve_value(target, name, given) for name, given in body.values.items()}
        _check_ranges(target, values, body)
        return await component.set_many(values, **_write_options(body, author))

    return documents.writes(await run_until_disconnect(request, work), target)


async def run_until_disconnect(request: Request, work: Callable[[], Awaitable[Result]]) -> Result:
    """Run the work of a request whose body is received, and cancel it if the client disconnects."""
    outcome: Result | Exception = ServiceError(499, "gone", "The client has disconnected.")

    async def watch(scope: anyio.CancelScope) -> None:
        while (await request.receive())["type"] != "http.disconnect":
            pass
        scope.cancel()

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(watch, tasks.cancel_scope)
        try:
            outcome = await work()
        except Exception as error:  # the task group would wrap it
            outcome = error
        tasks.cancel_scope.cancel()
    if isinstance(outcome, Exception):
        raise outcome
    return outcome


def _chosen(known: dict[str, Result], names: list[str] | None) -> dict[str, Result]:
    """Return the members with these names or patterns."""
    if not names:
        return known
    choice = NameChoice(names)
    return {name: each for name, each in known.items() if choice.has(name)}


def _check_ranges(target: Target, values: dict[str, WireValue], body: WriteOptions) -> None:
    """Check that values are in the ranges of the metadata, unless they are forced.

    Raises:
        ServiceError: 422, values are out of range.
    """
    faults = {} if body.force else range_faults(target, values)
    if faults:
        detail = f"{'; '.join(list(faults.values())[:5])}. Nothing was written; `force` writes it anyway."
        raise ServiceError(422, "out-of-range", detail, names=list(faults))


def _write_options(body: WriteOptions, author: str) -> dict[str, Any]:
    """Return the arguments that `set` and `set_many` have in common."""
    return {
        "settle": body.settle_s,
        "force": body.force,
        "durable": body.durable,
        "timeout": body.timeout_s,
        "author": author,
    }


class _EventStream(Response):
    """A response with server-sent events; ended when the client disconnects or takes nothing for a while."""

    media_type = "text/event-stream"

    def __init__(self, texts: AsyncIterator[str]) -> None:
        super().__init__()
        self._texts = texts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        del self.headers["content-length"]
        start = {"type": "http.response.start", "status": 200, "headers": self.raw_headers}

        async def watch(tasks: anyio.abc.TaskGroup) -> None:
            while (await receive())["type"] != "http.disconnect":
                pass
            tasks.cancel_scope.cancel()

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(watch, tasks)
            await send(start)
            async for text in self._texts:
                with anyio.move_on_after(SEND_TIMEOUT) as sending:
                    await send({"type": "http.response.body", "body": text.encode(), "more_body": True})
                if sending.cancelled_caught:
                    break
            else:
                await send({"type": "http.response.body", "body": b"", "more_body": False})
            tasks.cancel_scope.cancel()
