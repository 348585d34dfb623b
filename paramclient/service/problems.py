"""Errors as problem documents (RFC 9457): those of the library, of FastAPI, and of the service."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any, Final

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ConfigDict
from pydantic_core import to_json
from starlette.exceptions import HTTPException
from starlette.responses import Response

from paramclient.errors import (
    AlreadyRestored,
    AmbiguousVehicle,
    CacheError,
    ClientClosed,
    FileError,
    FileTransferError,
    InvalidParameters,
    LinkError,
    MetadataError,
    NoReply,
    NotInCache,
    PackError,
    ParamClientError,
    UnknownParameter,
    UnknownVehicle,
    UsageError,
    VehicleError,
)

__all__ = ["RESPONSES", "Problem", "ServiceError", "install_handlers", "problem_of", "problem_response"]

MEDIA_TYPE: Final = "application/problem+json"
FAULTS_MAX: Final = 20
"""Maximum number of listed errors of one request."""

logger = logging.getLogger(__name__)


class Problem(BaseModel):
    """A problem: `type` is a name for programs, `detail` a sentence for users.

    `error` is the exception of the library, if there is one; its attributes are further members.
    """

    model_config = ConfigDict(extra="allow")

    type: str
    title: str
    status: int
    detail: str


RESPONSES: Final[dict[int | str, dict[str, Any]]] = {
    "default": {
        "description": "A problem (RFC 9457)",
        "model": Problem,
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


def problem_of(error: Exception) -> dict[str, Any]:
    """Return an exception as a problem document; an unexpected one without details."""
    if isinstance(error, ServiceError):
        return _problem(error.status, error.kind, str(error), error.members)
    if isinstance(error, ParamClientError):
        status = next(status for kind, status in _STATUSES.items() if isinstance(error, kind))
        name = type(error).__name__
        public = {key: value for key, value in vars(error).items() if not key.startswith("_")}
        text = to_json(public, inf_nan_mode="strings", bytes_mode="hex", fallback=str)
        members = {**json.loads(text), "error": name}
        kind = re.sub("(?<=[a-z])([A-Z])", r"-\1", name).lower()
        return _problem(status, kind, str(error), members)
    return _problem(500, "internal", "Internal error of the service. Its log has the details.", {})


def problem_response(problem: Mapping[str, Any], headers: Mapping[str, str] | None = None) -> Response:
    """Return the response with a problem document."""
    content = json.dumps(problem, allow_nan=False)
    return Response(content, problem["status"], headers=dict(headers or {}), media_type=MEDIA_TYPE)


def install_handlers(app: FastAPI) -> None:
    """Set the exception handlers of an application."""
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(HTTPException, _refused)
    for kind in (ParamClientError, ServiceError, Exception):
        app.add_exception_handler(kind, _failed)


async def _invalid(_: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    faults = [
        {"where": ".".join(str(part)[:100] for part in fault["loc"]), "what": fault["msg"]}
        for fault in error.errors()[:FAULTS_MAX]
    ]
    detail = "; ".join(f"{fault['where']}: {fault['what']}" for fault in faults)
    return problem_response(_problem(422, "invalid-request", detail, {"faults": faults}))


async def _refused(_: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    phrase = HTTPStatus(error.status_code).phrase
    problem = _problem(error.status_code, phrase.lower().replace(" ", "-"), error.detail, {})
    return problem_response(problem, error.headers)


async def _failed(request: Request, error: Exception) -> Response:
    problem = problem_of(error)
    if problem["status"] == 500:
        logger.error("%s failed", request.url.path, exc_info=error)
    return problem_response(problem)


def _problem(status: int, kind: str, detail: str, members: Mapping[str, Any]) -> dict[str, Any]:
    title = kind.replace("-", " ").capitalize()
    return {**members, "type": f"urn:paramclient:{kind}", "title": title, "status": status, "detail": detail}


_STATUSES: Final[dict[type[ParamClientError], int]] = {
    UnknownParameter: 404,
    FileTransferError: 502,
    VehicleError: 409,
    NoReply: 504,
    ClientClosed: 503,
    LinkError: 503,
    NotInCache: 404,
    UnknownVehicle: 404,
    AlreadyRestored: 409,
    CacheError: 503,
    AmbiguousVehicle: 409,
    FileError: 422,
    InvalidParameters: 422,
    MetadataError: 422,
    PackError: 422,
    UsageError: 422,
    ParamClientError: 500,
}
"""HTTP status of each exception; the first class that matches counts."""
