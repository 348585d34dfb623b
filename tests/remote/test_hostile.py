"""A service that means harm, or is none: what it sends ends in an error of ours, and takes bounded memory."""

from __future__ import annotations

import asyncio
import contextlib
import gzip
import itertools
import json
import tracemalloc
import zlib
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
from typing import Any

import httpx
import pytest

from paramclient import ParamClient
from paramclient.errors import LinkError, ParamClientError
from paramclient.model.values import Param, ParamType, Trust
from paramclient.protocol.params.change import Change
from paramclient.remote import RemoteClient, bounded, http, mirror, roster
from paramclient.remote.bounded import (
    DOCUMENT_VALUES_MAX,
    EVENT_BYTES_MAX,
    JSON_NESTING_MAX,
    RESPONSE_BYTES_MAX,
    EventReader,
    checked_document,
    decoder_of,
)
from paramclient.remote.http import StreamPosition
from paramclient.remote.mirror import Mirror

RUN = "0123456789abcdef"
HELLO = json.dumps({"run": RUN, "seq": 0, "at": 0.0, "type": "hello", "resumed": False}).encode()
MEMORY = 256 << 20
"""Bytes that an answer within the bounds may take at most."""

Sent = Iterable[bytes] | Callable[[], AsyncIterator[bytes]]


def head(kind: str, *more: str, length: int | None = None) -> bytes:
    lines = ["HTTP/1.1 200 OK", f"Content-Type: {kind}", "Connection: close", *more]
    lines += [] if length is None else [f"Content-Length: {length}"]
    return "\r\n".join([*lines, "", ""]).encode()


def document(content: object, *more: str) -> list[bytes]:
    body = content if isinstance(content, bytes) else json.dumps(content).encode()
    return [head("application/json", *more, length=len(body)), body]


def stream(*events: bytes) -> list[bytes]:
    return [head("text/event-stream"), *(b"data: " + event + b"\n\n" for event in events)]


def component(**changed: Any) -> dict[str, Any]:
    """The document of a vehicle that a service returns."""
    numbers = ("system", "autopilot", "vehicle_type", "firmware", "board", "vendor_id", "product_id")
    identity = dict.fromkeys(numbers, 1) | {"capabilities": 0, "link": "a", "uid": None, "git_hash": ""}
    reported = {"link": "a", "system": 1, "component": 1, "identity": identity, "autopilot": "px4"}
    reported |= {"encoding": "bytewise", "encoding_reason": "", "count": 1, "hash": None, "state": "new"}
    reported |= {"sync_state": "unsynced", "is_armed": None, "silence_s": 0.0, "round_trip_s": None}
    return reported | {"last_fetch": None} | changed


def components(*reported: object) -> list[bytes]:
    return document({"run": RUN, "seq": 0, "components": list(reported)})


GOOD: dict[str, Sent] = {
    "/events": stream(HELLO),
    "/links": document({"links": []}),
    "/me": document({"author": "local"}),
    "/components": components(component()),
}


async def forever(pieces: Iterable[bytes], pause: float = 0.0) -> AsyncIterator[bytes]:
    for piece in itertools.cycle(pieces):
        yield piece
        await asyncio.sleep(pause)


@contextlib.asynccontextmanager
async def hostile(answers: dict[str, Sent]) -> AsyncIterator[str]:
    """A server with these answers by path; a stream of events stays open after what it sends."""
    given = GOOD | answers
    writers: list[asyncio.StreamWriter] = []

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writers.append(writer)
        with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            first = (await reader.readuntil(b"\r\n\r\n")).split(b"\r\n")[0]
            path = first.split()[1].decode().removeprefix("/api/v1").partition("?")[0]
            sent = given.get(path, document({}))
            pieces = sent() if callable(sent) else _each(sent)
            async for piece in pieces:
                writer.write(piece)
                await writer.drain()
            if path == "/events":
                await reader.read()
        writer.close()

    server = await asyncio.start_server(answer, "127.0.0.1", 0)
    try:
        yield f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}"
    finally:
        server.close()
        for writer in writers:
            writer.transport.abort()
        await asyncio.sleep(0)


async def _each(pieces: Iterable[bytes]) -> AsyncIterator[bytes]:
    for piece in pieces:
        yield piece


async def opened(
    answers: dict[str, Sent], call: Callable[[ParamClient], Awaitable[object]] | None = None
) -> None:
    async with hostile(answers) as url, ParamClient(url) as client:
        if call is not None:
            await call(client)


def answers_with(
    begin: bytes, pieces: Iterable[bytes], pause: float = 0.0
) -> Callable[[], AsyncIterator[bytes]]:
    """An answer that begins like this and never ends."""

    async def sent() -> AsyncIterator[bytes]:
        yield begin
        async for piece in forever(pieces, pause):
            yield piece

    return sent


REDIRECT = [b"HTTP/1.1 307 Away\r\nLocation: /api/v1/events\r\nContent-Length: 0\r\n\r\n"]
DEEP = b"[" * 100_000
WIDE = b"[" + b"[]," * DOCUMENT_VALUES_MAX + b"1]"
EVENTS = head("text/event-stream")
JSON = head("application/json")
BOMB = gzip.compress(b" " * (RESPONSE_BYTES_MAX + (1 << 20)))
HUGE = b'{"links": ' + b"9" * 5_000 + b"}"
REFUSED = {"error": "Refused", "detail": "x", "system": 1, "component": 1}


@pytest.mark.asyncio
@pytest.mark.parametrize(
    ("path", "sent", "words"),
    [
        ("/events", answers_with(EVENTS, [b"x" * 65_536]), "not as a service"),
        ("/events", answers_with(EVENTS, [b"data: " + b"x" * 60_000 + b"\n"]), "not as a service"),
        ("/events", stream(DEEP), "not as a service"),
        (
            "/events",
            stream(b"[" * (JSON_NESTING_MAX + 1) + b"]" * (JSON_NESTING_MAX + 1)),
            "not as a service",
        ),
        ("/events", stream(WIDE[:EVENT_BYTES_MAX]), "not as a service"),
        ("/events", stream(b"\xff\xfe"), "not as a service"),
        ("/events", stream(HUGE), "not as a service"),
        (
            "/events",
            stream(b'{"run": 1, "seq": 1e999, "type": "hello"}'),
            "document of the service is not valid",
        ),
        ("/events", [head("text/event-stream", "Content-Encoding: gzip"), BOMB], "not as a service"),
        ("/events", answers_with(EVENTS, [b": \n\n"], 0.02), "sends no more events"),
        ("/events", answers_with(EVENTS, [b":"], 0.02), "sends no more events"),
        ("/events", answers_with(b"HTTP/1.1 200 OK\r\n", [b"X: y\r\n" * 1_000]), "too long|too large|many"),
        ("/events", answers_with(b"HTTP/1.1 200 OK\r\nX: ", [b"y" * 65_536]), "too long|too large|many"),
        ("/events", REDIRECT, "not as a service"),
        (
            "/links",
            [b"HTTP/1.1 307 Away\r\nLocation: /api/v1/links\r\nContent-Length: 0\r\n\r\n"],
            "not as a",
        ),
        ("/links", document(DEEP), "not as a service"),
        ("/links", document(WIDE), "not as a service"),
        ("/links", document(HUGE), "not as a service"),
        ("/links", document(BOMB, "Content-Encoding: gzip"), "a response of more than"),
        ("/links", document(b"no gzip", "Content-Encoding: gzip"), "not as a service"),
        ("/links", document(b"{}", "Content-Encoding: br"), "not as a service"),
        ("/links", answers_with(JSON, [b" " * 65_536]), "a response of more than"),
        ("/links", answers_with(JSON, [b" "], 0.02), "response is too slow"),
        (
            "/links",
            document({"links": [{"name": "a", "stats": {"bytes_sent": []}}]}),
            "document of the service is not valid",
        ),
        ("/links", document([]), "document of the service is not valid"),
        ("/components", document([]), "document of the service is not valid"),
        ("/components", document({"run": RUN, "seq": 0}), "document of the service is not valid"),
        (
            "/components",
            components(*(component(link=str(n)) for n in range(5_000))),
            "document of the service is not valid",
        ),
        ("/components", components(component(count="many")), "document of the service is not valid"),
        ("/components", components(component(silence_s=[])), "document of the service is not valid"),
        ("/components", components(component(hash="z")), "document of the service is not valid"),
        ("/components", components(component(identity={})), "document of the service is not valid"),
        ("/components", components(component(last_fetch=5)), "document of the service is not valid"),
    ],
)
async def test_opening_a_client_of_a_hostile_service_raises_link_error(
    path: str, sent: Sent, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(http, "HELLO_TIMEOUT", 0.3)
    monkeypatch.setattr(bounded, "RESPONSE_TIMEOUT", 0.3)
    with pytest.raises(LinkError, match=words):
        await asyncio.wait_for(opened({path: sent}), 30)


@pytest.mark.asyncio
@pytest.mark.parametrize(
    "problem",
    [
        {"type": "urn:paramclient:ambiguous", "detail": {"a": [1] * 1_000}},
        {**REFUSED, "code": float("inf")},
        {**REFUSED, "code": []},
        {"error": "InvalidParameters", "problems": 5},
        {"error": "AmbiguousVehicle", "vehicles": None, "summary": "", "choose_by": ""},
        {
            "error": "ValueNotApplied",
            "system": 1,
            "component": 1,
            "name": "A",
            "requested": "x",
            "actual": {},
        },
        {"error": ["NoReply"]},
        {"detail": "x" * 1_000_000},
        {},
        [],
    ],
)
async def test_an_error_that_the_service_reports_is_one_of_ours(problem: object) -> None:
    body = json.dumps(problem).encode()
    refuse = [b"HTTP/1.1 409 No\r\nContent-Type: application/problem+json\r\nConnection: close\r\n\r\n", body]
    with pytest.raises(ParamClientError) as caught:
        await asyncio.wait_for(opened({"/find": refuse}, lambda client: client.component(timeout=5)), 30)
    assert len(str(caught.value)) < 20_000


@pytest.mark.asyncio
async def test_invalid_responses_to_background_loads_end_no_program() -> None:
    """Tables are loaded beside the program; errors are raised by the calls that need them."""
    refuse = [b"HTTP/1.1 401 No\r\nContent-Type: application/problem+json\r\nContent-Length: 2\r\n\r\n{}"]
    async with hostile({"/components/1/1/params": refuse}) as url, ParamClient(url) as client:
        await asyncio.sleep(0.2)
        assert list(client.components) == [(1, 1)]
        with pytest.raises(LinkError, match="document of the service is not valid"):
            await client.component(timeout=1)


@pytest.mark.asyncio
@pytest.mark.parametrize("changed", [{"name": {}}, {"name": None}, {"bits": []}, {"index": "x"}, {"type": 5}])
async def test_a_parameter_that_is_none_is_an_error(changed: dict[str, object]) -> None:
    reported = {"name": "A", "value": 1, "type": "INT32", "index": 0, "bits": "1", "trust": "live"}
    answers = {"/components/1/1/read": document(reported | changed), "/find": document(component())}
    answers["/components/1/1/params"] = document({"run": RUN, "seq": 0, "params": {}})

    async def read(client: ParamClient) -> None:
        await (await client.component(timeout=5)).get("A", timeout=5)

    with pytest.raises(LinkError, match="document of the service is not valid"):
        await opened(dict(answers), read)


class Open(httpx.AsyncByteStream):
    """Events that have no end."""

    async def __aiter__(self) -> AsyncIterator[bytes]:
        yield b"data: " + HELLO + b"\n\n"
        await asyncio.sleep(60)


@pytest.mark.asyncio
async def test_a_transport_may_have_read_the_answer() -> None:
    """As those for tests do."""

    def answer(request: httpx.Request) -> httpx.Response:
        if request.url.path.endswith("/events"):
            return httpx.Response(200, headers={"Content-Type": "text/event-stream"}, stream=Open())
        reported = {
            "links": [],
            "run": RUN,
            "seq": 0,
            "components": [component()],
            "author": "local",
            "params": {},
        }
        return httpx.Response(200, json=reported)

    async with RemoteClient("http://127.0.0.1:1", transport=httpx.MockTransport(answer)) as client:
        assert list(client.components) == [(1, 1)]


@pytest.mark.asyncio
async def test_memory_stays_bounded() -> None:
    """The documents that take most of it: within the bounds of bytes, and beyond those of values."""
    for sent in (
        document(WIDE),
        answers_with(JSON, [b"[]," * 20_000]),
        document(BOMB, "Content-Encoding: gzip"),
    ):
        tracemalloc.start()
        with pytest.raises(LinkError):
            await opened({"/links": sent})
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < MEMORY


def test_the_largest_document_within_the_bounds() -> None:
    assert (
        len(checked_document(b"[" + b'{"a":1},' * (DOCUMENT_VALUES_MAX // 2 - 1) + b"1]"))
        == DOCUMENT_VALUES_MAX // 2
    )
    with pytest.raises(ValueError, match="more than"):
        checked_document(b"[" + b"1," * DOCUMENT_VALUES_MAX + b"1]")


def test_depth() -> None:
    for opening, closing in ((b"[", b"]"), (b'{"a":', b"}")):
        deepest = opening * (JSON_NESTING_MAX - 1) + b"[]" + closing * (JSON_NESTING_MAX - 1)
        assert checked_document(deepest)
        for depth in (JSON_NESTING_MAX, 10 * JSON_NESTING_MAX, 100_000):
            with pytest.raises(ValueError, match="deeper than"):
                checked_document(opening * depth + b"[]" + closing * depth)


def test_an_event_received_byte_by_byte_costs_no_more_than_one_at_once() -> None:
    """Each piece is looked at once, however long the line is to which it belongs."""
    reader = EventReader()
    for _ in range(EVENT_BYTES_MAX // 8):
        reader.receive(b"x")
    assert reader.receive(b"\n\n") == []
    assert reader.size == 0


def test_an_event_of_many_lines_is_bounded() -> None:
    reader = EventReader()
    reader.receive(b"data: 1\n" * (EVENT_BYTES_MAX // 8))
    with pytest.raises(ValueError, match="an event of more than"):
        reader.receive(b"data: 1\n")


@pytest.mark.parametrize("encoding", ["gzip", "deflate"])
def test_encodings_that_are_requested_are_decoded(encoding: str) -> None:
    data = bytes(range(256)) * 1_000
    packed = gzip.compress(data) if encoding == "gzip" else zlib.compress(data)
    decode = decoder_of(encoding)
    assert b"".join(decode(packed[at : at + 100], 1 << 20) for at in range(0, len(packed), 100)) == data
    assert len(decoder_of(encoding)(packed, 1_000)) == 1_001


@pytest.mark.parametrize("text", ["", "5", f"{RUN}-", f"{RUN}-x", f"{RUN}-{'9' * 5_000}", "x" * 90 + "-1"])
def test_an_invalid_stream_position_is_ignored(text: str) -> None:
    assert StreamPosition.read(text) is None


def test_a_table_grows_no_further_than_that_of_a_service(monkeypatch: pytest.MonkeyPatch) -> None:
    def param(number: int) -> Param:
        return Param(f"P{number}", 1, ParamType.INT32, 0, 1, Trust.LIVE)

    monkeypatch.setattr(mirror, "NAMES_MAX", 3)
    table = Mirror()
    table.begin()
    with pytest.raises(ValueError, match="names"):
        table.load(0, {f"P{number}": param(number) for number in range(4)})
    table.begin()
    table.load(0, {f"P{number}": param(number) for number in range(3)})
    with pytest.raises(ValueError, match="names"):
        table.take(1, Change("P9", None, param(9), "vehicle"))
    assert len(table.params) == 3


@pytest.mark.asyncio
async def test_components_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(roster, "SERVICE_COMPONENTS_MAX", 2)
    events = [HELLO]
    for number in range(1, 6):
        reported = {"run": RUN, "seq": number, "at": 0.0, "type": "component", "why": "discovered"}
        reported |= {"link": "a", "system": number, "component": 1, "component_doc": component(system=number)}
        events.append(json.dumps(reported).encode())
    async with hostile({"/events": stream(*events)}) as url:
        with contextlib.suppress(LinkError):
            async with ParamClient(url) as client:
                assert len(client.components) <= 2
