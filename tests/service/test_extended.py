"""Extended parameters over HTTP: what the service returns, what it writes, how it fails."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import httpx
import pytest

from paramclient.documents.extended_param import ExtParamDoc
from paramclient.model.ext_params import ExtParam
from paramclient.service import AccessSettings, Hub, Settings, Tokens, create_app
from paramclient.sim import Air, Camera, PX4Vehicle, camera_table
from tests.asgi import a_browser
from tests.service.test_events import ReceivedEvents, listening
from tests.service_hub import met, problem, service
from tests.shell import generic, in_simulated_time

E = "/api/v1/components/1/100/extended"


async def put(browser: httpx.AsyncClient, name: str, value: Any) -> dict[str, Any]:
    answer = await browser.put(f"{E}/params/{name}", json={"value": value})
    assert answer.status_code == 200, answer.text
    done: dict[str, Any] = answer.json()
    return done


@in_simulated_time
async def test_the_known_table() -> None:
    camera = Camera()
    async with service(camera) as (hub, browser):
        found = await met(browser, system=1, component=100)
        nothing = {"is_spoken": False, "is_expected": True, "is_complete": False, "count": None, "params": 0}
        assert found["extended"] == nothing
        assert (await browser.get(f"{E}/params")).json()["params"] == {}
        fetched = (await browser.post(f"{E}/fetch", json={})).json()
        assert (fetched["source"], fetched["count"], fetched["received"], fetched["missing"]) == (
            *("stream", 16, 16),
            [],
        )
        table = (await browser.get(f"{E}/params")).json()
        assert table["run"] == hub.feed.run
        assert list(table["params"]) == list(camera_table())
        for name, param in camera.ext_params.items():
            reported = table["params"][name]
            assert ExtParamDoc.model_validate(reported).param(name) == param
            assert (reported["name"], reported["trust"]) == (name, "live")
            assert reported["heard_at"] > 1_700_000_000
        params = table["params"]
        assert params["CAM_CLOCK"]["value"] == 1_700_000_000_123_456_789
        assert params["CAM_NAME"]["value"] == "Front camera"
        assert (params["CAM_LICENSE"]["value"], params["CAM_LICENSE"]["hex"][:6]) == (None, "010203")
        assert (await browser.get(f"{E}/params/CAM_NAME")).json() == params["CAM_NAME"]
        some = (await browser.get(f"{E}/params", params={"names": ["CAM_S*", "CAM_EV"]})).json()["params"]
        assert set(some) == {"CAM_SHUTTERSPD", "CAM_STORAGE", "CAM_STREAM_URI", "CAM_EV"}
        state = (await browser.get("/api/v1/components/1/100")).json()["extended"]
        assert (state.pop("count"), state.pop("params")) == (16, 16)
        assert state == {"is_spoken": True, "is_expected": True, "is_complete": True}
        assert (await browser.get("/api/v1/components/1/100/params")).json()["params"] == {}
        reported = problem(await browser.get(f"{E}/params/CAM_NAMES"), 404, "unknown-parameter")
        assert reported["nearest"][0] == "CAM_NAME"


@in_simulated_time
async def test_one_is_read_by_name_and_by_index() -> None:
    async with service(Camera()) as (_, browser):
        await met(browser, system=1, component=100)
        one = (await browser.post(f"{E}/params/CAM_NAME/read", json={})).json()
        assert (one["value"], one["index"], one["type"]) == ("Front camera", 13, "CUSTOM")
        for path, body in (("params/%233/read", {}), ("read", {"index": 3}), ("read", {"name": "CAM_ISO"})):
            assert (await browser.post(f"{E}/{path}", json=body)).json()["name"] == "CAM_ISO"
        problem(await browser.post(f"{E}/read", json={}), 422, "usage")
        answer = await browser.post(f"{E}/read", json={"name": "NO_SUCH", "timeout_s": 1})
        assert problem(answer, 504, "no-reply")["error"] == "NoReply"


@in_simulated_time
async def test_values_of_every_kind_are_written_exactly() -> None:
    camera = Camera()
    async with service(camera) as (_, browser):
        await met(browser, system=1, component=100)
        wide = await put(browser, "CAM_CLOCK", -(2**63) + 1)
        assert (wide["status"], wide["requested"], wide["actual"]) == ("accepted", *(2 * [-(2**63) + 1]))
        assert camera.ext_values["CAM_CLOCK"] == -(2**63) + 1
        await put(browser, "CAM_STORAGE", {"number": "18446744073709551615"})
        assert camera.ext_values["CAM_STORAGE"] == 2**64 - 1
        assert (await put(browser, "CAM_NAME", "Rück\t1"))["param"]["hex"] == "52c3bc636b0931"
        assert camera.ext_values["CAM_NAME"] == "Rück\t1"
        taken = await put(browser, "CAM_LICENSE", {"hex": "ff00fe"})
        assert (taken["actual"], taken["param"]["hex"]) == (None, "ff00fe")
        assert camera.ext_values["CAM_LICENSE"] == b"\xff\x00\xfe"
        full = b"\x80" + 127 * b"\x11"
        await put(browser, "CAM_LICENSE", {"hex": full.hex()})
        assert camera.ext_values["CAM_LICENSE"] == full, "256 digits"
        assert (await put(browser, "CAM_FOCAL_LEN", 0.1))["actual"] == 0.1
        assert (await put(browser, "CAM_EV", "NaN"))["actual"] == "NaN"
        assert (await put(browser, "CAM_EV", {"number": "-Infinity"}))["actual"] == "-Infinity"
        assert (await put(browser, "CAM_NAME", "NaN"))["actual"] == "NaN"
        assert camera.ext_values["CAM_NAME"] == "NaN", "text for a parameter that holds text"


@pytest.mark.parametrize(
    ("name", "value", "kind"),
    [
        ("CAM_EXPMODE", 256, "usage"),
        ("CAM_EXPMODE", "5", "usage"),
        ("CAM_EXPMODE", {"hex": "05"}, "usage"),
        ("CAM_MODE", 0.5, "usage"),
        ("CAM_MODE", "NaN", "usage"),
        ("CAM_NAME", 5, "usage"),
        ("CAM_NAME", {"number": "NaN"}, "usage"),
        ("CAM_NAME", "ä" * 65, "usage"),
        ("CAM_NAME", "a\0b", "usage"),
        ("CAM_NAME", "x" * 129, "invalid-request"),
        ("CAM_NAME", {"hex": "0"}, "invalid-request"),
        ("CAM_NAME", {"hex": "0f" * 129}, "invalid-request"),
        ("CAM_NAME", {"hex": "00", "number": "1"}, "invalid-request"),
        ("CAM_MODE", {"number": "0x10"}, "invalid-request"),
        ("CAM_MODE", None, "invalid-request"),
        ("CAM_MODE", True, "invalid-request"),
        ("CAM_MODE", [1], "invalid-request"),
    ],
)
@in_simulated_time
async def test_a_value_that_does_not_fit_is_refused_and_nothing_is_sent(
    name: str, value: Any, kind: str
) -> None:
    camera = Camera()
    async with service(camera) as (_, browser):
        await met(browser, system=1, component=100)
        problem(await browser.put(f"{E}/params/{name}", json={"value": value}), 422, kind)
        answer = await browser.patch(f"{E}/params", json={"values": {name: value}})
        if kind == "usage":
            assert answer.json()["results"][name]["status"] == "refused"
        else:
            problem(answer, 422, kind)
        assert camera.requests["PARAM_EXT_SET"] == 0
        assert camera.ext_values == Camera().ext_values


@in_simulated_time
async def test_many_are_written_in_one_request() -> None:
    camera = Camera(
        {"A": 1, "B": 2, "C": 3, "D": "text", "E": b"\xff"},
        supported={"A": [1, 2]},
        failing=["B"],
        limits={"C": (0, 5)},
    )
    async with service(camera) as (_, browser):
        await met(browser, system=1, component=100)
        values = {"A": 9, "B": 1, "C": 9, "D": 5, "NO/NAME": 1, "": 1, "E": {"hex": "fe"}}
        problem(await browser.patch(f"{E}/params", json={"values": values}), 422, "invalid-request")
        del values[""]
        done = (await browser.patch(f"{E}/params", json={"values": values})).json()
        results = done["results"]
        assert list(results) == list(values)
        assert [each["status"] for each in results.values()] == [
            *("refused", "refused", "adjusted", "refused", "refused", "accepted"),
        ]
        errors = [each.get("problem", {}).get("error") for each in results.values()]
        assert errors == ["ValueUnsupported", "SetFailed", None, "UsageError", "UnknownParameter", None]
        assert results["A"]["problem"]["reason"] == "value unsupported"
        assert results["A"]["problem"]["status"] == 409
        assert results["C"]["actual"] == 5
        assert "problem" not in done
        assert camera.ext_values["E"] == b"\xfe"
        problem(await browser.put(f"{E}/params/A", json={"value": 9}), 409, "value-unsupported")


@in_simulated_time
async def test_a_timeout_leaves_the_rest_open() -> None:
    camera = Camera({"A": 1, "B": 2}, slow={"A": 100.0})
    async with service(camera) as (hub, browser):
        await met(browser, system=1, component=100)
        body = {"values": {"A": 7, "B": 7}, "timeout_s": 1.0}
        done = (await browser.patch(f"{E}/params", json=body)).json()
        assert [each["status"] for each in done["results"].values()] == ["unknown", "accepted"]
        assert done["problem"]["error"] == "NoReply"
        assert not hub.followed[0].component.core.machine.is_busy


@in_simulated_time
async def test_a_fetch_is_a_job_that_readers_may_cancel() -> None:
    camera = Camera({f"P{number:03}": number for number in range(200)}, burst=1, period=0.05)
    tokens = Tokens.of_text("anna write anna-may-write-0123456789\nben read ben-may-read-0123456789ab\n")
    async with service(camera) as (hub, browser):
        await met(browser, system=1, component=100)
        app = create_app(hub, Settings(access=AccessSettings(tokens=tokens)))
        async with a_browser(app) as guarded:
            guarded.headers["Authorization"] = "Bearer ben-may-read-0123456789ab"
            started = await guarded.post(f"{E}/fetch", json={"wait": False})
            assert started.status_code == 202
            job = started.json()
            assert (job["kind"], job["state"]) == ("extended-fetch", "running")
            await asyncio.sleep(2)
            progress = (await guarded.get(started.headers["location"])).json()["progress"]
            assert 0 < progress["received"] < progress["total"] == 200
            assert (await guarded.delete(started.headers["location"])).status_code == 204
            await asyncio.sleep(0.1)
            assert (await guarded.get(started.headers["location"])).json()["state"] == "cancelled"
            assert not hub.followed[0].component.core.machine.ext.is_busy
            assert (await guarded.get(f"{E}/params")).status_code == 200
            assert (await guarded.post(f"{E}/read", json={"name": "P000"})).status_code == 200
            for refused in (
                await guarded.put(f"{E}/params/P000", json={"value": 1}),
                await guarded.patch(f"{E}/params", json={"values": {"P000": 1}}),
            ):
                problem(refused, 403, "forbidden")
        assert camera.ext_values["P000"] == 0


@in_simulated_time
async def test_a_write_has_the_name_of_its_author() -> None:
    async with service(Camera()) as (hub, browser):
        await met(browser, system=1, component=100)
        await browser.post(f"{E}/fetch", json={})
        changes = hub.followed[0].component.ext.changes()
        await put(browser, "CAM_ISO", 400)
        change = await anext(changes)
        assert (change.new and change.new.value, change.by) == (400, "us for local")


@in_simulated_time
async def test_a_component_without_extended_parameters() -> None:
    async with service(generic()) as (_, browser):
        found = await met(browser)
        assert found["extended"]["is_expected"] is False
        answer = await browser.post("/api/v1/components/1/1/extended/fetch", json={"timeout_s": 2})
        assert problem(answer, 504, "no-reply")["error"] == "NoReply"


@in_simulated_time
async def test_the_history_of_a_component(tmp_path: Path) -> None:
    async with service(Camera(), cache=tmp_path / "cache") as (_, browser):
        await met(browser, system=1, component=100)
        await browser.post(f"{E}/fetch", json={})
        for value in (200, 400):
            await put(browser, "CAM_ISO", value)
        await put(browser, "CAM_LICENSE", {"hex": "ff"})
        lines = (await browser.get(f"{E}/history")).json()["history"]
        assert [(line["name"], line["old"]["hex"][:8], line["new"]["hex"]) for line in lines] == [
            ("CAM_ISO", "64000000", "c8000000"),
            ("CAM_ISO", "c8000000", "90010000"),
            ("CAM_LICENSE", "01020304", "ff"),
        ]
        assert {(line["by"], line["component"]) for line in lines} == {("us for local", 100)}
        one = (await browser.get(f"{E}/history", params={"name": "CAM_ISO", "limit": 1})).json()["history"]
        assert one == lines[1:2]
        late = await browser.get(f"{E}/history", params={"since": lines[-1]["at"] + 1})
        assert late.json()["history"] == []
        problem(await browser.get(f"{E}/history", params={"limit": 0}), 422, "invalid-request")
    async with service(Camera()) as (_, browser):
        await met(browser, system=1, component=100)
        problem(await browser.get(f"{E}/history"), 409, "no-cache")


# events


@in_simulated_time
async def test_a_listener_receives_the_events_of_values_and_of_their_fetch() -> None:
    camera = Camera(burst=1, period=0.1)
    async with service(camera) as (hub, browser), listening(browser) as received:
        await met(browser, system=1, component=100)
        await browser.post(f"{E}/fetch", json={})
        done = await browser.put(f"{E}/params/CAM_CLOCK", json={"value": 2**62 + 1})
        await asyncio.sleep(2)
        changes = received.of("extended_change")
        assert [each["name"] for each in changes] == [*camera_table(), "CAM_CLOCK"], "one for each value"
        assert [each["new"]["index"] for each in changes[:-1]] == list(range(16))
        assert {each["kind"] for each in changes} == {"changed"}
        last = changes[-1]
        assert (last["old"]["value"], last["new"]["value"]) == (1_700_000_000_123_456_789, 2**62 + 1)
        assert (last["by"], last["system"], last["component"]) == ("us for local", 1, 100)
        assert last["seq"] <= int(done.headers["x-seq"].partition("-")[2])
        assert ExtParamDoc.model_validate(last["new"]).param("CAM_CLOCK") == done_param(hub, "CAM_CLOCK")
        progress = received.of("extended_progress")
        assert [each["received"] for each in progress] == sorted(each["received"] for each in progress)
        assert (progress[-1]["done"], progress[-1]["total"]) == (True, 16)
        assert 4 <= len(progress) <= 16  # of 1.6 seconds
        states = [each["component_doc"]["extended"] for each in received.of("component")]
        assert states[0]["count"] is None
        assert (states[-1]["count"], states[-1]["is_complete"], states[-1]["is_spoken"]) == (16, True, True)
        assert received.of("change") == []
        assert [each["job"]["kind"] for each in received.of("job")] == ["extended-fetch"] * 2


@in_simulated_time
async def test_a_listener_may_ask_for_extended_parameters_alone() -> None:
    air = Air.symmetric([Camera(), PX4Vehicle(table={"A": 1}), Camera(system=2)])
    async with (
        service(air) as (_, browser),
        listening(browser, types="extended_change", system=1) as received,
        listening(browser, types="extended_change", component=1) as other,
    ):
        for system in (1, 2):
            await met(browser, system=system, component=100)
            await browser.post(f"/api/v1/components/{system}/100/extended/fetch", json={})
        await met(browser, system=1, component=1)
        await browser.post("/api/v1/components/1/1/fetch", json={})
        await asyncio.sleep(1)
        reported = received.all[1:]
        assert {(each["type"], each["system"]) for each in reported} == {("extended_change", 1)}
        assert len(reported) == 16
        assert other.all[1:] == []


@in_simulated_time
async def test_parameters_that_appear_and_disappear() -> None:
    camera = Camera({"A": 1, "B": 2})
    async with service(camera) as (_, browser), listening(browser) as received:
        await met(browser, system=1, component=100)
        await browser.post(f"{E}/fetch", json={})
        camera.remove_ext_param("A")
        await browser.post(f"{E}/fetch", json={})
        (removed,) = (each for each in await reported(received) if each["kind"] == "removed")
        assert (removed["name"], removed["old"]["value"], removed["new"]) == ("A", 1, None)
        camera.add_ext_param("C", 7)
        await browser.post(f"{E}/fetch", json={})
        (added,) = (each for each in await reported(received) if each["kind"] == "added")
        assert (added["name"], added["old"], added["new"]["value"]) == ("C", None, 7)


@in_simulated_time
async def test_the_trust_of_many_is_reported_at_once_and_that_of_few_singly() -> None:
    for count, singly in ((32, True), (33, False)):
        camera = Camera({f"P{number:02}": number for number in range(count)})
        async with service(camera) as (_, browser), listening(browser) as received:
            await met(browser, system=1, component=100)
            await browser.post(f"{E}/fetch", json={})
            await reported(received)
            before = len(received.all)
            camera.reboot(down=8)
            await asyncio.sleep(20)
            events = [each for each in received.all[before:] if each["type"].startswith("extended")]
            if singly:
                assert [(each["type"], each["new"]["trust"]) for each in events] == 32 * [
                    ("extended_change", "cached")
                ]
            else:
                assert [(each["type"], each["count"]) for each in events] == [("extended_params", 33)]
            table = (await browser.get(f"{E}/params")).json()["params"]
            assert {each["trust"] for each in table.values()} == {"cached"}


@in_simulated_time
async def test_a_published_table_is_not_compared_again_for_each_request() -> None:
    """Many requests may end at once, and each publishes the changes before its response."""

    class Counted(dict[str, ExtParam]):
        looks = 0

        def get(self, name: str, default: Any = None) -> Any:
            self.looks += 1
            return super().get(name, default)

    camera = Camera({f"P{number:02}": number for number in range(40)})
    async with service(camera) as (hub, browser), listening(browser) as received:
        await met(browser, system=1, component=100)
        await browser.post(f"{E}/fetch", json={})
        extended = hub.followed[0].extended
        extended._published = counted = Counted(extended._published)
        answers = await asyncio.gather(*[browser.get(f"{E}/params") for _ in range(10)])
        assert {answer.status_code for answer in answers} == {200}
        assert counted.looks == 0
        hub.followed[0].component.core.machine.ext.table.doubt()
        await asyncio.gather(*[browser.get(f"{E}/params") for _ in range(10)])
        assert counted.looks == 40
        await reported(received)
        assert [each["count"] for each in received.of("extended_params")][-1] == 40


async def reported(received: ReceivedEvents) -> list[dict[str, Any]]:
    """The changes of extended parameters so far."""
    await asyncio.sleep(2)
    return received.of("extended_change")


def done_param(hub: Hub, name: str) -> ExtParam:
    return hub.followed[0].extended.ext.params[name]


@in_simulated_time
async def test_a_set_up_over_http(tmp_path: Path) -> None:
    camera = Camera({"MODE": 1, "NAME": "Front", "KEY": b"\xff\0\xfe", "EV": 0.5}, failing=["EV"])
    before = camera.ext_values
    async with service(camera, cache=tmp_path / "cache") as (_, browser):
        await met(browser, system=1, component=100)
        wanted: dict[str, Any] = {
            "MODE": {"type": "INT32", "value": 2},
            "KEY": {"type": "CUSTOM", "hex": "00ff"},
            "EV": {"type": "REAL32", "value": 2.5},
            "NAME": {"type": "INT32", "value": 5},
            "LOST": {"type": "CUSTOM", "value": "x"},
        }
        plan = (await browser.post(f"{E}/plan", json={"wanted": wanted})).json()
        assert list(plan["changes"]) == ["MODE", "KEY", "EV"]
        assert (plan["is_met"], plan["missing"], plan["mistyped"]) == (False, ["LOST"], ["NAME"])
        assert camera.ext_values == before
        done = (await browser.post(f"{E}/apply", json={"wanted": wanted})).json()
        assert {name: each["status"] for name, each in done["results"].items()} == {
            "MODE": "accepted",
            "KEY": "accepted",
            "EV": "refused",
        }
        assert done["results"]["EV"]["problem"]["error"] == "SetFailed"
        assert (done["complete"], done["different"]) == (False, ["EV"])
        assert (camera.ext_values["MODE"], camera.ext_values["KEY"]) == (2, b"\0\xff")
        listed = (await browser.get(f"{E}/snapshots")).json()["snapshots"]
        assert [(each["id"], each["reason"], each["size"]) for each in listed] == [
            (done["snapshot"], "before apply", 4)
        ]
        made = await browser.post(f"{E}/snapshots", json={"reason": "by hand"})
        assert (made.status_code, made.json()["snapshot"] > done["snapshot"]) == (201, True)
        state = (await browser.post(f"{E}/state", json={"snapshot": made.json()["snapshot"]})).json()
        assert (state["component"], state["params"]["MODE"]["value"]) == (100, 2)
        restored = (await browser.post(f"{E}/restore", json={})).json()
        assert (restored["complete"], camera.ext_values) == (True, before)
        history = (await browser.get(f"{E}/history")).json()["history"]
        assert "for" in history[-1]["by"], "the author is the one of the request"
        for path in ("restore", "state"):
            problem(await browser.post(f"{E}/{path}", json={}), 409, "already-restored")
        problem(await browser.post(f"{E}/restore", json={"snapshot": 99}), 404, "unknown-state")
        problem(await browser.post(f"{E}/restore", json={"snapshot": 1, "at": 5}), 422, "invalid-request")
        bad = {"wanted": {"MODE": {"type": "INT32", "value": "text"}}}
        problem(await browser.post(f"{E}/apply", json=bad), 422, "usage")


@in_simulated_time
async def test_a_service_without_a_cache_has_no_earlier_states() -> None:
    async with service(Camera({"A": 1})) as (_, browser):
        await met(browser, system=1, component=100)
        problem(await browser.get(f"{E}/snapshots"), 422, "usage")
        wanted = {"A": {"type": "INT32", "value": 2}}
        done = (await browser.post(f"{E}/apply", json={"wanted": wanted})).json()
        assert (done["complete"], done["snapshot"]) == (True, None)


@in_simulated_time
async def test_only_writers_may_restore(tmp_path: Path) -> None:
    async with Hub([Camera({"A": 1})], cache=tmp_path / "cache", fetches=False) as hub:
        app = create_app(hub, Settings(access=AccessSettings(read_only=True)))
        async with a_browser(app) as browser:
            await met(browser, system=1, component=100)
            wanted = {"A": {"type": "INT32", "value": 1}}
            for path, body in (
                ("apply", {"wanted": wanted}),
                ("restore", {}),
                ("snapshots", {"reason": "x"}),
            ):
                problem(await browser.post(f"{E}/{path}", json=body), 403, "read-only")
            assert (await browser.post(f"{E}/plan", json={"wanted": wanted})).json()["is_met"]
