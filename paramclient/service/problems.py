"""Errors as problem documents (RFC 9457): those of the library, of FastAPI, and of the service."""

from __future__ import annotations

import json
import logging
import math
import re
from collections.abc import Iterable, Mapping
from http import HTTPStatus
from typing import Any, Final

from fastapi import FastAPI, Request, WebSocket
from fastapi.exceptions import RequestValidationError, WebSocketRequestValidationError
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection
from starlette.responses import Response
from starlette.routing import Match

from paramclient.documents.problem import Problem
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
    NotDurable,
    NotInCache,
    PackError,
    ParamClientError,
    UnknownParameter,
    UnknownVehicle,
    UsageError,
    ValueNotApplied,
    VehicleError,
)

__all__ = ["RESPONSES", "ServiceError", "install_handlers", "problem_of", "problem_response"]

PROBLEM_MEDIA_TYPE: Final = "application/problem+json"
"""Media type of problems."""
FAULTS_MAX: Final = 20
"""Maximum number of listed errors of one request: a body of megabytes may have one in each member."""
MEMBER_NAME_LENGTH_MAX: Final = 200
"""Maximum number of characters of a member's name in an error."""

logger = logging.getLogger(__name__)


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


def problem_of(error: Exception) -> Problem:
    """Return an exception as a problem document.

    An unexpected exception is reported without details, which are logged.
    """
    if isinstance(error, ServiceError):
        return _problem(error.status, error.kind, str(error), error.members)
    if isinstance(error, ParamClientError):
        status, kind = next(found for known, found in _KINDS.items() if isinstance(error, known))
        members = {name: _json(value) for name, value in vars(error).items() if not name.startswith("_")}
        if isinstance(error, ValueNotApplied):
            members |= {"requested": _value_json(error.requested), "actual": _value_json(error.actual)}
        named = {"error": type(error).__name__, **{k: v for k, v in members.items() if k not in _TAKEN}}
        return _problem(status, kind or _hyphened(type(error).__name__), str(error), named)
    return _problem(500, "internal", "Internal error of the service. Its log has the details.", {})


def problem_response(problem: Problem, headers: Mapping[str, str] | None = None) -> Response:
    """Return the response with a problem document."""
    content = json.dumps(problem.as_json(), allow_nan=False)
    return Response(content, problem.status, headers=dict(headers or {}), media_type=PROBLEM_MEDIA_TYPE)


def install_handlers(app: FastAPI) -> None:
    """Replace the exception handlers of an application."""
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(WebSocketRequestValidationError, _invalid)
    app.add_exception_handler(HTTPException, _refused)
    app.add_exception_handler(ParamClientError, _failed)
    app.add_exception_handler(ServiceError, _failed)
    app.add_exception_handler(Exception, _failed)


RESPONSES: Final[dict[int | str, dict[str, Any]]] = {
    "default": {
        "model": Problem,
        "description": "A problem (RFC 9457)",
        "content": {PROBLEM_MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}},
    }
}
"""Errors that every route can return, for the OpenAPI document."""


async def _invalid(request: HTTPConnection, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError | WebSocketRequestValidationError)
    faults = [
        {"where": _where(fault.get("loc", ())), "what": str(fault.get("msg", ""))}
        for fault in error.errors()[:FAULTS_MAX]
    ]
    detail = "; ".join(f"{fault['where']}: {fault['what']}" for fault in faults)
    return await _answer(request, _problem(422, "invalid-request", detail, {"faults": faults}))


async def _refused(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    headers = error.headers
    if error.status_code == 405:
        headers = {"allow": ", ".join(_methods(request))}
        if request.method == "OPTIONS":
            return Response(status_code=204, headers=headers)
    kind, detail = _OF_HTTP.get(error.status_code, (None, error.detail))
    problem = _problem(error.status_code, kind or _hyphened(_phrase(error.status_code)), detail, {})
    return problem_response(problem, headers)


def _methods(request: Request) -> list[str]:
    """Return the methods of all routes with the path of a request: a 405 must name them (RFC 9110)."""
    routes = request.app.router.routes
    known = ["OPTIONS"]
    for method in ("DELETE", "GET", "PATCH", "POST", "PUT"):
        scope = {**request.scope, "method": method}
        if any(route.matches(scope)[0] is Match.FULL for route in routes):
            known += ["GET", "HEAD"] if method == "GET" else [method]
    return sorted(known)


async def _failed(request: HTTPConnection, error: Exception) -> Response:
    problem = problem_of(error)
    if problem.status == 500:
        logger.error("%s failed", request.url.path, exc_info=error)
    return await _answer(request, problem)


async def _answer(request: HTTPConnection, problem: Problem) -> Response:
    """Respond with a problem. A WebSocket that is not open yet is rejected with it."""
    response = problem_response(problem)
    if isinstance(request, WebSocket):
        await request.send_denial_response(response)
    return response


def _problem(status: int, kind: str, detail: str, members: Mapping[str, Any]) -> Problem:
    title = kind.replace("-", " ").capitalize()
    return Problem(type=f"urn:paramclient:{kind}", title=title, status=status, detail=detail, **members)


def _json(value: Any) -> Any:
    """Return an attribute of an exception as JSON: numbers and texts unchanged, types by name."""
    match value:
        case None | bool() | str():
            return value
        case int():
            return int(value)
        case float():
            return value if math.isfinite(value) else "NaN" if value != value else _infinity(value)
        case Mapping():
            return {str(key): _json(each) for key, each in value.items()}
        case Iterable():
            return [_json(each) for each in value]
        case _:
            return str(value)


def _value_json(value: int | float | str | bytes) -> Any:
    """Return the value of a parameter as JSON that distinguishes numbers, text and bytes."""
    match value:
        case str():
            return {"text": value}
        case bytes():
            return {"hex": value.hex()}
        case _:
            return _json(value)


def _infinity(value: float) -> str:
    return "Infinity" if value > 0 else "-Infinity"


def _where(place: Iterable[object]) -> str:
    return ".".join(str(part)[:MEMBER_NAME_LENGTH_MAX] for part in place) or "request"


def _hyphened(name: str) -> str:
    """Return `UnknownParameter` or `Not Found` as `unknown-parameter` or `not-found`."""
    return re.sub("[ -]*([A-Z])", r"-\1", name).strip("-").lower()


def _phrase(status: int) -> str:
    try:
        return HTTPStatus(status).phrase
    except ValueError:
        return "error"


_TAKEN: Final = frozenset({"type", "title", "status", "detail", "error"})
_OF_HTTP: Final = {
    404: ("not-found", "This path does not exist."),
    405: ("method-not-allowed", "This path does not support the method. The header Allow lists its methods."),
}
_KINDS: Final[dict[type[ParamClientError], tuple[int, str | None]]] = {
    UnknownParameter: (404, None),
    FileTransferError: (502, None),
    VehicleError: (409, None),
    NoReply: (504, None),
    ClientClosed: (503, "closing"),
    LinkError: (503, None),
    NotInCache: (404, "unknown-state"),
    NotDurable: (503, None),
    CacheError: (503, None),
    FileError: (422, None),
    InvalidParameters: (422, None),
    MetadataError: (422, None),
    PackError: (422, None),
    AlreadyRestored: (409, None),
    UnknownVehicle: (404, None),
    AmbiguousVehicle: (409, None),
    UsageError: (422, "usage"),
    ParamClientError: (500, None),
}
