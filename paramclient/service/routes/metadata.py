"""Routes of parameter metadata: the known descriptions, those of the vehicle, those of a file."""

from __future__ import annotations

import json
from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request, Response

from paramclient.documents.document import Body
from paramclient.documents.param import DescribedDoc, InfoDoc, InfosDoc
from paramclient.metadata import Metadata, metadata_of, read_content
from paramclient.model.patterns import NameChoice
from paramclient.service.body_limits import METADATA_BYTES_MAX
from paramclient.service.followed_component import FollowedComponent
from paramclient.service.param_sources import FILE_NAME_LENGTH_MAX, PATTERNS_MAX, Pattern
from paramclient.service.problems import ServiceError
from paramclient.service.request_body import BodyRoute, long_request
from paramclient.service.responses import streamed_response
from paramclient.service.route_context import (
    HubArgument,
    Seconds,
    Target,
    require_write,
    run_until_disconnect,
)
from paramclient.service.routes.param_files import RAW_BODY, read_body

__all__ = ["router"]

router = APIRouter(
    prefix="/api/v1/components/{system}/{component}", tags=["descriptions"], route_class=BodyRoute
)


class DescribeRequest(Body):
    """Timeout of the vehicle's response."""

    timeout_s: Seconds = None


@router.get("/metadata", response_model=InfosDoc)
async def known_infos(
    hub: HubArgument,
    target: Target,
    names: Annotated[
        list[Pattern], Query(max_length=PATTERNS_MAX, description="Names or patterns such as MC_*.")
    ] = [],  # noqa: B006 - FastAPI copies it
) -> Response:
    """Return the known descriptions of the parameters of the component."""
    metadata = target.metadata
    if metadata is None:
        raise ServiceError(404, "not-described", "The service has no metadata of the component's parameters.")
    known = list(target.component.params)
    if names:
        chosen = await hub.run_in_file_thread(lambda: NameChoice(names).choose(known)[0])
        known = [name for name in known if name in chosen]
    entries = (
        f"{json.dumps(name)}:{InfoDoc.of(info).model_dump_json()}"
        for name in known
        if (info := metadata.find(name)) is not None
    )
    return streamed_response(f'{{"source":{json.dumps(metadata.source)},"params":{{', entries, "}}")


@router.post("/metadata")
async def described(request: Request, target: Target, body: DescribeRequest) -> DescribedDoc:
    """Fetch the descriptions from the component. They are cached for its firmware."""
    with long_request(request):
        metadata = await run_until_disconnect(
            request, lambda: metadata_of(target.component, timeout=body.timeout_s), target
        )
    if metadata is None:
        raise ServiceError(404, "not-described", "The component provides no metadata of its parameters.")
    return _take(target, metadata)


@router.put("/metadata", dependencies=[Depends(require_write)], openapi_extra=RAW_BODY)
async def described_by_file(
    request: Request,
    hub: HubArgument,
    target: Target,
    name: Annotated[str, Query(max_length=FILE_NAME_LENGTH_MAX)] = "the file",
) -> DescribedDoc:
    """Use the descriptions in a file until the end of the service."""
    content = await read_body(request, METADATA_BYTES_MAX)
    with long_request(request):
        return _take(target, await hub.run_in_file_thread(lambda: read_content(content, source=name)))


def _take(target: FollowedComponent, metadata: Metadata) -> DescribedDoc:
    target.describe(metadata)
    return DescribedDoc(count=len(metadata), source=metadata.source)
