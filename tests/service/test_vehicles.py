"""Vehicles, parameters, fetches and writes over HTTP."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import httpx
import pytest

from paramclient.links import SimLink
from paramclient.model.values import ParamType
from paramclient.sim import ArduPilotVehicle, Camera, PX4Vehicle
from paramclient.sim.px4 import METADATA_FILE
from paramclient.wire import messages
from tests.recordings import DATA
from tests.service.hub import V, browsing, problem, service, synced, until, value
from tests.service.test_events import events
from tests.shell import VALUES, FlakyLink, PeersLink, Tap, generic, small_px4

CAMERA = "/api/vehicles/1/100"
EXT = {"ext": "true"}


async def test_a_link_that_cannot_be_opened_is_tried_again_until_its_vehicle_is_fetched() -> None:
    link = FlakyLink(generic())
    link.is_offline = True
    async with service(link) as (_, browser):
        await asyncio.sleep(3)
        (reported,) = (await browser.get("/health")).json()["links"]
        assert reported["state"] == "failed"
        assert "connection refused" in reported["error"]
        assert 3 <= link.openings <= 6  # with growing delays
        link.is_offline = False
        found = await synced(browser)
        assert (found["link"], found["count"], found["params"]) == (link.name, len(VALUES), len(VALUES))


async def test_a_link_that_fails_for_good_is_opened_with_a_fresh_client() -> None:
    link = FlakyLink(generic())
    link.reconnects = False
    async with browsing(link) as browser, events(browser) as stream, asyncio.timeout(9):
        for openings in range(2, 8):  # each after the first delay
            await link.drop()
            await asyncio.sleep(0.1)
            problem(await browser.get(f"{V}/params"), 404, "unknown-vehicle")
            await synced(browser)
            assert link.openings == openings
        assert (await stream.next("vehicle"))["vehicle"] is None


async def test_an_unexpected_error_ends_no_other_link(caplog: pytest.LogCaptureFixture) -> None:
    links = [SimLink(generic(), "sim:a"), SimLink(small_px4(system=3), "sim:b")]
    async with service(*links) as (_, browser):
        await synced(browser)
        with mock.patch.object(links[0], "receive", side_effect=RuntimeError("odd")):
            await asyncio.sleep(2)
        await synced(browser)
        assert [each["error"] for each in (await browser.get("/health")).json()["links"]] == [None, None]
        assert "an error of the program" in caplog.text


async def test_a_log_is_followed_to_its_end_and_stays(tmp_path: Path) -> None:
    cache = tmp_path / "cache.sqlite3"
    async with service(f"replay:{DATA / 'px4_full_download.tlog'}?speed=0", cache=cache) as (_, browser):
        await asyncio.sleep(20)
        (reported,) = (await browser.get("/health")).json()["links"]
        assert (reported["state"], reported["error"]) == ("ended", None)
        assert len((await browser.get(f"{V}/params")).json()["params"]) > 900
    assert not cache.exists()  # nor is it cached


async def test_another_vehicle_at_an_address_has_not_the_metadata_of_the_first_one(tmp_path: Path) -> None:
    link = PeersLink({"first": PX4Vehicle(metadata=True)})
    async with browsing(link, cache=str(tmp_path / "cache.sqlite3")) as browser:
        await browser.post(f"{V}/fetch", json={"metadata": True})
        assert (await synced(browser))["has_metadata"]
        link.endpoints = {"second": generic()}
        await until(browser, V, lambda found: found["count"] == len(VALUES))
        assert not (await synced(browser))["has_metadata"]


async def test_a_download_that_fails_is_a_problem_of_the_vehicle() -> None:
    async with browsing(vehicle := small_px4(metadata=True)) as browser:
        del vehicle.files[METADATA_FILE]
        problem(await browser.post(f"{V}/fetch", json={"metadata": True}), 502, "file-transfer-error")


async def test_a_table_is_fetched_once_and_a_check_that_has_found_a_change_counts_as_a_fetch() -> None:
    """A page loads the table again then."""
    async with browsing(vehicle := small_px4()) as browser:
        for fetches in (1, 2):
            await asyncio.sleep(100)
            assert (await synced(browser))["fetches"] == fetches
            vehicle.load({"PARAM_01": 77})  # announces nothing


async def test_ids_on_two_links_need_the_name_of_the_link_and_the_lowest_come_first() -> None:
    links = [SimLink(small_px4(system=3), "sim:c"), SimLink(generic(), "sim:a"), SimLink(generic(), "sim:b")]
    async with service(*links) as (_, browser):
        await synced(browser, f"{V}?link=sim:b")
        await synced(browser, "/api/vehicles/3/1")
        vehicles = (await browser.get("/api/vehicles")).json()["vehicles"]
        assert [each["system"] for each in vehicles] == [1, 1, 3]
        assert problem(await browser.get(f"{V}/params"), 409, "ambiguous")["links"] == ["sim:a", "sim:b"]
        problem(await browser.get(f"{V}/params?link=sim:c"), 404, "unknown-vehicle")


async def test_known_parameters_are_selected_by_name_and_pattern() -> None:
    async with service(generic()) as (hub, browser):
        await synced(browser)
        found = (await browser.get(f"{V}/params", params={"names": ["PARAM_01", "PARAM_2*"]})).json()
        assert list(found["params"]) == ["PARAM_01", *sorted(name for name in VALUES if "_2" in name)]
        assert found["seq"] == hub.feed.seq
        assert value(await browser.get(f"{V}/params/PARAM_03")) == VALUES["PARAM_03"]
        assert problem(await browser.get(f"{V}/params/PARAM_99"), 404, "unknown-parameter")["nearest"]


async def test_a_value_is_written_read_back_and_read_from_the_vehicle() -> None:
    async with browsing(vehicle := generic()) as browser:
        written = (await browser.put(f"{V}/params/PARAM_04", json={"value": 44})).json()
        assert (written["actual"], written["status"]) == (44, "accepted")
        assert vehicle.param("PARAM_04").value == 44
        assert value(await browser.get(f"{V}/params/PARAM_04?live=true")) == 44
        problem(await browser.put(f"{V}/params/NO_SUCH", json={"value": 1}), 404, "unknown-parameter")


async def test_many_values_are_written_and_a_refused_one_stops_no_other() -> None:
    async with browsing(ArduPilotVehicle(read_only=["RTL_SPEED"], param_error=True)) as browser:
        values = {"RTL_ALT": 2000, "RTL_SPEED": 2, "WPNAV_SPEED": 600}
        found = (await browser.patch(f"{V}/params", json={"values": values})).json()
        assert [each["status"] for each in found["results"]] == ["accepted", "refused", "accepted"]
        assert found["results"][1]["error"] == "Refused"


async def test_values_out_of_range_are_refused_before_any_is_written(tmp_path: Path) -> None:
    vehicle = PX4Vehicle(metadata=True)
    async with browsing(vehicle, cache=str(tmp_path / "cache.sqlite3")) as browser:
        await browser.post(f"{V}/fetch", json={"metadata": True})
        high = (await browser.get(f"{V}/params/MC_ROLL_P")).json()["metadata"]["maximum"] + 1
        body: dict[str, Any] = {"values": {"MC_PITCH_P": 5.0, "MC_ROLL_P": high}}
        reported = problem(await browser.patch(f"{V}/params", json=body), 422, "out-of-range")
        assert reported["names"] == ["MC_ROLL_P"]
        problem(await browser.put(f"{V}/params/MC_ROLL_P", json={"value": high}), 422, "out-of-range")
        assert vehicle.param("MC_PITCH_P").value != 5.0
        done = (await browser.patch(f"{V}/params", json={**body, "force": True})).json()
        assert [each["status"] for each in done["results"]] == ["accepted", "accepted"]
        assert vehicle.param("MC_ROLL_P").value == high


async def test_numbers_may_be_text_as_for_what_json_lacks() -> None:
    vehicle = generic(table={"REAL": (ParamType.REAL32, 1.0), "WHOLE": (ParamType.INT32, 1)})
    async with browsing(vehicle) as browser:
        assert (await browser.put(f"{V}/params/WHOLE", json={"value": "0x1F"})).json()["actual"] == 31
        await browser.put(f"{V}/params/REAL", json={"value": "NaN", "force": True})
        assert value(await browser.get(f"{V}/params/REAL")) == "NaN"
        problem(await browser.put(f"{V}/params/WHOLE", json={"value": "much"}), 422, "usage-error")


async def test_fetches_at_one_time_share_a_download_and_tell_their_progress() -> None:
    async with service(Tap(small_px4()), fetches=False) as (_, browser):
        await until(browser, "/api/vehicles", lambda found: bool(found["vehicles"]))
        results = await asyncio.gather(*(browser.post(f"{V}/fetch", json={}) for _ in range(3)))
        assert {answer.json()["received"] for answer in results} == {len(VALUES) + 1}
        assert len({answer.json()["elapsed_s"] for answer in results}) == 1
        assert (await browser.post(f"{V}/fetch", json={})).json()["source"] == "cache"
        assert (await browser.post(f"{V}/fetch", json={"refresh": True})).json()["source"] != "cache"
        [found] = (await browser.get("/api/vehicles")).json()["vehicles"]
        assert (found["fetches"] >= 3, found["fetch"]) == (True, None)


async def test_a_vehicle_that_is_lost_answers_no_request_with_a_problem() -> None:
    tap = Tap(generic())
    async with browsing(tap) as browser:
        tap.is_mute = True
        problem(await browser.put(f"{V}/params/PARAM_05", json={"value": 55}), 504, "no-reply")
        assert (await browser.get(f"{V}/params/PARAM_05")).json()["trust"] == "cached"  # it may have been set
        tap.is_deaf = True
        problem(await browser.get(f"{V}/params/PARAM_04?live=true"), 504, "no-reply")
        await until(browser, V, lambda found: found["state"] == "lost")
        assert value(await browser.get(f"{V}/params/PARAM_04")) == VALUES["PARAM_04"]
        tap.is_mute = tap.is_deaf = False
        await synced(browser)
        assert {each.type for each in tap.messages(messages.Heartbeat)} == {18}, "it is no ground station"


async def test_two_vehicles_under_one_address_are_not_written() -> None:
    px4, copter = PX4Vehicle(), ArduPilotVehicle(ftp=False)
    link = PeersLink({("10.0.0.1", 14550): px4, ("10.0.0.2", 14550): copter})
    async with service(link, fetches=False) as (_, browser):
        await until(browser, V, lambda found: found["autopilot"] != "unknown")
        await asyncio.sleep(2)
        problem(await browser.put(f"{V}/params/MC_ROLL_P", json={"value": 5}), 409, "ambiguous-vehicle")
        assert px4.param("MC_ROLL_P").value != 5


async def test_an_unexpected_error_is_a_problem_without_details(caplog: pytest.LogCaptureFixture) -> None:
    async with service(generic()) as (hub, browser):
        await synced(browser)
        with mock.patch.object(type(hub), "target", side_effect=RuntimeError("secret")):
            answer = await browser.get(f"{V}/params")
        problem(answer, 500, "internal")
        assert not {"Traceback", "RuntimeError", "secret"} & set(answer.text.replace('"', " ").split())
        assert "secret" in caplog.text


async def test_metrics_and_openapi_are_complete() -> None:
    async with browsing(generic()) as browser:
        text = (await browser.get("/metrics")).text
        labels = 'link="sim:custom",system="1",component="1",extended="False"'
        assert f"paramclient_component_synced{{{labels}}} 1.0" in text
        assert 'paramclient_link_bytes_received_total{link="sim:custom"} ' in text
        described = (await browser.get("/openapi.json")).json()
        assert {"get", "put"} <= described["paths"]["/api/vehicles/{system}/{component}/params/{name}"].keys()
        assert "Problem" in described["components"]["schemas"]
        operations = [each for path in described["paths"].values() for each in path.values()]
        errors = {kind for each in operations for kind in each["responses"]["default"]["content"]}
        assert errors == {"application/problem+json"}
        assert "itemSchema" not in str(described)  # it is of OpenAPI 3.2


# extended parameters


@asynccontextmanager
async def camera(table: Any = None, **options: Any) -> AsyncIterator[httpx.AsyncClient]:
    """A client of a service that has heard a camera."""
    async with service(Camera(component=100, table=table), **options) as (_, browser):
        await until(browser, f"{CAMERA}?ext=true", lambda found: found["extended"])
        yield browser


async def test_extended_parameters_are_fetched_written_and_followed() -> None:
    async with camera({"CAM_NAME": "Front", "WIDE": (ParamType.INT64, 1)}) as browser:
        fetched = (await browser.post(f"{CAMERA}/fetch", params=EXT, json={})).json()
        known = (await browser.get(f"{CAMERA}/params", params=EXT)).json()["params"]
        assert fetched["received"] == len(known) > 1
        # as text, of which a float has not all digits
        done = await browser.put(f"{CAMERA}/params/WIDE", params=EXT, json={"value": "9007199254740993"})
        assert done.json()["actual"] == 9007199254740993
        done = await browser.put(f"{CAMERA}/params/CAM_NAME", params=EXT, json={"value": "Rear"})
        assert (done.json()["status"], done.json()["actual"]) == ("accepted", "Rear")
        body = {"values": {"CAM_NAME": "hex:ff00fe"}}
        (result,) = (await browser.patch(f"{CAMERA}/params", params=EXT, json=body)).json()["results"]
        assert result["actual"] == "hex:ff00fe"
        problem(await browser.get(f"{CAMERA}/params/NOPE", params=EXT), 404, "unknown-parameter")
        live = await browser.get(f"{CAMERA}/params/CAM_NAME", params={**EXT, "live": "true"})
        assert live.json()["value"] == "hex:ff00fe"


async def test_of_a_component_without_extended_parameters_no_event_tells_of_them() -> None:
    async with browsing(generic()) as browser, events(browser) as stream:
        problem(await browser.post(f"{V}/fetch", params=EXT, json={}), 504, "no-reply")
        await browser.put(f"{V}/params/PARAM_04", json={"value": 9})
        while (event := await stream.next())["type"] != "change":
            assert not event["extended"]


async def test_extended_parameters_are_set_up_and_restored(tmp_path: Path) -> None:
    async with camera(cache=str(tmp_path / "cache.sqlite3")) as browser:

        async def ask(method: str, what: str, body: object = None, **query: Any) -> Any:
            return (await browser.request(method, f"{CAMERA}/{what}", params=EXT | query, json=body)).json()

        await ask("POST", "fetch", {})
        before, values = (await ask("GET", "params/CAM_NAME"))["value"], {"values": {"CAM_NAME": "Rear"}}
        assert list((await ask("POST", "plan", values))["params"]) == ["CAM_NAME"]
        assert (await ask("POST", "apply", values))["complete"]
        (kept,) = (await ask("GET", "snapshots"))["snapshots"]
        assert (await ask("GET", "params", at=kept["id"]))["params"]["CAM_NAME"]["value"] == before
        assert (await ask("POST", "restore", {}))["complete"]
        made = await ask("POST", "snapshots", {"reason": "by hand"})
        assert (await ask("GET", "snapshots"))["snapshots"][-1] == made
        assert [each["new"] for each in (await ask("GET", "history"))["history"]] == ["Rear", before]
        saved = await browser.get(f"{CAMERA}/file", params=EXT | {"format": "json"})
        given = {"file": {"name": "camera.json", "text": saved.text}, "only": ["CAM_NAME"]}
        assert (await ask("POST", "plan", given))["params"] == {}
