"""JSON bodies of requests: size limits, and parsing and validation in a worker thread if they are long.

No C function that holds the GIL receives a body of any size: the JSON parser gets a body with a limited
number of separators, and pydantic validates the parts of a long object one by one.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final, get_type_hints

from fastapi import Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.routing import APIRoute
from pydantic import ValidationError

from paramclient.documents.document import Body
from paramclient.service.body_limits import DIGITS_MAX, LINE_BYTES_MAX, SEPARATORS_MAX, SHORT_BODY_BYTES_MAX
from paramclient.service.problems import FAULTS_MAX, ServiceError

if TYPE_CHECKING:
    from paramclient.service.hub import Hub

__all__ = [
    "BodyRoute",
    "check_line_lengths",
    "check_separators",
    "long_request",
]


class BodyRoute(APIRoute):
    """A route that parses its argument `body` before FastAPI validates it."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        answer = super().get_route_handler()
        model = get_type_hints(self.endpoint).get("body")
        if model is None:
            return answer
        assert issubclass(model, Body), "a Body limits the errors of pydantic"

        async def handle(request: Request) -> Response:
            kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
            data = await request.body()
            if not data or kind != "application/json":
                return await answer(request)
            if len(data) <= SHORT_BODY_BYTES_MAX:
                return await answer(_ParsedRequest(request, data, _parse_body(model, data)))
            hub: Hub = request.app.state.hub
            with long_request(request):
                given = await hub.run_in_file_thread(lambda: _parse_body(model, data))
                return await answer(_ParsedRequest(request, data, given))

        return handle


@contextmanager
def long_request(request: Request) -> Iterator[None]:
    """Count a request in the quota of long requests within the block. Nested calls count once.

    Raises:
        ServiceError: 429, the quota is exceeded.
    """
    state = request.scope["state"]
    if state.get("is_long"):
        yield
        return
    hub: Hub = request.app.state.hub
    with hub.long_requests.hold(state["quota"]):
        state["is_long"] = True
        yield


def check_separators(data: bytes) -> None:
    """Check the number of separators of JSON or of a file before it is parsed.

    Raises:
        ServiceError: 413, there are more than `SEPARATORS_MAX`.
    """
    line_ends = max(data.count(b"\n"), data.count(b"\r"))
    if line_ends + sum(map(data.count, (b",", b"{", b"["))) > SEPARATORS_MAX:
        what = f"A body or file may have at most {SEPARATORS_MAX:,} commas, opening brackets and line ends."
        raise ServiceError(413, "too-large", what, most=SEPARATORS_MAX)


def check_line_lengths(data: bytes) -> None:
    """Check the length of the lines of a file.

    Raises:
        ServiceError: 413, a line has more than `LINE_BYTES_MAX`.
    """
    if _has_long_run(data, _IN_LINES, LINE_BYTES_MAX):
        what = f"A line of a file that is not JSON may have at most {LINE_BYTES_MAX:,} bytes."
        raise ServiceError(413, "too-large", what, most=LINE_BYTES_MAX)


def _check_numbers(data: bytes) -> None:
    if _has_long_run(data, _DIGITS, DIGITS_MAX):
        what = f"A body may have at most {DIGITS_MAX} consecutive digits."
        raise ServiceError(413, "too-large", what, most=DIGITS_MAX)


def _has_long_run(data: bytes, kinds: bytes, most: int) -> bool:
    """Return whether more than `most` bytes of a class are consecutive, in linear time."""
    return b"x" * (most + 1) in data.translate(kinds)


class _ParsedRequest(Request):
    """A request whose body is already received, parsed and validated."""

    def __init__(self, request: Request, data: bytes, given: Body) -> None:
        super().__init__(request.scope, request.receive)
        self._data = data
        self._given = given

    async def body(self) -> bytes:
        return self._data

    async def json(self) -> Any:
        return self._given


def _parse_body(model: type[Body], data: bytes) -> Body:
    """Parse and validate a body.

    Raises:
        RequestValidationError: the body is not JSON, or not valid for the request.
        ServiceError: the body exceeds a limit, or cannot be parsed.
    """
    check_separators(data)
    _check_numbers(data)
    try:
        content = json.loads(data)
    except json.JSONDecodeError as error:
        fault = {"loc": ("body", error.pos), "type": "json_invalid", "msg": "JSON decode error"}
        raise RequestValidationError([fault]) from None
    except (ValueError, RecursionError):  # not UTF-8, or a number with thousands of digits
        raise ServiceError(400, "bad-request", "The body is not JSON that can be parsed.") from None
    try:
        return model.model_validate(content)
    except ValidationError as error:
        found = error.errors(include_url=False, include_context=False, include_input=False)[:FAULTS_MAX]
        faults = [{**fault, "loc": ("body", *fault["loc"])} for fault in found]
    raise RequestValidationError(faults)


_DIGITS: Final = bytes(ord("x") if chr(each).isdecimal() and each < 128 else 0 for each in range(256))
_IN_LINES: Final = bytes(0 if each in b"\r\n" else ord("x") for each in range(256))
