"""The service over HTTP, in this process: what it returns, what it does, how it fails."""

from __future__ import annotations

import asyncio
import json
import re
from pathlib import Path
from typing import Any

import pytest

from paramclient import ParamCache, UsageError
from paramclient.documents.component import ComponentDoc
from paramclient.documents.job import JobDoc
from paramclient.documents.param import ParamDoc
from paramclient.links import SimLink
from paramclient.model.values import ParamType
from paramclient.service import Hub, create_app, followed_component
from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle, SimParam
from tests.asgi import a_browser
from tests.recordings import DATA
from tests.service_hub import C, met, problem, service
from tests.shell import VALUES, FlakyLink, Tap, generic, in_simulated_time, settled, small_px4

# links and components


@in_simulated_time
async def test_the_service_starts_without_a_vehicle_and_without_its_link() -> None:
    link = FlakyLink(generic())
    link.is_offline = True
    async with service(link, fetches=True) as (_, browser):
        await asyncio.sleep(3)
        [reported] = (await browser.get("/api/v1/links")).json()["links"]
        assert reported["state"] == "failed"
        assert "connection refused" in reported["error"]
        assert reported["stats"] is None
        assert (await browser.get("/api/v1/components")).json()["components"] == []
        assert 3 <= link.openings <= 6  # with back-off

        link.is_offline = False
        found = await met(browser)
        assert (found["link"], found["system"], found["component"]) == ("tcp:flaky:5760", 1, 1)
        await asyncio.sleep(5)
        component = ComponentDoc.model_validate((await browser.get(C)).json())
        assert component.state == "synced"
        assert component.params == component.count == len(VALUES)
        [reported] = (await browser.get("/api/v1/links")).json()["links"]
        assert (reported["state"], reported["error"], reported["openings"]) == ("open", None, 1)
        assert reported["stats"]["round_trips"]["1/1"] > 0


@in_simulated_time
async def test_requests_to_the_cache_of_a_closing_service_get_closing(tmp_path: Path) -> None:
    with ParamCache(tmp_path / "cache.sqlite3") as cache:
        async with Hub([small_px4()], cache=cache) as hub, a_browser(create_app(hub)) as browser:
            assert (await browser.get("/api/v1/vehicles")).status_code == 200
        async with a_browser(create_app(hub)) as late, asyncio.timeout(60):
            problem(await late.get("/api/v1/vehicles"), 503, "closing")
            headers = {"Content-Type": "application/octet-stream"}
            answer = await late.post("/api/v1/files?name=a.param", content=b"A,1", headers=headers)
            problem(answer, 503, "closing")


@in_simulated_time
async def test_a_dropped_link_is_reconnecting_until_it_is_open() -> None:
    link = FlakyLink(generic())
    async with service(link) as (hub, browser):
        await met(browser)
        await link.drop(stays_offline=True)
        await asyncio.sleep(1)
        assert (await browser.get(C)).json()["link_state"] == "reconnecting"
        link.is_offline = False
        await asyncio.sleep(6)
        assert (await browser.get(C)).json()["link_state"] == "open"
        assert [each.state for each in hub.links.values()] == ["open"]


@in_simulated_time
async def test_a_link_that_fails_for_good_is_opened_with_a_fresh_client() -> None:
    link = FlakyLink(generic())
    link.reconnects = False
    async with service(link) as (hub, browser):
        await met(browser)
        await link.drop()
        await asyncio.sleep(0.1)
        assert hub.followed == []
        assert hub.links[link.name].state == "failed"
        await met(browser)
        assert hub.links[link.name].openings == 2


@in_simulated_time
async def test_a_log_is_followed_to_its_end_and_stays_to_be_looked_at() -> None:
    name = f"replay:{DATA / 'px4_full_download.tlog'}?speed=0"
    async with service(name, cache=None, fetches=True) as (hub, browser):
        found = await met(browser)
        await asyncio.sleep(20)
        [reported] = (await browser.get("/api/v1/links")).json()["links"]
        assert (reported["state"], reported["error"], reported["openings"]) == ("ended", None, 1)
        assert reported["listens_only"]
        assert found["link_state"] in ("open", "ended")
        assert len((await browser.get(f"{C}/params")).json()["params"]) > 900
        assert hub.jobs.all == []


@in_simulated_time
async def test_ids_that_two_links_carry_need_the_link_beside_them() -> None:
    async with service(SimLink(generic(), "sim:a"), SimLink(generic(), "sim:b")) as (_, browser):
        await met(browser)
        await asyncio.sleep(2)
        reported = problem(await browser.get(C), 409, "ambiguous")
        assert reported["links"] == ["sim:a", "sim:b"]
        assert (await browser.get(C, params={"link": "sim:b"})).json()["link"] == "sim:b"
        problem(await browser.get(C, params={"link": "sim:c"}), 404, "unknown-component")
        problem(await browser.post("/api/v1/find", json={}, params={"link": "sim:c"}), 404, "unknown-link")


@in_simulated_time
async def test_find_without_a_vehicle_is_a_no_reply_problem() -> None:
    async with service(SimLink(generic())) as (_, browser):
        reported = problem(
            await browser.post("/api/v1/find", json={"system": 7, "timeout_s": 2}), 504, "no-reply"
        )
        assert reported["error"] == "NoReply"
        assert reported["waited"] == pytest.approx(2, abs=0.01)
        assert "system id 7" in reported["detail"]
        assert reported["hint"] == "Heard on sim:custom so far: 1/1 generic."
        assert reported["detail"].endswith(reported["hint"])
        problem(await browser.get("/api/v1/components/7/1"), 404, "unknown-component")


@in_simulated_time
async def test_everybody_is_fetched_on_all_links() -> None:
    two = Air.symmetric([generic(system=1), generic(system=2)])
    async with service(SimLink(two, "sim:two"), SimLink(generic(system=3), "sim:one")) as (_, browser):
        await met(browser)
        fetched = (await browser.post("/api/v1/fetch", json={})).json()
        assert sorted((each["link"], each["system"]) for each in fetched["results"]) == [
            ("sim:one", 3),
            ("sim:two", 1),
            ("sim:two", 2),
        ]
        assert fetched["silent"] == []
        only = (await browser.post("/api/v1/fetch", json={"system": 3}, params={"link": "sim:one"})).json()
        assert [each["system"] for each in only["results"]] == [3]


@in_simulated_time
async def test_a_vehicle_starts_again() -> None:
    async with service(SimLink(small_px4())) as (_, browser):
        await met(browser)
        done = await browser.post(f"{C}/reboot", json={})
        assert done.status_code == 200, done.text
        assert done.json()["system"] == 1


# parameters


@in_simulated_time
async def test_the_fast_encoding_of_parameters_equals_the_documents(tmp_path: Path) -> None:
    """The quick way of writing them says to the letter what the documents would."""
    async with service(SimLink(ArduPilotVehicle()), cache=tmp_path / "cache") as (hub, browser):
        await met(browser)
        assert (await browser.post(f"{C}/fetch", json={})).json()["source"] == "ftp"
        everything = (await browser.get(f"{C}/params")).json()
        [followed] = hub.followed
        assert everything["run"] == hub.feed.run
        assert list(everything["params"]) == list(followed.component.params)
        for name, param in followed.component.params.items():
            reported = ParamDoc.kept(param, heard_at=followed.received_at(name)).as_json()
            assert everything["params"][name] == reported
            assert reported["heard_at"] > 1_700_000_000
        one = (await browser.get(f"{C}/params/RTL_ALT")).json()
        assert one == everything["params"]["RTL_ALT"]
        assert one["trust"] == "live"
        some = (await browser.get(f"{C}/params", params={"names": ["RTL_*", "ATC_RAT_*"]})).json()["params"]
        assert some.keys() == {each for each in everything["params"] if each.startswith(("RTL_", "ATC_RAT_"))}
        changed = (await browser.get(f"{C}/params", params={"changed": True})).json()["params"]
        assert changed.keys() == followed.component.params.changed().keys()
        assert changed


@in_simulated_time
async def test_one_is_requested_by_name_and_by_index() -> None:
    vehicle = generic()
    async with service(SimLink(vehicle)) as (_, browser):
        await met(browser)
        problem(await browser.get(f"{C}/params/PARAM_03"), 404, "unknown-parameter")
        by_name = (await browser.post(f"{C}/params/PARAM_03/read", json={})).json()
        assert (by_name["value"], by_name["index"]) == (0.75, 3)
        assert (await browser.post(f"{C}/params/%233/read", json={})).json()["name"] == "PARAM_03"
        assert (await browser.post(f"{C}/read", json={"index": 3})).json()["name"] == "PARAM_03"
        assert (await browser.post(f"{C}/read", json={"name": "PARAM_03"})).json()["value"] == 0.75
        assert (await browser.get(f"{C}/params/PARAM_03")).json()["value"] == 0.75
        problem(await browser.post(f"{C}/read", json={}), 422, "usage")
        reported = problem(await browser.post(f"{C}/read", json={"name": "NONE"}), 404, "unknown-parameter")
        assert reported["name"] == "NONE"
        assert vehicle.requests["PARAM_REQUEST_LIST"] == 0


@in_simulated_time
async def test_values_of_every_kind_are_written() -> None:
    table = [
        SimParam("F", ParamType.REAL32, 1.0),
        SimParam("I", ParamType.INT32, 1),
        SimParam("B", ParamType.UINT8, 1),
    ]
    async with service(SimLink(generic(table=table))) as (hub, browser):
        await met(browser)

        async def put(name: str, value: Any) -> dict[str, Any]:
            answer = await browser.put(f"{C}/params/{name}", json={"value": value})
            assert answer.status_code == 200, answer.text
            done: dict[str, Any] = answer.json()
            return done

        [followed] = hub.followed
        known = followed.component.params
        assert (await put("F", 2.5))["param"]["value"] == 2.5
        assert (await put("F", "NaN"))["param"]["value"] == "NaN"
        assert (await put("F", "-Infinity"))["actual"] == "-Infinity"
        await put("F", {"bits": "3f800000"})
        assert known["F"].value == 1.0
        await put("F", {"raw": "00000040"})
        assert known["F"].value == 2.0
        await put("I", -7)
        await put("I", {"bits": "ffffffff"})
        assert known["I"].value == -1
        assert (await put("B", {"bits": "000000ff"}))["param"]["value"] == 255

        for name, value in {"B": 256, "I": 0.5, "F": "fast", "b\u00e9": 1}.items():
            problem(await browser.put(f"{C}/params/{name}", json={"value": value}), 422, "usage")
        problem(await browser.put(f"{C}/params/B", json={"value": {"bits": "100"}}), 422, "usage")
        for value in (None, True, [], {}, {"bits": "xyz"}, {"raw": "00"}):
            answer = await browser.put(f"{C}/params/F", json={"value": value})
            problem(answer, 422, "invalid-request")
        assert known["F"].value == 2.0


@in_simulated_time
async def test_of_many_values_each_is_tried_and_reported() -> None:
    vehicle = small_px4(param_error=True)
    async with service(SimLink(vehicle)) as (hub, browser):
        await met(browser)
        values = {"PARAM_01": 11, "NOT_THERE": 1, "PARAM_03": 0.5, "PARAM_04": 0.5}
        results = (await browser.patch(f"{C}/params", json={"values": values})).json()["results"]
        assert list(results) == list(values)
        assert results["PARAM_01"]["status"] == "accepted"
        assert results["PARAM_03"]["actual"] == 0.5
        assert results["NOT_THERE"]["problem"]["type"] == "urn:paramclient:unknown-parameter"
        assert results["PARAM_04"]["problem"]["error"] == "UsageError"
        assert hub.followed[0].component.params["PARAM_01"].value == 11
        problem(await browser.patch(f"{C}/params", json={"values": {}}), 422, "invalid-request")


@in_simulated_time
async def test_a_write_may_be_watched_or_forced() -> None:
    async with service(SimLink(PX4Vehicle())) as (_, browser):
        await met(browser)
        body = {"value": 80, "settle_s": 1.2}
        done = (await browser.put(f"{C}/params/MPC_TILTMAX_LND", json=body)).json()
        assert (done["status"], done["actual"]) == ("adjusted", 45.0)
        values = {"MPC_XY_CRUISE": 18, "MC_ROLL_P": "NaN"}
        answer = await browser.patch(f"{C}/params", json={"values": values, "settle_s": 1.2})
        many = answer.json()["results"]
        assert many["MPC_XY_CRUISE"]["status"] == "adjusted"
        assert many["MC_ROLL_P"]["problem"]["error"] == "UsageError"
        assert "cannot save NaN" in many["MC_ROLL_P"]["problem"]["detail"]
        forced = await browser.put(f"{C}/params/MC_ROLL_P", json={"value": "NaN", "force": True})
        assert forced.json()["status"] == "accepted"
        for settle in (-1, 61, "x"):
            wrong = {"value": 1, "settle_s": settle}
            problem(await browser.put(f"{C}/params/MC_ROLL_P", json=wrong), 422, "invalid-request")


@in_simulated_time
async def test_events_of_a_call_precede_its_response() -> None:
    async with service(SimLink(small_px4())) as (hub, browser):
        await met(browser)
        before = hub.feed.listen()
        done = await browser.put(f"{C}/params/PARAM_01", json={"value": 11})
        run, _, seq = done.headers["x-seq"].partition("-")
        assert run == hub.feed.run
        await asyncio.sleep(0.2)
        batches = await before.next(1)
        assert batches is not None
        [number] = [
            number
            for number, text in batches[0].texts
            if '"type":"change"' in text and json.loads(text)["new"]["value"] == 11
        ]
        assert number <= int(seq)
        params = (await browser.get(f"{C}/params")).json()
        assert params["seq"] >= number


@in_simulated_time
async def test_the_component_event_of_a_call_precedes_its_response() -> None:
    """Also if it was reported a moment before, and would otherwise wait."""
    async with service(SimLink(small_px4())) as (hub, browser):
        await met(browser)
        await browser.post(f"{C}/fetch", json={})
        for value in (21, 22, 23):
            listener = hub.feed.listen()
            done = await browser.put(f"{C}/params/PARAM_01", json={"value": value})
            now = (await browser.get(C)).json()["hash"]
            await asyncio.sleep(0.01)
            batches = await listener.next(1)
            assert batches is not None
            reported = [json.loads(text) for _, text in batches[0].texts]
            last = [each for each in reported if each["type"] == "component"][-1]
            assert last["component_doc"]["hash"] == now
            assert last["seq"] <= int(done.headers["x-seq"].partition("-")[2])


def test_a_value_that_is_received_again_has_the_later_time(monkeypatch: pytest.MonkeyPatch) -> None:
    times = iter(range(2_000_000_000, 2_000_000_100))

    @in_simulated_time
    async def ask() -> None:
        async with service(SimLink(generic())) as (_, browser):
            await met(browser)

            async def age() -> float:
                return float((await browser.get(f"{C}/params/PARAM_01")).json()["heard_at"])

            await browser.post(f"{C}/fetch", json={})
            first = await age()
            monkeypatch.setattr(followed_component, "_now", lambda: next(times))
            await browser.post(f"{C}/fetch", json={"refresh": True})
            fetched = await age()
            await browser.post(f"{C}/params/PARAM_01/read", json={})
            assert first < 2_000_000_000 <= fetched < await age()

    ask()


@pytest.mark.parametrize("most_told_singly", [0, 32])
def test_values_of_before_are_cached_with_their_age_until_the_hash_confirms_them(
    most_told_singly: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A few changes of trust are reported one by one, many by one event."""
    monkeypatch.setattr(followed_component, "SINGLE_CHANGES_MAX", most_told_singly)
    in_simulated_time(confirm)(most_told_singly, tmp_path)


async def confirm(most_told_singly: int, tmp_path: Path) -> None:
    vehicle = small_px4()
    with ParamCache(tmp_path / "cache") as cache:
        async with service(SimLink(vehicle), cache=cache, fetches=True) as (_, browser):
            await met(browser)
            await asyncio.sleep(5)
        assert vehicle.requests["PARAM_REQUEST_LIST"] == 1
        async with service(SimLink(vehicle), cache=cache, policy="cache-only") as (hub, browser):
            await met(browser)
            await asyncio.sleep(2)
            old = (await browser.get(f"{C}/params/PARAM_01")).json()
            assert old["trust"] == "cached"
            kept = cache.component(system=1)
            assert old["heard_at"] == kept.heard_at["PARAM_01"]
        async with service(SimLink(vehicle), cache=cache) as (hub, browser):
            listener = hub.feed.listen()
            await met(browser)
            await browser.post(f"{C}/fetch", json={})
            await asyncio.sleep(1)
            assert (await browser.get(f"{C}/params/PARAM_01")).json()["trust"] == "verified"
            batches = await listener.next(1)
            assert batches is not None
            reported = [json.loads(text) for _, text in batches[0].texts]
            if most_told_singly:
                first, changed = [each for each in reported if each.get("name") == "PARAM_01"]
                assert (first["old"], first["new"]["trust"]) == (None, "cached")
                assert (changed["old"]["trust"], changed["new"]["trust"]) == ("cached", "verified")
            else:
                assert {each["count"] for each in reported if each["type"] == "params"} == {len(VALUES) + 1}
                assert len([each for each in reported if each.get("name") == "PARAM_01"]) == 1
        assert vehicle.requests["PARAM_REQUEST_LIST"] == 1


# fetches and jobs


@in_simulated_time
async def test_two_who_fetch_at_once_cause_one_download_and_one_may_leave() -> None:
    vehicle = generic(burst=1, period=0.1)
    async with service(SimLink(vehicle)) as (hub, browser):
        await met(browser)
        first = asyncio.create_task(browser.post(f"{C}/fetch", json={}))
        second = asyncio.create_task(browser.post(f"{C}/fetch", json={}))
        await asyncio.sleep(1)
        first.cancel()
        await asyncio.sleep(0.5)
        assert sorted(job.state for job in hub.jobs.all) == ["cancelled", "running"]
        result = (await second).json()
        assert result["received"] == len(VALUES)
        assert vehicle.requests["PARAM_REQUEST_LIST"] == 1


@in_simulated_time
async def test_a_download_without_a_waiting_caller_stops() -> None:
    vehicle = generic(burst=1, period=0.2)
    async with service(SimLink(vehicle)) as (hub, browser):
        await met(browser)
        call = asyncio.create_task(browser.post(f"{C}/fetch", json={}))
        await asyncio.sleep(0.5)
        assert (await browser.get(C)).json()["fetch"]["received"] > 0
        call.cancel()
        await asyncio.sleep(0.1)
        assert (await browser.get(C)).json()["fetch"] is None
        assert [job.state for job in hub.jobs.all] == ["cancelled"]


@in_simulated_time
async def test_a_fetch_is_a_job_that_can_be_looked_at_and_cancelled() -> None:
    async with service(SimLink(generic(burst=1, period=0.1))) as (_, browser):
        await met(browser)
        begun = await browser.post(f"{C}/fetch", json={"wait": False})
        assert begun.status_code == 202
        place = begun.headers["location"]
        assert begun.json()["id"] in place
        await asyncio.sleep(1)
        running = JobDoc.model_validate((await browser.get(place)).json())
        assert (running.state, running.kind, running.requested_by) == ("running", "fetch", "local")
        assert running.progress is not None
        another = (await browser.post(f"{C}/fetch", json={"wait": False})).headers["location"]
        assert (await browser.delete(another)).status_code == 204
        await asyncio.sleep(0.1)
        cancelled = (await browser.get(another)).json()
        assert (cancelled["state"], cancelled["problem"]["type"]) == (
            "cancelled",
            "urn:paramclient:cancelled",
        )
        await asyncio.sleep(5)
        done = (await browser.get(place)).json()
        assert done["state"] == "done"
        assert done["result"]["received"] == len(VALUES)
        assert [each["state"] for each in (await browser.get("/api/v1/jobs")).json()["jobs"]] == [
            "done",
            "cancelled",
        ]
        problem(await browser.get("/api/v1/jobs/nonesuch"), 404, "unknown-job")
        problem(await browser.delete("/api/v1/jobs/nonesuch"), 404, "unknown-job")


@in_simulated_time
async def test_a_fetch_that_fails_says_why() -> None:
    vehicle = Tap(generic())
    async with service(SimLink(vehicle)) as (_, browser):
        await met(browser)
        vehicle.is_deaf = True
        reported = problem(await browser.post(f"{C}/fetch", json={}), 504, "no-reply")
        assert reported["attempts"] > 1
        answer = await browser.post(f"{C}/fetch", json={"timeout_s": -1})
        problem(answer, 422, "invalid-request")


@in_simulated_time
async def test_a_call_whose_client_leaves_is_given_up() -> None:
    vehicle = Tap(generic())
    async with service(SimLink(vehicle)) as (hub, browser):
        await met(browser)
        vehicle.is_deaf = True
        call = asyncio.create_task(browser.post(f"{C}/params/PARAM_01/read", json={}))
        await asyncio.sleep(0.05)
        machine = hub.followed[0].component.core.machine
        assert len(machine.reads) == 1
        call.cancel()
        await settled()
        assert len(machine.reads) == 0


# the end


@in_simulated_time
async def test_at_the_end_every_waiting_request_gets_a_response() -> None:
    vehicle = Tap(generic())
    hub = Hub([SimLink(vehicle)], cache=False, fetches=False)
    browser = a_browser(create_app(hub))
    async with hub:
        await met(browser)
        vehicle.is_deaf = True
        calls = [
            asyncio.create_task(browser.post(f"{C}/fetch", json={})),
            asyncio.create_task(browser.put(f"{C}/params/PARAM_01", json={"value": 1})),
            asyncio.create_task(browser.post("/api/v1/find", json={"system": 9, "timeout_s": None})),
        ]
        await asyncio.sleep(0.05)
    for call in calls:
        problem(await call, 503, "closing")
    problem(await browser.get("/api/v1/events"), 503, "closing")


# errors


@pytest.mark.parametrize(
    ("method", "path", "body", "status", "kind"),
    [
        ("GET", "/nothing/here", None, 404, "not-found"),
        ("GET", "/page/../app.py", None, 404, "not-found"),
        ("GET", "/docs/", None, 404, "not-found"),
        ("DELETE", "/health", None, 405, "method-not-allowed"),
        ("GET", "/api/v1/components/0/1", None, 422, "invalid-request"),
        ("GET", "/api/v1/components/x/1", None, 422, "invalid-request"),
        ("GET", "/api/v1/components/1/1", None, 404, "unknown-component"),
        ("POST", "/api/v1/find", "{", 422, "invalid-request"),
        ("POST", "/api/v1/find", '{"sistem": 1}', 422, "invalid-request"),
        ("POST", "/api/v1/find", '{"timeout_s": -1}', 422, "invalid-request"),
        ("GET", "/api/v1/events?system=x", None, 422, "invalid-request"),
    ],
)
def test_every_invalid_request_is_a_problem_document(
    method: str, path: str, body: str | None, status: int, kind: str
) -> None:
    @in_simulated_time
    async def ask() -> None:
        async with service() as (_, browser):
            headers = {"content-type": "application/json"}
            problem(await browser.request(method, path, content=body, headers=headers), status, kind)

    ask()


@in_simulated_time
async def test_an_internal_error_reveals_no_details(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async with service() as (hub, browser):
        monkeypatch.setattr(type(hub), "followed", property(lambda _: dict[str, str]()["the secret"]))
        reported = problem(await browser.get("/api/v1/components"), 500, "internal")
        assert "secret" not in json.dumps(reported)
        assert "the secret" in caplog.text


def test_links_that_cannot_be_are_refused_at_once() -> None:
    for links in (["udpin:0.0.0.0:99999"], ["sim:px4", "sim:px4"]):
        with pytest.raises(UsageError):
            Hub(links, cache=False)
    with pytest.raises(UsageError):
        Hub(["sim:px4"], cache=False, policy="often")


# the service itself


@in_simulated_time
async def test_its_numbers_are_in_the_format_of_prometheus() -> None:
    async with service(SimLink(small_px4(), 'sim:"odd\\one"')) as (_, browser):
        await met(browser)
        await browser.post(f"{C}/fetch", json={})
        answer = await browser.get("/metrics")
        assert answer.headers["content-type"] == "text/plain; version=0.0.4; charset=utf-8"
        kinds = dict(re.findall(r"^# TYPE (\S+) (\w+)$", answer.text, re.MULTILINE))
        sample = re.compile(r'(\w+)(\{(\w+="([^"\\\n]|\\[\\"n])*",?)+\})? -?[0-9.e+-]+')
        numbers = {}
        for line in answer.text.splitlines():
            if not line.startswith("#"):
                found = sample.fullmatch(line)
                assert found, line
                assert found[1] in kinds
                assert (kinds[found[1]] == "counter") == found[1].endswith("_total")
                numbers[line.rpartition(" ")[0]] = float(line.rpartition(" ")[2])
        link = r'{link="sim:\"odd\\one\""}'
        assert numbers[f"paramclient_link_downloads_total{link}"] == 1
        labels = r'component="1",link="sim:\"odd\\one\"",system="1"'
        assert numbers[f"paramclient_component_parameters{{{labels}}}"] == 25


@in_simulated_time
async def test_health_says_what_may_be_known() -> None:
    async with service(SimLink(generic(), "sim:a")) as (_, browser):
        await met(browser)
        reported = (await browser.get("/health")).json()
        assert reported["status"] == "ok"
        assert reported["links"] == [{"name": "sim:a", "state": "open"}]


@in_simulated_time
async def test_the_document_of_the_api_names_everything() -> None:
    async with service() as (_, browser):
        document = (await browser.get("/openapi.json")).json()
        assert document["openapi"].startswith("3.1")
        assert "HTTPValidationError" not in document["components"]["schemas"]
        operations = [each for path in document["paths"].values() for each in path.values()]
        assert all(each["summary"] and each["description"] for each in operations)
        for each in operations:
            assert "application/problem+json" in each["responses"]["default"]["content"]


@in_simulated_time
async def test_the_page_of_the_api_needs_nothing_from_elsewhere() -> None:
    async with service() as (_, browser):
        page = await browser.get("/docs")
        assert page.headers["content-type"] == "text/html; charset=utf-8"
        policy = page.headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        names = re.findall(r'(?:src|href)="([^"]+)"', page.text)
        assert names
        for name in names:
            if name == "data:,":
                continue
            assert name.startswith("/docs/")
            part = await browser.get(name)
            assert part.status_code == 200
            assert "http" not in part.text.replace("http://www.w3.org/", "")
            assert "innerHTML" not in part.text
            again = await browser.get(name, headers={"if-none-match": part.headers["etag"]})
            assert again.status_code == 304
        assert "<script>" not in page.text
        assert " on" not in re.sub(r">[^<]*<", "><", page.text)


@in_simulated_time
async def test_every_answer_forbids_a_browser_to_make_a_program_of_it() -> None:
    async with service() as (hub, browser):
        for path in ("/health", "/api/v1/components", "/nothing", "/docs", "/metrics"):
            headers = (await browser.get(path)).headers
            assert headers["x-content-type-options"] == "nosniff"
            assert headers["content-security-policy"].startswith("default-src 'none'")
            assert headers["x-seq"] == str(hub.feed.position)
