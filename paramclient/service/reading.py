"""JSON bodies of requests: their limits, parsed and validated in a worker thread where they are long.

No call into C that holds the interpreter takes as many bytes as somebody likes: the JSON parser gets a body
whose members were counted, pydantic parts of a long object, one after the other.
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
from paramclient.service.problems import MOST_FAULTS, ServiceError

if TYPE_CHECKING:
    from paramclient.service.hub import Hub

__all__ = ["MOST_PIECES", "SHORT_BODY", "BodyRoute", "check_lines", "check_pieces", "long_request"]

SHORT_BODY: Final = 4096
"""Bytes of a body that is parsed at once: that takes less time than to hand it to a thread."""
MOST_PIECES: Final = 60_000
"""Commas, opening brackets and line ends of a body or a file: no more values, members and lines can be in it.
A file of eight thousand parameters in JSON, the longest of the forms, has 56,000."""
LONGEST_NUMBER: Final = 128
"""Digits in a row in a JSON body. To read 4,300 takes 0.6 ms, in which no other thread runs."""
LONGEST_LINE: Final = 16_384
"""Bytes of a line of a file that is no JSON: each is searched for comments as a whole."""


class BodyRoute(APIRoute):
    """A route that has its body, the argument `body`, as an object when FastAPI sees it."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        answer = super().get_route_handler()
        model = get_type_hints(self.endpoint).get("body")
        if model is None:
            return answer
        assert issubclass(model, Body), "bodies limit what pydantic tells of them"

        async def handle(request: Request) -> Response:
            kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
            data = await request.body()
            if not data or kind != "application/json":
                return await answer(request)
            if len(data) <= SHORT_BODY:
                return await answer(_Read(request, data, _object(model, data)))
            hub: Hub = request.app.state.hub
            with long_request(request):
                given = await hub.read_aside(lambda: _object(model, data))
                return await answer(_Read(request, data, given))

        return handle


@contextmanager
def long_request(request: Request) -> Iterator[None]:
    """Count a request among those that take long; once, however often it is said of it.

    Raises:
        ServiceError: 429, too many are under way.
    """
    state = request.scope["state"]
    if state.get("is_long"):
        yield
        return
    hub: Hub = request.app.state.hub
    with hub.long_requests.hold(state["quota"]):
        state["is_long"] = True
        yield


def check_pieces(data: bytes) -> None:
    """See that not too many values can be in JSON, or lines in a file, before it is parsed.

    Raises:
        ServiceError: 413, there are.
    """
    line_ends = max(data.count(b"\n"), data.count(b"\r"))
    if line_ends + sum(map(data.count, (b",", b"{", b"["))) > MOST_PIECES:
        what = f"A body or a file may have {MOST_PIECES:,} commas, opening brackets and line ends, not more."
        raise ServiceError(413, "too-large", what, most=MOST_PIECES)


def check_lines(data: bytes) -> None:
    """See that a file has no line that takes long by itself.

    Raises:
        ServiceError: 413, it has.
    """
    if _has_run(data, _IN_LINES, LONGEST_LINE):
        what = f"A line of a file has at most {LONGEST_LINE:,} bytes, unless the file is JSON."
        raise ServiceError(413, "too-large", what, most=LONGEST_LINE)


def _check_numbers(data: bytes) -> None:
    if _has_run(data, _DIGITS, LONGEST_NUMBER):
        what = f"A body has at most {LONGEST_NUMBER} digits in a row."
        raise ServiceError(413, "too-large", what, most=LONGEST_NUMBER)


def _has_run(data: bytes, kinds: bytes, most: int) -> bool:
    """Whether more than so many bytes of a kind follow each other; in a time that grows with the length."""
    return b"x" * (most + 1) in data.translate(kinds)


class _Read(Request):
    """A request whose body was read, parsed and validated."""

    def __init__(self, request: Request, data: bytes, given: Body) -> None:
        super().__init__(request.scope, request.receive)
        self._data = data
        self._given = given

    async def body(self) -> bytes:
        return self._data

    async def json(self) -> Any:
        return self._given


def _object(model: type[Body], data: bytes) -> Body:
    """What a body says.

    Raises:
        RequestValidationError: it is no JSON, or not what the request needs.
        ServiceError: it is too large, or cannot be parsed.
    """
    check_pieces(data)
    _check_numbers(data)
    try:
        content = json.loads(data)
    except json.JSONDecodeError as error:
        fault = {"loc": ("body", error.pos), "type": "json_invalid", "msg": "JSON decode error"}
        raise RequestValidationError([fault]) from None
    except (ValueError, RecursionError):  # no UTF-8, or a number with thousands of digits
        raise ServiceError(400, "bad-request", "The body is no JSON that can be parsed.") from None
    try:
        return model.model_validate(content)
    except ValidationError as error:
        found = error.errors(include_url=False, include_context=False, include_input=False)[:MOST_FAULTS]
        faults = [{**fault, "loc": ("body", *fault["loc"])} for fault in found]
    raise RequestValidationError(faults)


_DIGITS: Final = bytes(ord("x") if chr(each).isdecimal() and each < 128 else 0 for each in range(256))
_IN_LINES: Final = bytes(0 if each in b"\r\n" else ord("x") for each in range(256))
