"""Every error as a problem document of RFC 9457: the library's, FastAPI's, and our own."""

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
    VehicleError,
)

__all__ = ["RESPONSES", "ServiceError", "install", "problem_of", "problem_response"]

MEDIA_TYPE: Final = "application/problem+json"
MOST_FAULTS: Final = 20
"""Faults of one request that are named: a body of megabytes may have one in each member."""
LONGEST_TEXT: Final = 200
"""Characters of a member's name that are repeated."""

logger = logging.getLogger(__name__)


class ServiceError(Exception):
    """What the service itself cannot do.

    Args:
        status: HTTP's number for it.
        kind: its name, for programs.
        detail: a sentence.
        members: what else is known.
    """

    def __init__(self, status: int, kind: str, detail: str, **members: Any) -> None:
        super().__init__(detail)
        self.status = status
        self.kind = kind
        self.members = members


def problem_of(error: Exception) -> Problem:
    """An exception as a document.

    Of one that is not on purpose nothing is told but that it happened.
    """
    if isinstance(error, ServiceError):
        return _problem(error.status, error.kind, str(error), error.members)
    if isinstance(error, ParamClientError):
        status, kind = next(found for known, found in _KINDS.items() if isinstance(error, known))
        members = {name: _json(value) for name, value in vars(error).items() if not name.startswith("_")}
        named = {"error": type(error).__name__, **{k: v for k, v in members.items() if k not in _TAKEN}}
        return _problem(status, kind or _hyphened(type(error).__name__), str(error), named)
    return _problem(500, "internal", "The service has failed at this; its log says more.", {})


def problem_response(problem: Problem, headers: Mapping[str, str] | None = None) -> Response:
    """A document as an answer."""
    content = json.dumps(problem.as_json(), allow_nan=False)
    return Response(content, problem.status, headers=dict(headers or {}), media_type=MEDIA_TYPE)


def install(app: FastAPI) -> None:
    """Let an application answer with nothing else, in place of its own handlers."""
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
        "content": {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}},
    }
}
"""What every route may answer besides, for the document of the API."""


async def _invalid(request: HTTPConnection, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError | WebSocketRequestValidationError)
    faults = [
        {"where": _where(fault.get("loc", ())), "what": str(fault.get("msg", ""))}
        for fault in error.errors()[:MOST_FAULTS]
    ]
    told = "; ".join(f"{fault['where']}: {fault['what']}" for fault in faults)
    return await _answer(request, _problem(422, "invalid-request", told, {"faults": faults}))


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
    """What the address of a request knows, of all routes that lead there: a 405 has to say it (RFC 9110)."""
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
    """Answer with a problem; a WebSocket that is not open yet is refused with it."""
    response = problem_response(problem)
    if isinstance(request, WebSocket):
        await request.send_denial_response(response)
    return response


def _problem(status: int, kind: str, detail: str, members: Mapping[str, Any]) -> Problem:
    title = kind.replace("-", " ").capitalize()
    return Problem(type=f"urn:paramclient:{kind}", title=title, status=status, detail=detail, **members)


def _json(value: Any) -> Any:
    """What an exception knows as JSON: numbers and words stay, a type by its name, bytes as digits."""
    match value:
        case None | bool() | str():
            return value
        case int():
            return int(value)
        case float():
            return value if math.isfinite(value) else "NaN" if value != value else _infinity(value)
        case bytes():
            return f"0x{int.from_bytes(value, 'little'):08x}"
        case Mapping():
            return {str(key): _json(each) for key, each in value.items()}
        case Iterable():
            return [_json(each) for each in value]
        case _:
            return str(value)


def _infinity(value: float) -> str:
    return "Infinity" if value > 0 else "-Infinity"


def _where(place: Iterable[object]) -> str:
    return ".".join(str(part)[:LONGEST_TEXT] for part in place) or "request"


def _hyphened(name: str) -> str:
    """`UnknownParameter`, and `Not Found`, as `unknown-parameter` and `not-found`."""
    return re.sub("[ -]*([A-Z])", r"-\1", name).strip("-").lower()


def _phrase(status: int) -> str:
    try:
        return HTTPStatus(status).phrase
    except ValueError:
        return "error"


_TAKEN: Final = frozenset({"type", "title", "status", "detail", "error"})
_OF_HTTP: Final = {
    404: ("not-found", "There is nothing at this address."),
    405: ("method-not-allowed", "This address knows other methods only."),
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
    UnknownVehicle: (404, None),
    AmbiguousVehicle: (409, None),
    UsageError: (422, "usage"),
    ParamClientError: (500, None),
}
