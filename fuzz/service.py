"""Fuzz target: a client of a hostile service, whose events and responses are changed at random.

The client raises only errors of the library, and ends. The event loop has simulated time, so that backoffs
take no time.
"""

from __future__ import annotations

import asyncio
import json
import logging
import selectors
from collections.abc import AsyncIterator
from contextlib import suppress
from copy import deepcopy
from typing import Any, Final

import httpx

from fuzz.draw import Draw
from paramclient.errors import ParamClientError, UsageError
from paramclient.remote import RemoteClient

__all__ = ["INPUT_SIZE_MAX", "run"]

INPUT_SIZE_MAX: Final = 256
"""Maximum bytes of an input: a few dozen changes."""

RUN: Final = "0123456789abcdef"
IDENTITY: Final = {
    "system": 1,
    "link": "a",
    "uid": "5eed",
    "autopilot": 12,
    "vehicle_type": 2,
    "firmware": 1,
    "git_hash": "ab",
    "board": 1,
    "vendor_id": 1,
    "product_id": 1,
    "capabilities": 8208,
}
COMPONENT: Final = {
    "link": "a",
    "link_state": "open",
    "system": 1,
    "component": 1,
    "autopilot": "px4",
    "vehicle_type": 2,
    "key": "k",
    "identity": IDENTITY,
    "encoding": "bytewise",
    "encoding_reason": "x",
    "count": 2,
    "params": 2,
    "hash": "cf579589",
    "state": "live",
    "sync_state": "synced",
    "is_armed": False,
    "is_lost": False,
    "silence_s": 0.0,
    "round_trip_s": 0.01,
    "fetch": None,
    "last_fetch": {"source": "ftp", "elapsed_s": 1.0},
    "extended": {"is_spoken": True, "is_expected": True, "is_complete": True, "count": 1, "params": 1},
}
EXT_PARAM: Final = {
    "name": "A",
    "value": "text",
    "type": "CUSTOM",
    "index": 0,
    "hex": "74657874",
    "trust": "live",
    "heard_at": 1.0,
}
EXT_RESULT: Final = {
    "link": "a",
    "system": 1,
    "component": 1,
    "source": "stream",
    "count": 1,
    "received": 1,
    "missing": [],
    "elapsed_s": 0.0,
    "notes": [],
}
EXT_SET: Final = {
    "name": "A",
    "status": "accepted",
    "requested": "text",
    "actual": "text",
    "attempts": 1,
    "param": EXT_PARAM,
}
PARAM: Final = {
    "name": "A",
    "value": 1.0,
    "type": "REAL32",
    "index": 0,
    "bits": "3f800000",
    "trust": "live",
    "heard_at": 1.0,
    "default": 1.0,
}
RESULT: Final = {
    "link": "a",
    "system": 1,
    "component": 1,
    "source": "stream",
    "count": 1,
    "received": 1,
    "missing": [],
    "hash": None,
    "elapsed_s": 0.0,
    "notes": [],
    "resumed": 0,
    "lost": 0,
    "repeated": 0,
    "round_trip_s": 0.0,
    "sample": None,
}
STATS: Final = dict.fromkeys(
    (
        *("bytes_received", "bytes_sent", "frames_received", "frames_sent", "skipped", "damaged", "lost"),
        *("unusable_names", "repeated", "reads", "writes", "retries", "downloads", "cache_hits"),
    ),
    1,
) | {"round_trips": {"1/1": 0.1}}
SILENT: Final = {"link": "a", "system": 2, "component": 1, "problem": {"status": 504, "error": "NoReply"}}
SET: Final = {
    "name": "A",
    "status": "accepted",
    "requested": 3.0,
    "actual": 3.0,
    "attempts": 1,
    "param": PARAM,
}
ANSWERS: Final[dict[str, Any]] = {
    "GET /links": {"links": [{"name": "a", "state": "open", "listens_only": False, "stats": STATS}]},
    "GET /me": {"name": "local", "author": "local", "role": "write", "read_only": False},
    "GET /components": {"run": RUN, "seq": 0, "components": [COMPONENT]},
    "GET /components/1/1/params": {"run": RUN, "seq": 0, "params": {"A": PARAM}},
    "POST /find": COMPONENT,
    "POST /components/1/1/fetch": RESULT,
    "POST /components/1/1/read": PARAM,
    "PATCH /components/1/1/params": {"results": {"A": SET}},
    "GET /components/1/1/extended/params": {"run": RUN, "seq": 0, "params": {"A": EXT_PARAM}},
    "POST /components/1/1/extended/fetch": EXT_RESULT,
    "POST /components/1/1/extended/read": EXT_PARAM,
    "PATCH /components/1/1/extended/params": {"results": {"A": EXT_SET}},
    "POST /fetch": {"results": [RESULT], "silent": [SILENT]},
}
ABOUT: Final = {"run": RUN, "at": 1.0, "link": "a", "system": 1, "component": 1}
PROGRESS: Final = {"received": 1, "total": 2, "rate": 1.0, "seconds_left": 1.0, "done": False}
EVENTS: Final[tuple[dict[str, Any], ...]] = (
    {"run": RUN, "seq": 0, "at": 1.0, "type": "hello", "resumed": False},
    {**ABOUT, "seq": 1, "type": "component", "why": "discovered", "component_doc": COMPONENT},
    {**ABOUT, "seq": 2, "type": "change", "name": "A", "old": PARAM, "new": PARAM, "by": "us for local"},
    {**ABOUT, "seq": 3, "type": "component", "why": "lost", "silence_s": 5.0, "component_doc": COMPONENT},
    {**ABOUT, "seq": 4, "type": "component", "why": "found", "silence_s": 5.0, "component_doc": COMPONENT},
    {**ABOUT, "seq": 5, "type": "component", "why": "rebooted", "component_doc": COMPONENT},
    {**ABOUT, "seq": 6, "type": "resynced", "changed": ["A"], "hash": "cf579589"},
    {
        **ABOUT,
        "seq": 7,
        "type": "progress",
        "received": 1,
        "total": 2,
        "rate": 1.0,
        "seconds_left": 1.0,
        "done": False,
    },
    {**ABOUT, "seq": 8, "type": "params"},
    {**ABOUT, "seq": 9, "type": "link", "state": "open"},
    {**ABOUT, "seq": 10, "type": "extended_change", "name": "A", "old": None, "new": EXT_PARAM, "by": "us"},
    {**ABOUT, "seq": 11, "type": "extended_progress", **PROGRESS},
    {**ABOUT, "seq": 12, "type": "extended_params"},
    {**ABOUT, "seq": 13, "type": "gap", "missed": 3},
    {**ABOUT, "seq": 14, "type": "component", "why": "forgotten", "component_doc": COMPONENT},
)
ODD: Final[tuple[Any, ...]] = (
    *(None, True, False, 0, -1, 1, 255, 256, 1 << 64, 0.5, float("inf"), float("nan"), "", "A", "0x7f", "zz"),
    *(
        "NaN",
        [],
        {},
        [[]],
        {"A": {}},
        "REAL32",
        "INT8",
        "TYPE_99",
        "live",
        "px4",
        "9" * 400,
        "\x1b[2J",
        1e308,
    ),
)
STATES: Final = (200, 200, 200, 204, 301, 400, 401, 404, 409, 429, 500, 503)
KINDS: Final = ("application/json", "application/json", "application/problem+json", "text/html", "")


def run(data: bytes) -> None:
    """Run a session: the first byte is the number of events; if odd, the stream is the rest of the input."""
    draw = Draw(data)
    how = draw.number()
    logging.disable()
    try:
        with asyncio.Runner(loop_factory=_LeapingLoop) as runner:
            runner.run(_session(draw, how))
    finally:
        logging.disable(logging.NOTSET)


async def _session(draw: Draw, how: int) -> None:
    transport = _Hostile(draw, how)
    try:
        async with RemoteClient("http://127.0.0.1:1", transport=transport) as client:
            await _use(client)
    except ParamClientError:
        pass


async def _use(client: RemoteClient) -> None:
    try:
        vehicle = await client.component(timeout=5)
    except ParamClientError:
        return
    for call in (
        lambda: vehicle.fetch_all(timeout=5),
        lambda: vehicle.get("A", timeout=5),
        lambda: vehicle.set("A", 3.0, timeout=5),
        lambda: client.fetch_all(timeout=5),
        lambda: vehicle.ext.fetch_all(timeout=5),
        lambda: vehicle.ext.get("A", timeout=5),
        lambda: vehicle.ext.set("A", "text", timeout=5),
    ):
        try:
            await call()
        except ParamClientError:
            continue
    names = ("identity", "encoding", "encoding_reason", "count", "hash", "state", "sync_state", "is_armed")
    for component in client.components.values():
        for name in (*names, "silence", "round_trip", "is_autopilot"):
            getattr(component, name)
        repr((component, dict(component.params)))
        with suppress(UsageError):  # the service looks like one of an earlier version
            ext = component.ext
            repr((ext, dict(ext.params), ext.is_spoken, ext.is_expected))
    repr((client, client.stats, client.autopilots))


class _Hostile(httpx.AsyncBaseTransport):
    """A transport that answers with changed documents."""

    def __init__(self, draw: Draw, how: int) -> None:
        self._draw = draw
        self._how = how
        self._left = 40  # number of responses, so that every session ends

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        path = request.url.path.removeprefix("/api/v1")
        self._left -= 1
        if self._left < 0:
            raise httpx.ConnectError("it has had enough")
        draw = self._draw
        if path == "/events":
            return httpx.Response(
                200, headers={"Content-Type": "text/event-stream"}, stream=_Stream(self._events())
            )
        document = _changed(ANSWERS.get(f"{request.method} {path}", {}), draw)
        status, kind = 200, KINDS[0]
        if draw.number() > 0xE0:
            status, kind = draw.one_of(STATES), draw.one_of(KINDS)
            document = _changed({"type": "x", "error": "Refused", "detail": "x", **RESULT}, draw)
        headers = {"Content-Type": kind, "X-Seq": f"{RUN}-{draw.number()}"}
        return httpx.Response(status, headers=headers, content=json.dumps(document).encode())

    def _events(self) -> list[bytes]:
        hello = b"data: " + json.dumps(EVENTS[0]).encode() + b"\n\n"
        if self._how & 1:
            return [hello, self._draw.take(64)]
        reported = [
            EVENTS[0],
            *(EVENTS[self._draw.number() % len(EVENTS)] for _ in range(self._how // 2 % 12)),
        ]
        return [b"data: " + json.dumps(_changed(each, self._draw)).encode() + b"\n\n" for each in reported]


class _Stream(httpx.AsyncByteStream):
    """A stream that yields pieces and then never ends."""

    def __init__(self, pieces: list[bytes]) -> None:
        self._pieces = pieces

    async def __aiter__(self) -> AsyncIterator[bytes]:
        for piece in self._pieces:
            yield piece
            await asyncio.sleep(0.01)
        await asyncio.sleep(3600)


def _changed(document: Any, draw: Draw) -> Any:
    """Return a copy with up to two members changed or removed; in most cases with none."""
    document = deepcopy(document)
    for _ in range(max(0, draw.number() // 32 - 5)):
        holder: Any = {"": document}
        key: Any = ""
        for _ in range(1 + draw.number() % 4):
            inner = holder[key]
            if not isinstance(inner, dict | list) or not inner:
                break
            holder, key = inner, draw.one_of(list(inner) if isinstance(inner, dict) else range(len(inner)))
        if draw.number() & 7:
            holder[key] = deepcopy(draw.one_of(ODD))
        else:
            del holder[key]
        document = holder.get("", document) if isinstance(holder, dict) and "" in holder else document
    return document


class _LeapingLoop(asyncio.SelectorEventLoop):
    """An event loop whose simulated clock advances to the next callback."""

    def __init__(self) -> None:
        super().__init__(_LeapingSelector(self))
        self.now = 1_000.0

    def time(self) -> float:
        return self.now


class _LeapingSelector(selectors.DefaultSelector):
    def __init__(self, loop: _LeapingLoop) -> None:
        super().__init__()
        self._loop = loop

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(0)
        if not ready and timeout is None:
            raise RuntimeError("everybody waits, and for nothing")
        self._loop.now += 1e-6 if ready or not timeout else timeout
        return ready
