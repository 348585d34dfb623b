"""The event stream: what is told, resuming, slow readers."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import httpx

from paramclient.sim import ArduPilotVehicle
from tests.service.hub import V, browsing, problem, service, synced
from tests.shell import Tap, generic


class Stream:
    """An open event stream."""

    def __init__(self, answer: httpx.Response) -> None:
        self.last, self.resumed = "", False
        self._lines = answer.aiter_lines()

    async def next(self, kind: str | None = None) -> dict[str, Any]:
        """The next event, of a kind."""
        text = ""
        async with asyncio.timeout(60):
            async for line in self._lines:
                if line.startswith("id: "):
                    self.last = line.removeprefix("id: ")
                elif line.startswith("data: "):
                    text = line.removeprefix("data: ")
                elif not line and text:
                    event: dict[str, Any] = json.loads(text)
                    if kind in (None, event["type"]):
                        return event
                    text = ""
        raise EOFError


@asynccontextmanager
async def events(browser: httpx.AsyncClient, last: str | None = None) -> AsyncIterator[Stream]:
    headers = {} if last is None else {"Last-Event-ID": last}
    async with browser.stream("GET", "/api/events", headers=headers) as answer:
        assert answer.headers["content-type"].startswith("text/event-stream")
        stream = Stream(answer)
        stream.resumed = (await stream.next("hello"))["resumed"]
        yield stream


async def test_a_write_is_an_event_with_its_author_and_both_values_and_an_apply_tells_its_progress() -> None:
    async with browsing(generic()) as browser, events(browser) as stream:
        await browser.put(f"{V}/params/PARAM_04", json={"value": 9})
        event = await stream.next("change")
        assert (event["name"], event["kind"], event["by"]) == ("PARAM_04", "changed", "us for local")
        assert (event["old"]["value"], event["new"]["value"]) == (4, 9)
        assert stream.last == f"{event['run']}-{event['seq']}"
        applied = await browser.post(f"{V}/apply", json={"values": {"PARAM_04": 8, "PARAM_05": 9}})
        assert applied.json()["complete"]
        told = [await stream.next("apply") for _ in range(2)]
        assert [each["phase"] for each in told] == ["reading", "writing"]
        assert {"done", "total", "system", "component"} <= told[0].keys()


async def test_a_vehicle_is_told_when_it_appears_is_fetched_lost_found_and_armed() -> None:
    tap = Tap(ArduPilotVehicle())
    async with service(tap) as (_, browser), events(browser) as stream:
        assert (await stream.next("vehicle"))["vehicle"]["state"] in ("new", "fetching")
        while (event := await stream.next())["type"] != "vehicle" or event["vehicle"]["state"] != "synced":
            assert event["type"] != "change", "first values are none"
        tap.is_mute = True
        while (await stream.next("vehicle"))["vehicle"]["state"] != "lost":
            pass
        tap.is_mute = False
        while (await stream.next("vehicle"))["vehicle"]["state"] == "lost":
            pass


async def test_a_stream_resumes_after_the_last_event_or_the_one_of_a_table() -> None:
    async with browsing(generic()) as browser:
        async with events(browser) as stream:
            assert stream.resumed is False
            await browser.put(f"{V}/params/PARAM_04", json={"value": 9})
            change, last = await stream.next("change"), stream.last
        table = (await browser.get(f"{V}/params")).json()
        assert table["seq"] >= change["seq"]
        assert table["params"]["PARAM_04"]["value"] == 9
        await browser.put(f"{V}/params/PARAM_05", json={"value": 8})
        await browser.put(f"{V}/params/PARAM_07", json={"value": 6})
        for since in (last, f"{table['run']}-{table['seq']}"):
            async with events(browser, since) as stream:
                assert stream.resumed is True
                assert [(await stream.next("change"))["name"] for _ in range(2)] == ["PARAM_05", "PARAM_07"]
        for foreign in ("0123456789abcdef-1", "nonsense", last.partition("-")[0] + "-999999", f"{last}x"):
            async with events(browser, foreign) as stream:
                assert stream.resumed is False
        answer = await browser.get("/api/events", headers={"Last-Event-ID": f"{last}{'9' * 5_000}"})
        problem(answer, 422, "invalid-request")


async def test_a_slow_reader_holds_up_no_other_and_its_stream_is_ended() -> None:
    async with service(generic()) as (hub, browser):
        await synced(browser)
        async with browser.stream("GET", "/api/events") as slow, events(browser) as quick:
            await asyncio.sleep(0.1)
            for number in range(10_000):
                hub.feed.publish("test", number=number, text="x" * 100)
                if number % 64 == 63:
                    assert (await quick.next("test"))["number"] == number - 63
                    for _ in range(63):
                        await quick.next("test")
            assert 0 < len([line async for line in slow.aiter_lines()]) < 3 * 6_000  # it ends


async def test_a_quiet_stream_has_comments_and_ends_with_the_service() -> None:
    async with service(generic(), fetches=False) as (hub, browser):
        await asyncio.sleep(2)
        async with browser.stream("GET", "/api/events") as answer:
            texts = answer.aiter_lines()
            while not (await anext(texts)).startswith(":"):
                pass
            hub.feed.end()
            assert not any([line.startswith("data:") async for line in texts])
