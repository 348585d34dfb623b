"""The event stream of the service: no event is lost or repeated, and a slow listener is informed of lost
ones."""

from __future__ import annotations

import asyncio
import gc
import json
import weakref
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from itertools import pairwise
from typing import Any

import httpx
import pytest
from starlette.types import Message

from paramclient.service import Hub, create_app
from paramclient.service.event_feed import BATCH_EVENTS_MAX, EventFeed, EventFilter, EventPosition, Listener
from paramclient.service.routes import events
from paramclient.sim import Air
from tests.service_hub import C, met, problem, service
from tests.shell import VALUES, Tap, generic, in_simulated_time, small_px4, tasks_beside


def events_of(text: str) -> list[tuple[str, dict[str, Any]]]:
    """Whole server-sent events: id and data of those that have any."""
    found = []
    for block in text.split("\n\n")[:-1]:
        fields: dict[str, str] = {}
        for line in block.split("\n"):
            name, _, value = line.partition(":")
            assert name in ("id", "data", ""), line
            assert name not in fields
            fields[name] = value.removeprefix(" ")
        assert "id" in fields
        if "data" in fields:
            found.append((fields["id"], json.loads(fields["data"])))
    return found


class ReceivedEvents:
    """Server-sent events as they arrive, until closed.

    Attributes:
        text: all that has arrived.
        status: of the answer.
    """

    def __init__(self) -> None:
        self.text = ""
        self.is_ended = False

    @property
    def all(self) -> list[dict[str, Any]]:
        """Every event so far; their ids are those of their numbers."""
        found = []
        for name, reported in events_of(self.text):
            assert name == f"{reported['run']}-{reported['seq']}"
            found.append(reported)
        return found

    def of(self, kind: str) -> list[dict[str, Any]]:
        """Those of one kind."""
        return [each for each in self.all if each["type"] == kind]

    @property
    def last_id(self) -> str:
        """The Last-Event-ID that a browser sends at a reconnection."""
        return [line for line in self.text.split("\n") if line.startswith("id: ")][-1][4:]


@asynccontextmanager
async def listening(
    browser: httpx.AsyncClient, after: str | None = None, **query: Any
) -> AsyncIterator[ReceivedEvents]:
    """Listens for the time of the block."""
    received = ReceivedEvents()
    headers = {} if after is None else {"last-event-id": after}
    async with browser.stream("GET", "/api/v1/events", params=query, headers=headers) as answer:
        assert answer.status_code == 200
        assert answer.headers["content-type"].startswith("text/event-stream")

        async def read() -> None:
            async for chunk in answer.aiter_text():
                received.text += chunk
            received.is_ended = True

        reader = asyncio.create_task(read())
        await asyncio.sleep(0.01)
        try:
            yield received
        finally:
            reader.cancel()


# the list


def publish(feed: EventFeed, count: int, **about: Any) -> None:
    for number in range(count):
        feed.publish("note", {"number": number}, **about)


async def taken(listener: Listener) -> list[int]:
    """The numbers of what a listener is given at once."""
    batches = await listener.next(0.01)
    return [] if batches is None else [seq for seq, _ in batches[0].texts]


@asynccontextmanager
async def a_feed(**options: Any) -> AsyncIterator[EventFeed]:
    feed = EventFeed(**options)
    gathering = asyncio.create_task(feed.wake_listeners())
    yield feed
    gathering.cancel()


@in_simulated_time
async def test_a_listener_receives_every_event_once_and_in_order() -> None:
    async with a_feed() as feed:
        publish(feed, 3)
        listener = feed.listen()
        assert await taken(listener) == []
        publish(feed, BATCH_EVENTS_MAX + 10)
        got = await taken(listener) + await taken(listener)
        assert got == list(range(4, 4 + BATCH_EVENTS_MAX + 10))
        assert await taken(listener) == []
        again = feed.listen(EventPosition(feed.run, 5))
        assert again.is_resumed
        assert (await taken(again))[0] == 6


@in_simulated_time
async def test_an_event_that_cannot_be_encoded_is_none() -> None:
    async with a_feed() as feed:
        listener = feed.listen()
        publish(feed, 1)
        with pytest.raises(ValueError, match="not JSON compliant"):
            feed.publish("note", {"number": float("nan")})
        publish(feed, 1)
        batch = await listener.next(0.01)
        assert batch is not None
        assert [(seq, json.loads(text)["seq"]) for seq, text in batch[0].texts] == [(1, 1), (2, 2)]


@in_simulated_time
async def test_kept_events_are_nothing_that_garbage_collections_visit() -> None:
    async with a_feed() as feed:
        listener = feed.listen()
        members = {"doc": {"state": "new"}}
        feed.publish("component", members, link="l", system=1, component=2)
        gc.collect()
        assert not any(map(gc.is_tracked, (*feed._labels, *feed._texts)))
        members["doc"]["state"] = "lost"
        batch = await listener.next(0.01)
        assert batch is not None
        ((_, text),) = batch[0].texts
        assert json.loads(text)["doc"] == {"state": "new"}


@in_simulated_time
async def test_a_place_that_is_gone_or_never_was_is_not_gone_on_from() -> None:
    async with a_feed(kept=10) as feed:
        publish(feed, 30)
        assert feed.listen(EventPosition(feed.run, 20)).is_resumed
        for place in (EventPosition(feed.run, 19), EventPosition(feed.run, 31), EventPosition("0" * 16, 25)):
            listener = feed.listen(place)
            assert not listener.is_resumed
            assert listener.position == feed.position


@pytest.mark.parametrize(
    "text", ["", "x", "-", "0123456789abcdef-", "0123456789abcdef-1x", "-1", "é-1", "1" * 99]
)
def test_an_invalid_event_position_is_none(text: str) -> None:
    assert EventPosition.read(text) is None


def test_a_place_is_read_as_it_is_written() -> None:
    place = EventPosition("0123456789abcdef", 17)
    assert EventPosition.read(str(place)) == place


@in_simulated_time
async def test_a_slow_listener_receives_the_number_of_lost_events_and_continues() -> None:
    async with a_feed(kept=10) as feed:
        listener = feed.listen()
        publish(feed, 25)
        batches = await listener.next(1)
        assert batches is not None
        assert (batches[0].missed, batches[0].texts) == (25, ())
        assert listener.position == feed.position
        publish(feed, 2)
        assert await taken(listener) == [26, 27]


@in_simulated_time
async def test_listeners_get_what_they_want_and_move_on_past_the_rest() -> None:
    async with a_feed() as feed:
        of_two = feed.listen(event_filter=EventFilter(system=2))
        of_links = feed.listen(event_filter=EventFilter(types=frozenset({"link"})))
        feed.publish("note", {}, link="a", system=1, component=1)
        feed.publish("note", {}, link="a", system=2, component=1)
        feed.publish("link", {}, link="a")
        assert await taken(of_two) == [2, 3]
        assert await taken(of_links) == [3]
        feed.publish("note", {}, link="a", system=1, component=1)
        assert await taken(of_two) == []
        assert of_two.position.seq == 4


@in_simulated_time
async def test_many_listeners_are_woken_seldom_and_one_at_once() -> None:
    """Events for many listeners are collected, so that a download is not sent value by value to each of
    them."""

    async def count(listeners: int) -> int:
        wakings = 0

        async def listen(listener: Listener) -> None:
            nonlocal wakings
            with listener:
                while listener.position.seq < 100:
                    await listener.next(1)
                    wakings += 1

        async with a_feed() as feed:
            tasks = [asyncio.create_task(listen(feed.listen())) for _ in range(listeners)]
            for number in range(100):
                await asyncio.sleep(0.01)
                feed.publish("note", {"number": number})
            await asyncio.gather(*tasks)
        return wakings

    assert await count(1) == 100
    assert await count(200) <= 200 * 12


@in_simulated_time
async def test_an_event_that_was_sent_releases_what_it_was_written_from() -> None:
    class Members:
        def __call__(self) -> str:
            return '"value":1'

    members = Members()
    released = weakref.ref(members)
    async with a_feed() as feed:
        listener = feed.listen()
        feed.publish("change", members)
        del members
        assert released() is not None
        for each in (listener, feed.listen(EventPosition(feed.run, 0))):  # the second one gets the same text
            answer = await each.next(1)
            assert answer is not None
            assert json.loads(answer[0].texts[0][1])["value"] == 1
        assert released() is None


@in_simulated_time
async def test_an_event_is_encoded_once_for_all_listeners() -> None:
    written = 0

    def write() -> str:
        nonlocal written
        written += 1
        return '"a":1'

    async with a_feed() as feed:
        listeners = [feed.listen() for _ in range(20)]
        feed.publish("note", write)
        batches = [await each.next(1) for each in listeners]
        assert written == 1
        assert len({id(batch[1]) for batch in batches if batch}) == 1


# server-sent events


@in_simulated_time
async def test_a_listener_receives_the_events_of_a_vehicle_its_values_and_its_fetch() -> None:
    vehicle = small_px4(burst=1, period=0.1)
    async with service(vehicle) as (hub, browser), listening(browser) as received:
        hello = received.all[0]
        assert (hello["type"], hello["resumed"]) == ("hello", False)
        assert hello["run"] == hub.feed.run
        await met(browser)
        await browser.post(f"{C}/fetch", json={})
        await browser.put(f"{C}/params/PARAM_01", json={"value": 12})
        await asyncio.sleep(1)
        assert [
            each["component_doc"]["system"]
            for each in received.of("component")
            if each["why"] == "discovered"
        ] == [1]
        changes = received.of("change")
        assert {each["name"] for each in changes} >= set(VALUES)
        assert (changes[-1]["name"], changes[-1]["new"]["value"], changes[-1]["by"]) == (
            "PARAM_01",
            12,
            "us for local",
        )
        progress = received.of("progress")
        assert all(0 <= a["received"] <= b["received"] for a, b in pairwise(progress))
        assert progress[-1]["done"] is True
        assert 5 <= len(progress) <= 25  # of 2.5 seconds
        assert [each["job"]["state"] for each in received.of("job")] == ["running", "done"]
        assert [each["state"] for each in received.of("link")] == ["open"]
        numbers = [each["seq"] for each in received.all]
        assert numbers == sorted(set(numbers))


@in_simulated_time
async def test_a_client_that_reconnects_misses_no_event_and_gets_none_twice() -> None:
    async with service(generic(burst=1, period=0.05)) as (hub, browser):
        await met(browser)
        whole: list[int] = []
        last = str(hub.feed.position)
        fetch = asyncio.create_task(browser.post(f"{C}/fetch", json={}))
        for _ in range(6):
            async with listening(browser, after=last) as received:
                assert received.all[0]["resumed"]
                await asyncio.sleep(0.31)
                whole += [each["seq"] for each in received.all[1:]]
                last = received.last_id
            await asyncio.sleep(0.07)
        await fetch
        first = whole[0]
        assert whole == list(range(first, first + len(whole)))
        assert len(whole) > len(VALUES)


@in_simulated_time
async def test_after_another_run_everything_is_to_be_loaded_anew() -> None:
    async with (
        service(generic()) as (hub, browser),
        listening(browser, after="0123456789abcdef-1") as received,
        listening(browser, after="nonsense") as other,
        listening(browser, after=str(hub.feed.position)) as by_query,
    ):
        assert [each.all[0]["resumed"] for each in (received, other, by_query)] == [False, False, True]


@in_simulated_time
async def test_a_listener_receives_the_events_that_it_has_selected() -> None:
    two = Air.symmetric([generic(system=1), generic(system=2)])
    async with (
        service(two) as (_, browser),
        listening(browser, types="change,component", system=2) as received,
    ):
        await met(browser, system=2)
        await browser.post("/api/v1/fetch", json={})
        await asyncio.sleep(1)
        reported = received.all[1:]
        assert {each["type"] for each in reported} == {"change", "component"}
        assert {each["system"] for each in reported} == {2}


@in_simulated_time
async def test_a_stream_in_which_nothing_happens_says_that_it_lives() -> None:
    async with service() as (_, browser), listening(browser) as received:
        await asyncio.sleep(10 * events.KEEPALIVE_INTERVAL)
        assert 9 <= received.text.count(": \n") <= 11
        assert len(received.all) == 1


@in_simulated_time
async def test_filtered_events_advance_the_position() -> None:
    async with service(generic()) as (hub, browser), listening(browser, types="link") as received:
        await met(browser)
        await browser.post(f"{C}/fetch", json={})
        await asyncio.sleep(3 * events.KEEPALIVE_INTERVAL)
        assert received.last_id == str(hub.feed.position)


@in_simulated_time
async def test_a_listener_that_does_not_read_is_informed_of_the_gap(monkeypatch: pytest.MonkeyPatch) -> None:
    vehicle = small_px4()
    hub = Hub([vehicle], cache=False, fetches=False)
    hub.feed = EventFeed(kept=20)
    hub.jobs._feed = hub.feed
    for line in hub.links.values():
        line._feed = hub.feed
    got: list[bytes] = []
    may_go_on = asyncio.Event()

    async def send(message: Message) -> None:
        got.append(message.get("body", b""))
        if b"hello" in got[-1]:
            await may_go_on.wait()

    async with hub:
        listener = asyncio.create_task(call_app(hub, "/api/v1/events", send))
        await hub.wait_for_component(1, 1, None, None)
        await hub.start_fetch(hub.find_component(1, 1), "test").wait()
        await asyncio.sleep(1)
        assert hub.feed.seq > 20
        may_go_on.set()
        await asyncio.sleep(1)
        listener.cancel()
    hello, gap, *_ = [reported for _, reported in events_of(b"".join(got).decode())]
    assert (hello["type"], gap["type"]) == ("hello", "gap")
    assert gap["missed"] == gap["seq"] - hello["seq"]


@in_simulated_time
async def test_a_listener_that_never_takes_what_it_is_sent_is_left() -> None:
    async def send(message: Message) -> None:
        if message.get("body"):
            await asyncio.Event().wait()

    hub = Hub([], cache=False)
    async with hub:
        before = tasks_beside()
        listener = asyncio.create_task(call_app(hub, "/api/v1/events", send))
        await asyncio.sleep(0.1)
        assert hub.feed.listeners == 1
        await asyncio.sleep(events.LISTENER_SEND_TIMEOUT)
        assert hub.feed.listeners == 0
        listener.cancel()
        await asyncio.sleep(0)
        assert tasks_beside() <= before | {listener.get_name()}


@in_simulated_time
async def test_streams_are_bounded_and_end_with_the_service(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(events, "LISTENERS_MAX", 2)
    async with service() as (hub, browser):
        async with listening(browser) as first, listening(browser) as second:
            problem(await browser.get("/api/v1/events"), 429, "too-many")
            hub.feed.end()
            await asyncio.sleep(1)
            assert first.is_ended
            assert second.is_ended
        assert hub.feed.listeners == 0


@in_simulated_time
async def test_of_a_listener_that_leaves_nothing_is_left() -> None:
    async with service() as (hub, browser):
        before = tasks_beside()
        async with listening(browser):
            assert hub.feed.listeners == 1
        await asyncio.sleep(0.1)
        assert hub.feed.listeners == 0
        assert tasks_beside() == before


@in_simulated_time
async def test_the_loss_and_return_of_a_vehicle_are_reported() -> None:
    vehicle = Tap(generic())
    async with service(vehicle) as (_, browser), listening(browser) as received:
        await met(browser)
        await browser.post(f"{C}/fetch", json={})
        vehicle.is_mute = True
        await asyncio.sleep(8)
        [lost] = [each for each in received.of("component") if each["why"] == "lost"]
        assert lost["component_doc"]["is_lost"]
        assert lost["silence_s"] >= 5
        assert (await browser.get(f"{C}/params/PARAM_01")).json()["trust"] == "cached"
        vehicle.is_mute = False
        await asyncio.sleep(5)
        assert [each["why"] for each in received.of("component")].count("found") == 1


# the same over a WebSocket


async def call_app(
    hub: Hub,
    path: str,
    send: Callable[[Message], Awaitable[None]],
    *,
    kind: str = "http",
    query: str = "",
    received: asyncio.Queue[Message] | None = None,
) -> None:
    """One request to an application, with `send` in place of a server's."""
    first: Message = (
        {"type": "http.request", "body": b""} if kind == "http" else {"type": "websocket.connect"}
    )
    inbox: asyncio.Queue[Message] = asyncio.Queue() if received is None else received
    inbox.put_nowait(first)
    scope = {
        "type": kind,
        "asgi": {"version": "3.0", "spec_version": "2.4"},
        "http_version": "1.1",
        "method": "GET",
        "scheme": "http" if kind == "http" else "ws",
        "path": path,
        "raw_path": path.encode(),
        "query_string": query.encode(),
        "root_path": "",
        "headers": [(b"host", b"127.0.0.1:8765")],
        "server": ("127.0.0.1", 8765),
        "client": ("127.0.0.1", 50_000),
        "subprotocols": [],
        "state": {},
        "extensions": {"websocket.http.response": {}} if kind == "websocket" else {},
    }
    await create_app(hub)(scope, inbox.get, send)


@in_simulated_time
async def test_a_websocket_carries_the_same_events_and_resumes() -> None:
    sent: list[Message] = []

    async def send(message: Message) -> None:
        sent.append(message)

    async with service(generic()) as (hub, browser):
        await met(browser)
        place = hub.feed.position
        async with listening(browser, after=str(place)) as received:
            inbox: asyncio.Queue[Message] = asyncio.Queue()
            query = f"after={place}&types=change,job"
            calling = call_app(hub, "/api/v1/ws", send, kind="websocket", query=query, received=inbox)
            call = asyncio.create_task(calling)
            await browser.post(f"{C}/fetch", json={})
            await asyncio.sleep(1)
            assert sent[0]["type"] == "websocket.accept"
            hello, *reported = [json.loads(each["text"]) for each in sent[1:]]
            assert hello["resumed"]
            assert reported == [each for each in received.all if each["type"] in ("change", "job")]
            inbox.put_nowait({"type": "websocket.disconnect", "code": 1001})
            await call
            assert hub.feed.listeners == 1

            call = asyncio.create_task(call_app(hub, "/api/v1/ws", send, kind="websocket"))
            await asyncio.sleep(0.1)
            hub.feed.end()
            await call
            assert (sent[-1]["type"], sent[-1]["code"]) == ("websocket.close", 1001)


@in_simulated_time
async def test_a_websocket_that_cannot_be_opened_is_a_problem_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(events, "LISTENERS_MAX", 0)
    for path, query, status in (
        ("/api/v1/ws", "", 429),
        ("/api/v1/ws", "system=x", 422),
        ("/api/v1/events", "", 404),
    ):
        sent: list[Message] = []

        async def send(message: Message, sent: list[Message] = sent) -> None:
            sent.append(message)

        async with Hub([], cache=False) as hub:
            await call_app(hub, path, send, kind="websocket", query=query)
        assert sent[0]["type"] == "websocket.http.response.start"
        assert sent[0]["status"] == status
        assert json.loads(sent[1]["body"])["status"] == status
