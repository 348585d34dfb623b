"""Errors as problem documents (RFC 9457): those of the library, of FastAPI, and of the service."""

from __future__ import annotations

import json
import logging
import re
from http import HTTPStatus
from typing import Any, Final

from fastapi import Request
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel
from pydantic_core import to_jsonable_python
from starlette.exceptions import HTTPException
from starlette.responses import Response

from paramclient import errors
from paramclient.errors import ParamClientError

MEDIA_TYPE: Final = "application/problem+json"
FAULTS_MAX: Final = 20
"""Maximum number of listed errors of one request."""
STATUSES: Final[dict[int, tuple[type[ParamClientError], ...]]] = {
    404: (errors.UnknownParameter, errors.NotInCache, errors.UnknownVehicle),
    502: (errors.FileTransferError,),
    409: (errors.AlreadyRestored, errors.AmbiguousVehicle, errors.VehicleError),
    503: (errors.LinkError, errors.CacheError),
    504: (errors.NoReply,),
    422: (errors.UsageError, errors.PackError),
}
"""Exceptions by HTTP status; the first class that matches counts, and others have 500."""

logger = logging.getLogger(__name__)


class Problem(BaseModel, extra="allow"):
    """A problem: `type` is a name for programs, `detail` a sentence for users.

    `error` is the exception of the library, if there is one; its attributes are further members.
    """

    type: str
    title: str
    status: int
    detail: str


RESPONSES: Final[dict[int | str, dict[str, Any]]] = {
    "default": {
        "description": "A problem (RFC 9457)",
        "content": {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}},
    }
}
"""Errors that every route can return, for the OpenAPI document."""


class ServiceError(Exception):
    """An error of the service itself.

    Args:
        status: HTTP status code.
        kind: name of the problem, for programs.
        detail: text for users.
        members: further members of the problem.
    """

    def __init__(self, status: int, kind: str, detail: str, **members: Any) -> None:
        super().__init__(detail)
        self.status = status
        self.kind = kind
        self.members = members


ERRORS: Final = (RequestValidationError, HTTPException, ParamClientError, ServiceError, Exception)
"""Exceptions that are answered by `respond`."""


def problem_response(error: Exception) -> Response:
    """Return the response to an exception: a problem document; of an unexpected one without details."""
    status, kind, detail, members = 500, "internal", "Internal error of the service; see its log.", {}
    headers = None
    if isinstance(error, ServiceError):
        status, kind, detail, members = error.status, error.kind, str(error), error.members
    elif isinstance(error, ParamClientError):
        status = next((status for status, kinds in STATUSES.items() if isinstance(error, kinds)), 500)
        name, detail = type(error).__name__, str(error)
        kind = re.sub("(?<=[a-z])([A-Z])", r"-\1", name).lower()
        public = {key: value for key, value in vars(error).items() if not key.startswith("_")}
        members = to_jsonable_python(public, inf_nan_mode="strings", bytes_mode="hex", fallback=str)
        members["error"] = name
    elif isinstance(error, RequestValidationError):
        first = error.errors()[:FAULTS_MAX]
        faults = [f"{'.'.join(str(part)[:100] for part in each['loc'])}: {each['msg']}" for each in first]
        status, kind, detail = 422, "invalid-request", "; ".join(faults)
    elif isinstance(error, HTTPException) and error.status_code == HTTPStatus.BAD_REQUEST:
        status, kind, detail = 422, "invalid-request", error.detail  # FastAPI's, of a body that is no text
    elif isinstance(error, HTTPException):
        status, detail, headers = error.status_code, error.detail, error.headers
        kind = HTTPStatus(status).phrase.lower().replace(" ", "-")
    if status == HTTPStatus.UNAUTHORIZED:
        headers = {"www-authenticate": "Bearer"}
    title = kind.replace("-", " ").capitalize()
    about = {"type": f"urn:paramclient:{kind}", "title": title, "status": status, "detail": detail}
    return Response(json.dumps(members | about), status, headers=headers, media_type=MEDIA_TYPE)


async def respond(request: Request, error: Exception) -> Response:
    """Return the response to an exception, and log an unexpected one."""
    response = problem_response(error)
    if response.status_code == HTTPStatus.INTERNAL_SERVER_ERROR:
        logger.error("%s failed", request.url.path, exc_info=error)
    return response
