"""What firmwares say of their parameters: what is known here, what the vehicle says, what a file says."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request, Response

from paramclient.documents.document import Body
from paramclient.documents.param import DescribedDoc, InfosDoc
from paramclient.metadata import Metadata, metadata_of, read_content
from paramclient.model.patterns import NameChoice
from paramclient.service.answering import document_answer
from paramclient.service.followed_component import Followed
from paramclient.service.param_sources import LONGEST_NAME, MOST_PATTERNS
from paramclient.service.problems import ServiceError
from paramclient.service.reading import BodyRoute, long_request
from paramclient.service.request import LARGEST_DESCRIPTION
from paramclient.service.route_context import Seconds, Target, TheHub, answered, may_write
from paramclient.service.routes.param_files import RAW_BODY, body_of

__all__ = ["router"]

router = APIRouter(
    prefix="/api/v1/components/{system}/{component}", tags=["descriptions"], route_class=BodyRoute
)


class Asked(Body):
    """How long to wait for an answer."""

    timeout_s: Seconds = None


@router.get("/metadata", response_model=InfosDoc)
async def known_infos(
    hub: TheHub,
    target: Target,
    names: Annotated[
        list[str], Query(max_length=MOST_PATTERNS, description="Such as MC_*; any of them.")
    ] = [],  # noqa: B006 - FastAPI copies it
) -> Response:
    """What is known here of the parameters that the component has."""
    metadata = target.metadata
    if metadata is None:
        raise ServiceError(404, "not-described", "Nothing is known here of what its parameters mean.")
    known = list(target.component.params)

    def document() -> InfosDoc:
        chosen = NameChoice(names)
        return InfosDoc.of(metadata, [name for name in known if not names or chosen.has(name)])

    return await document_answer(hub.aside, document)


@router.post("/metadata")
async def described(request: Request, target: Target, body: Asked) -> DescribedDoc:
    """Let the component describe its parameters. It is kept for its firmware."""
    metadata = await answered(request, lambda: metadata_of(target.component, timeout=body.timeout_s), target)
    if metadata is None:
        raise ServiceError(404, "not-described", "The component does not describe its parameters.")
    return _take(target, metadata)


@router.put("/metadata", dependencies=[Depends(may_write)], openapi_extra=RAW_BODY)
async def described_by_file(
    request: Request,
    hub: TheHub,
    target: Target,
    name: Annotated[str, Query(max_length=LONGEST_NAME)] = "the file",
) -> DescribedDoc:
    """Take the descriptions of a file, for as long as the service runs."""
    content = await body_of(request, LARGEST_DESCRIPTION)
    with long_request(request):
        return _take(target, await hub.read_aside(lambda: read_content(content, source=name)))


def _take(target: Followed, metadata: Metadata) -> DescribedDoc:
    target.metadata = metadata
    target.tell("params", {"count": len(target.component.params)})
    return DescribedDoc(count=len(metadata), source=metadata.source)
