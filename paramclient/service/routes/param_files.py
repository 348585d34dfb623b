"""Routes of parameter files: a component's parameters in any format, and parsing of files."""

from __future__ import annotations

import re
import time
from typing import Annotated, Any, Final

from fastapi import APIRouter, Query, Request, Response

from paramclient.documents.paramset import FormatDoc, FormatsDoc, UploadedDoc
from paramclient.errors import UsageError
from paramclient.files import FileFormat, dumps
from paramclient.files.formats import ENDINGS
from paramclient.model.identity import autopilot_name
from paramclient.model.paramset import ParamSet
from paramclient.provision.vehicle_params import fetch_set, select_non_defaults
from paramclient.service.body_limits import PARAM_FILE_BYTES_MAX
from paramclient.service.hub import Hub
from paramclient.service.param_sources import (
    FILE_NAME_LENGTH_MAX,
    check_size,
    current_set,
    load_state,
    parse_timestamp,
    parse_upload,
)
from paramclient.service.request_body import long_request
from paramclient.service.responses import document_response
from paramclient.service.route_context import HubArgument, Target, run_until_disconnect

__all__ = ["RAW_BODY", "file_response", "read_body", "parse_state", "router"]

router = APIRouter(prefix="/api/v1", tags=["files"])

FILE_STEM_LENGTH_MAX: Final = 100
"""Maximum number of characters of the name of a sent file, without its extension."""

Format = Annotated[FileFormat, Query(alias="format", description="A writable format of /formats.")]
From = Annotated[str, Query(alias="from", max_length=64, description="live, known, snapshot:ID, or a time.")]
Id = Annotated[int | None, Query(ge=1, le=255)]

RAW_BODY: Final[dict[str, Any]] = {
    "requestBody": {
        "required": True,
        "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
    }
}
"""OpenAPI description of a body that is a file."""

_FILE: Final[dict[int | str, dict[str, Any]]] = {
    200: {"content": {"application/octet-stream": {}}, "description": "The file"}
}


@router.get("/formats")
async def formats() -> FormatsDoc:
    """Return the formats of parameter files. All can be read."""
    return FormatsDoc(formats=[FormatDoc.of(file_format) for file_format in FileFormat])


@router.get("/components/{system}/{component}/file", responses=_FILE, response_class=Response)
async def file(
    request: Request,
    hub: HubArgument,
    target: Target,
    file_format: Format = FileFormat.QGC,
    source: From = "live",
    changed: Annotated[
        bool, Query(description="Only parameters that differ from the firmware's defaults.")
    ] = False,
) -> Response:
    """Return the parameters of a component as a file; `live` fetches them from the vehicle. An incomplete
    table is an error."""

    async def work() -> Response:
        if source not in ("live", "known"):
            if changed:
                raise UsageError("only the current table can be compared with the firmware's defaults")
            return await file_response(hub, await load_state(hub, target, parse_state(source)), file_format)
        if source == "known":
            found = await current_set(target, hub.run_in_thread)
        else:
            found = await fetch_set(target.component, source=f"link {target.link.name}")
        chosen = found.set
        if changed:
            metadata = target.metadata

            def differing() -> ParamSet:
                described = {} if metadata is None else metadata.defaults_of(found.set)
                return select_non_defaults(found.set, described)

            chosen = await hub.run_in_thread(differing)
        return await file_response(hub, chosen, file_format)

    return await run_until_disconnect(request, work, target)


@router.post("/files", response_model=UploadedDoc, openapi_extra=RAW_BODY)
async def files(
    request: Request,
    hub: HubArgument,
    name: Annotated[
        str, Query(max_length=FILE_NAME_LENGTH_MAX, description="The extension can indicate the format.")
    ] = "",
    file_format: Annotated[FileFormat | None, Query(alias="format")] = None,
    component: Id = None,
    system: Id = None,
) -> Response:
    """Parse a parameter file of any format. The file is not stored.

    For a file with several components, `params` has those of the autopilot, or of the given component.
    """
    data = await read_body(request, PARAM_FILE_BYTES_MAX)

    def document() -> UploadedDoc:
        found = parse_upload(data, name, file_format)
        return UploadedDoc.of(found, found.choose(component, system=system))

    with long_request(request):
        return await document_response(hub.run_in_file_thread, document)


def parse_state(text: str) -> float | int:
    """Parse `from`: the number of a snapshot as an int, a time as a float.

    Raises:
        UsageError: the text is neither.
    """
    number = re.fullmatch("snapshot:([0-9]{1,18})", text)
    if number:
        return int(number[1])
    try:
        at = parse_timestamp(text)
    except ValueError as error:
        raise UsageError(f"from={text}: {error}") from None
    assert isinstance(at, float)
    return at


async def file_response(hub: Hub, params: ParamSet, file_format: FileFormat) -> Response:
    """Return a response with a set as a file of this format.

    Raises:
        FileError: the format cannot represent the set.
    """
    name = f"{_stem(params)}{_ending(file_format)}"
    data = await hub.run_in_thread(lambda: dumps(params, file_format=file_format, target=name))
    headers = {"content-disposition": f'attachment; filename="{name}"'}
    return Response(data, media_type="application/octet-stream", headers=headers)


async def read_body(request: Request, most: int) -> bytes:
    """Return the whole body.

    Raises:
        ServiceError: 413, the body has more than `most` bytes.
    """
    data = bytearray()
    async for piece in request.stream():
        data += piece
        check_size(len(data), most)
    return bytes(data)


def _stem(params: ParamSet) -> str:
    """Return a file name with firmware, ids and time, in characters that are safe in headers and file
    systems."""
    autopilot = "params" if params.identity is None else autopilot_name(params.identity.autopilot)
    ids = [str(each) for each in (params.system, params.component) if each is not None]
    at = time.strftime("%Y%m%d-%H%M%S", time.gmtime(time.time() if params.at is None else params.at))
    return re.sub(r"[^A-Za-z0-9._-]", "_", "-".join([autopilot, *ids, at]))[:FILE_STEM_LENGTH_MAX]


def _ending(file_format: FileFormat) -> str:
    return next((ending for ending, each in ENDINGS.items() if each is file_format), ".txt")
