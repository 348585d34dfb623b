"""Parameter files: what a component has in any form, and what a file says."""

from __future__ import annotations

import re
import time
from typing import Annotated, Any, Final

from fastapi import APIRouter, Query, Request, Response

from paramclient.documents.paramset import FormDoc, FormsDoc, UploadedDoc
from paramclient.errors import UsageError
from paramclient.files import FileForm, dumps
from paramclient.files.param_file import ENDINGS
from paramclient.model.identity import autopilot_name
from paramclient.model.paramset import ParamSet
from paramclient.provision.vehicle_params import fetch_set, select_non_defaults
from paramclient.service.answering import document_answer
from paramclient.service.hub import Hub
from paramclient.service.param_sources import (
    LARGEST_UPLOAD,
    LONGEST_NAME,
    check_size,
    known_set,
    read_upload,
    state,
    when_of,
)
from paramclient.service.reading import long_request
from paramclient.service.route_context import Target, TheHub, answered

__all__ = ["RAW_BODY", "attachment", "body_of", "moment", "router"]

router = APIRouter(prefix="/api/v1", tags=["files"])

LONGEST_STEM: Final = 100
"""Characters of the name of a file that is given, before its ending."""

Form = Annotated[FileForm, Query(description="One of those that /forms says can be written.")]
From = Annotated[str, Query(alias="from", max_length=64, description="live, known, snapshot:ID, or a time.")]
Id = Annotated[int | None, Query(ge=1, le=255)]

RAW_BODY: Final[dict[str, Any]] = {
    "requestBody": {
        "required": True,
        "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
    }
}
"""For the document of the API: the body is a file as it is."""

_FILE: Final[dict[int | str, dict[str, Any]]] = {
    200: {"content": {"application/octet-stream": {}}, "description": "The file"}
}


@router.get("/forms")
async def forms() -> FormsDoc:
    """The forms of parameter files. All of them are read."""
    return FormsDoc(forms=[FormDoc.of(form) for form in FileForm])


@router.get("/components/{system}/{component}/file", responses=_FILE, response_class=Response)
async def file(
    request: Request,
    hub: TheHub,
    target: Target,
    form: Form = FileForm.QGC,
    source: From = "live",
    changed: Annotated[bool, Query(description="Only what differs from the firmware's defaults.")] = False,
) -> Response:
    """The parameters of a component as a file; `live` asks the vehicle. An incomplete table is not given."""

    async def work() -> Response:
        if source not in ("live", "known"):
            if changed:
                raise UsageError("what differs from the defaults is known of the present table alone")
            return await attachment(hub, await state(hub, target, moment(source)), form)
        if source == "known":
            found = await known_set(target, hub.aside)
        else:
            found = await fetch_set(target.component, source=f"link {target.line.name}", run=hub.aside)
        chosen = await hub.aside(lambda: select_non_defaults(found.set)) if changed else found.set
        return await attachment(hub, chosen, form)

    return await answered(request, work, target)


@router.post("/files", response_model=UploadedDoc, openapi_extra=RAW_BODY)
async def files(
    request: Request,
    hub: TheHub,
    name: Annotated[str, Query(max_length=LONGEST_NAME, description="The ending may tell the form.")] = "",
    form: Annotated[FileForm | None, Query()] = None,
    component: Id = None,
    system: Id = None,
) -> Response:
    """Read a parameter file of any form; it is kept nowhere.

    Of a file with several components, `params` are those of the autopilot, or of the one that is named.
    """
    data = await body_of(request, LARGEST_UPLOAD)

    def document() -> UploadedDoc:
        found = read_upload(data, name, form)
        return UploadedDoc.of(found, found.choose(component, system=system))

    with long_request(request):
        return await document_answer(hub.read_aside, document)


def moment(text: str) -> float | int:
    """What `from` says: the number of a snapshot as an int, a time as a float.

    Raises:
        UsageError: it is neither.
    """
    number = re.fullmatch("snapshot:([0-9]{1,18})", text)
    if number:
        return int(number[1])
    try:
        at = when_of(text)
    except ValueError as error:
        raise UsageError(f"from={text}: {error}") from None
    assert isinstance(at, float)
    return at


async def attachment(hub: Hub, params: ParamSet, form: FileForm) -> Response:
    """A set as a file of this form, with a name of its own.

    Raises:
        FileError: the form cannot say it.
    """
    name = f"{_stem(params)}{_ending(form)}"
    data = await hub.aside(lambda: dumps(params, form=form, target=name))
    headers = {"content-disposition": f'attachment; filename="{name}"'}
    return Response(data, media_type="application/octet-stream", headers=headers)


async def body_of(request: Request, most: int) -> bytes:
    """All of the body, if it has no more bytes than these.

    Raises:
        ServiceError: it has.
    """
    data = bytearray()
    async for piece in request.stream():
        data += piece
        check_size(len(data), most)
    return bytes(data)


def _stem(params: ParamSet) -> str:
    """Whose parameters and of when, in characters that are safe in a header and on every disk."""
    autopilot = "params" if params.identity is None else autopilot_name(params.identity.autopilot)
    ids = [str(each) for each in (params.system, params.component) if each is not None]
    at = time.strftime("%Y%m%d-%H%M%S", time.gmtime(time.time() if params.at is None else params.at))
    return re.sub(r"[^A-Za-z0-9._-]", "_", "-".join([autopilot, *ids, at]))[:LONGEST_STEM]


def _ending(form: FileForm) -> str:
    return next((ending for ending, each in ENDINGS.items() if each is form), ".txt")
