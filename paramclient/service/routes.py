"""Routes of the service itself, of vehicles and their parameters.

With `?ext=true`, the routes of parameters are about the extended parameters of a component.
"""

from __future__ import annotations

import time
from collections.abc import AsyncIterator
from typing import Annotated, Any, Final, TypeVar

import anyio.to_thread
from fastapi import APIRouter, Depends, Header, Path, Query, Request
from fastapi.responses import PlainTextResponse
from fastapi.sse import EventSourceResponse, ServerSentEvent

from paramclient.cli.json_output import FetchJson, ParamJson, VehicleJson, WriteJson, WrittenJson, as_json
from paramclient.model.names import NameChoice
from paramclient.protocol.set_results import SetOutcome, SetStatus
from paramclient.service import documents
from paramclient.service.access import author_of, require_write
from paramclient.service.documents import ParamsJson
from paramclient.service.hub import Hub
from paramclient.service.metrics import METRICS_MEDIA_TYPE, metrics_text
from paramclient.service.request_bodies import (
    FetchRequest,
    Moment,
    WriteManyRequest,
    WriteRequest,
    values_in_range,
)
from paramclient.service.targets import Target
from paramclient.version import __version__

__all__ = ["ROUTERS", "VEHICLE", "At", "HubArgument", "TargetArgument"]

VEHICLE: Final = "/api/vehicles/{system}/{component}"

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
At = Annotated[Moment | None, Query(description="An earlier state: a snapshot's number, or a time.")]
Names = Annotated[list[str] | None, Query(max_length=64, description="Names, or patterns such as MC_*.")]
Ext = Annotated[bool, Query(description="The extended parameters (PARAM_EXT_*).")]


async def _target_of(
    hub: HubArgument, system: System, component: ComponentId, link: LinkName = None, ext: Ext = False
) -> Target:
    return hub.target(system, component, link, extended=ext)


TargetArgument = Annotated[Target, Depends(_target_of)]
"""The plain parameters of a component on a link; with `ext`, the extended ones."""


# the service


@reading.get("/health")
async def health(request: Request, hub: HubArgument) -> dict[str, Any]:
    """Return that the service responds; with a valid token also its role, and the links."""
    holder = request.state.holder
    found: dict[str, Any] = {"status": "ok", "version": __version__}
    if holder is None:
        return found | {"role": None}
    links = [{"name": link.name, "state": link.state, "error": link.error} for link in hub.links.values()]
    return found | {"role": holder.role, "up_s": round(time.monotonic() - hub.started, 1), "links": links}


@reading.get("/metrics")
async def metrics(hub: HubArgument) -> PlainTextResponse:
    """Return the metrics for Prometheus in text format."""
    return PlainTextResponse(metrics_text(hub), media_type=METRICS_MEDIA_TYPE)


@reading.get("/api/events", response_class=EventSourceResponse)
async def events(
    hub: HubArgument, last_event_id: Annotated[str | None, Header()] = None
) -> AsyncIterator[ServerSentEvent]:
    """Stream all events (server-sent events); with Last-Event-ID, those that were missed first."""
    async for event in hub.feed.follow(last_event_id):
        yield event


@reading.get("/api/stations")
async def stations(hub: HubArgument) -> list[dict[str, Any]]:
    """Return the ground stations at the endpoints, with what the answers to them have saved."""
    return [documents.station(each) for each in hub.gateway.stations]


@reading.get("/api/vehicles")
async def vehicles(hub: HubArgument) -> dict[str, Any]:
    """Return the components on the links, the lowest ids first."""
    return {**hub.feed.position, "vehicles": [documents.vehicle(target) for target in hub.targets]}


# parameters


@reading.get(f"{VEHICLE}/params")
async def params(
    hub: HubArgument,
    target: TargetArgument,
    names: Names = None,
    metadata: Annotated[bool, Query(description="Include the whole metadata of the parameters.")] = False,
    at: At = None,
) -> ParamsJson:
    """Return the known parameters by name, without traffic."""
    position = hub.feed.position
    choice = NameChoice(names or ["*"])
    if at is not None:
        state = await hub.state_at(target, at)
        earlier = {name: WrittenJson.of(each) for name, each in state.items() if choice.has(name)}
        return ParamsJson(**position, params=earlier)
    known = [each for name, each in target.component.params.items() if choice.has(name)]

    def encode() -> ParamsJson:
        found = {each.name: documents.param(each, target.info(each.name), whole=metadata) for each in known}
        return ParamsJson(**position, params=found)

    return await anyio.to_thread.run_sync(encode)


@reading.get(f"{VEHICLE}/params/{{name:path}}")
async def param(
    target: TargetArgument,
    name: str,
    live: Annotated[bool, Query(description="Read it from the vehicle, also if it is known.")] = False,
) -> ParamJson:
    """Return one parameter: the known value, else that of the vehicle."""
    known = None if live else target.component.params.get(name)
    found = await target.component.get(name) if known is None else known
    return documents.param(found, target.info(name))


@writing.put(f"{VEHICLE}/params/{{name:path}}")
async def set_param(request: Request, target: TargetArgument, name: str, body: WriteRequest) -> WriteJson:
    """Write one parameter, and verify the value that the vehicle reports."""
    ((_, value),) = (await values_in_range({name: body.value}, target, force=body.force)).items()
    options = body.model_dump(exclude={"value"})
    result = await target.component.set(name, value, **options, author=author_of(request))
    return documents.write(SetOutcome(name, value, SetStatus(result.status), result), target)


@writing.patch(f"{VEHICLE}/params")
async def set_params(request: Request, target: TargetArgument, body: WriteManyRequest) -> dict[str, Any]:
    """Write several parameters in order, many at a time, and verify each.

    If a value is invalid or out of range, nothing is written. A value that the vehicle refuses does not stop
    the others. `error` says why not all could be tried.
    """
    values = await values_in_range(body.values, target, force=body.force)
    options = body.model_dump(exclude={"values"})
    result = await target.component.set_many(values, **options, author=author_of(request))
    found = {"vehicle": VehicleJson.of(target.component), "error": result.error and str(result.error)}
    return dict(as_json(found | {"results": [documents.write(each, target) for each in result.outcomes]}))


@reading.post(f"{VEHICLE}/fetch")
async def fetch(hub: HubArgument, target: TargetArgument, body: FetchRequest) -> FetchJson:
    """Fetch all parameters. Simultaneous requests share one download; the progress is in the events."""
    component, client = target.component, target.link.client
    result = await hub.fetch(target, refresh=body.refresh, timeout=body.timeout_s)
    if body.metadata:
        await hub.load_metadata(target, timeout=body.timeout_s)
    known = dict(component.params)
    return FetchJson.of(
        component,
        result,
        known.values(),
        bytes_received=0 if client is None else client.bytes_received,
        bytes_sent=0 if client is None else client.bytes_sent,
        described={} if target.metadata is None else target.metadata.defaults_of(known),
    )
