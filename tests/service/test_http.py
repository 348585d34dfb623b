"""What the service owes to HTTP itself: its methods, and names in addresses."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from paramclient.model.values import ParamType
from paramclient.sim import GenericVehicle, SimParam
from tests.service_hub import C, met, problem, service
from tests.shell import FlakyLink, generic, in_simulated_time, small_px4


@in_simulated_time
async def test_head_answers_what_get_does_without_a_body() -> None:
    async with service(generic()) as (hub, browser):
        await met(browser)
        for path in ("/", "/health", "/metrics", "/openapi.json", "/api/v1/components", C, f"{C}/params"):
            got, head = await browser.get(path), await browser.head(path)
            assert (head.status_code, head.content) == (200, b""), path
            assert head.headers["content-type"] == got.headers["content-type"]
            assert "x-seq" in head.headers
        missing = await browser.head("/api/v1/jobs/none")
        assert (missing.status_code, missing.content) == (404, b"")
        stream = await browser.head("/api/v1/events")
        assert (stream.status_code, stream.content) == (200, b"")
        assert stream.headers["content-type"].startswith("text/event-stream")
        assert hub.feed.listeners == 0
        assert (await browser.head(f"{C}/fetch")).status_code == 405


@in_simulated_time
async def test_an_address_says_all_the_methods_that_it_knows() -> None:
    async with service(generic()) as (_, browser):
        await met(browser)
        for path, allowed in (
            ("/", "GET, HEAD, OPTIONS"),
            (f"{C}/params", "GET, HEAD, OPTIONS, PATCH"),
            (f"{C}/params/X", "GET, HEAD, OPTIONS, PUT"),
            ("/api/v1/jobs/X", "DELETE, GET, HEAD, OPTIONS"),
            (f"{C}/fetch", "OPTIONS, POST"),
        ):
            refused = await browser.request("TRACE", path)
            problem(refused, 405, "method-not-allowed")
            requested = await browser.options(path)
            assert (requested.status_code, requested.content) == (204, b"")
            assert refused.headers["allow"] == requested.headers["allow"] == allowed


# what others rely on


@in_simulated_time
async def test_a_component_of_a_disconnected_link_is_not_up() -> None:
    link = FlakyLink(small_px4())
    async with service(link, fetches=True) as (_, browser):
        await met(browser)
        await asyncio.sleep(5)
        for is_here in (True, False, True):
            if not is_here:
                await link.drop(stays_offline=True)
            link.is_offline = not is_here
            await asyncio.sleep(8)
            reported = (await browser.get("/metrics")).text
            for name in ("up", "synced"):
                sample = f'paramclient_component_{name}{{component="1",link="{link.name}",system="1"}}'
                assert f"{sample} {float(is_here)}\n" in reported


@in_simulated_time
async def test_the_document_of_the_api_has_the_body_of_everything_that_takes_one() -> None:
    async with service() as (_, browser):
        paths = (await browser.get("/openapi.json")).json()["paths"]
    for path, methods in paths.items():
        for method, operation in methods.items():
            assert ("requestBody" in operation) == (method in ("post", "put", "patch")), (method, path)
    for path, method in (
        ("/api/v1/files", "post"),
        ("/api/v1/components/{system}/{component}/metadata", "put"),
    ):
        assert list(paths[path][method]["requestBody"]["content"]) == ["application/octet-stream"]


@in_simulated_time
async def test_a_name_that_no_vehicle_has_is_no_failure_of_the_cache(tmp_path: Path) -> None:
    async with service(small_px4(), cache=tmp_path / "cache.sqlite3", fetches=True) as (_, browser):
        reported = await browser.post("/api/v1/fleet/diff", json={"names": ["PARAM_01"]})
        assert "holds no table" in problem(reported, 404, "unknown-state")["detail"]
        await met(browser)
        await asyncio.sleep(5)
        assert (await browser.post("/api/v1/fleet/diff", json={"names": ["PARAM_01"]})).status_code == 200
        reported = await browser.post("/api/v1/fleet/diff", json={"names": ["NOBODY_HAS"]})
        assert "NOBODY_HAS" in problem(reported, 404, "unknown-state")["detail"]


# names and numbers


@in_simulated_time
async def test_a_name_with_a_slash_can_stand_in_an_address() -> None:
    vehicle = GenericVehicle([SimParam("A/B", ParamType.REAL32, 1.0), SimParam("A", ParamType.REAL32, 2.0)])
    async with service(vehicle) as (_, browser):
        await met(browser)
        for written in ("A%2FB", "A/B"):
            assert (await browser.post(f"{C}/params/{written}/read", json={})).json()["value"] == 1.0
            assert (await browser.put(f"{C}/params/{written}", json={"value": 1.0})).json()["name"] == "A/B"
            assert (await browser.get(f"{C}/params/{written}")).json()["name"] == "A/B"
        assert (await browser.post(f"{C}/params/A/read", json={})).json()["value"] == 2.0


@in_simulated_time
async def test_an_index_is_written_in_plain_digits() -> None:
    async with service(generic()) as (_, browser):
        await met(browser)
        assert (await browser.post(f"{C}/params/%231/read", json={})).json()["index"] == 1
        problem(await browser.post(f"{C}/params/%23\N{ARABIC-INDIC DIGIT ONE}/read", json={}), 422, "usage")


@pytest.mark.parametrize("number", ["1e400", "-1e400", "NaN", "Infinity"])
@in_simulated_time
async def test_a_number_beyond_all_floats_is_not_written_as_an_infinity(number: str) -> None:
    vehicle = GenericVehicle([SimParam("A", ParamType.REAL32, 1.0)])
    headers = {"content-type": "application/json"}
    async with service(vehicle) as (_, browser):
        await met(browser)
        one = await browser.put(f"{C}/params/A", content=f'{{"value":{number}}}', headers=headers)
        many = await browser.patch(f"{C}/params", content=f'{{"values":{{"A":{number}}}}}', headers=headers)
        wanted = f'{{"wanted":{{"values":{{"A":{number}}}}}}}'
        whole = await browser.post(f"{C}/apply", content=wanted, headers=headers)
        for answer in (one, many, whole):
            problem(answer, 422, "invalid-request")
        assert vehicle.params["A"].value == 1.0
        word = await browser.put(f"{C}/params/A", json={"value": "Infinity"})
        assert word.json()["actual"] == "Infinity"
