"""Files, plans, apply, restore, snapshots and history over HTTP."""

from __future__ import annotations

import asyncio
import base64
from pathlib import Path
from typing import Any

import pytest

from paramclient.files import FileFormat, loads
from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle
from paramclient.wire.messages import ParamSet
from tests.commands import behind, in_process, leaping
from tests.service.hub import V, browsing, problem, service, until
from tests.shell import VALUES, Tap, generic, in_simulated_time, small_px4


@pytest.fixture
def cache(tmp_path: Path) -> str:
    return str(tmp_path / "cache.sqlite3")


@pytest.mark.parametrize("file_format", list(FileFormat))
async def test_a_table_is_saved_in_every_format_and_read_again(file_format: FileFormat) -> None:
    async with browsing(generic()) as browser:
        answer = await browser.get(f"{V}/file", params={"format": file_format.value})
        assert answer.headers["content-disposition"].startswith('attachment; filename="generic-1-1-')
        (found,) = loads(answer.content, file_format=file_format).sets
        assert {name: each.value for name, each in found.items()} == VALUES
        body = {"name": "", "base64": base64.b64encode(answer.content).decode()}
        read = (await browser.post("/api/files", json=body)).json()
        assert read["format"] == file_format
        (component,) = read["components"]
        assert {name: each["value"] for name, each in component["params"].items()} == VALUES


async def test_only_what_differs_from_the_defaults_is_saved() -> None:
    async with browsing(vehicle := ArduPilotVehicle()) as browser:
        await browser.patch(f"{V}/params", json={"values": {"RTL_ALT": 2345}})
        answer = await browser.get(f"{V}/file", params={"format": "parm", "changed": "true"})
        lines = [line.split() for line in answer.text.splitlines() if not line.startswith("#")]
        assert ["RTL_ALT", "2345"] in [words[:2] for words in lines]
        assert 0 < len(lines) < len(vehicle.values)


async def test_a_file_with_a_name_that_no_vehicle_can_have_is_shown_and_not_applied() -> None:
    async with browsing(vehicle := generic()) as browser:
        file = {"name": "a.parm", "text": "PARAM_04 44\nSIM_GPS1_BYTELOSS 0\n"}
        read = (await browser.post("/api/files", json=file)).json()
        assert [list(each["params"]) for each in read["components"]] == [["PARAM_04"]]
        assert read["notes"][0].startswith("line 2: ")
        assert (await browser.post(f"{V}/apply", json={"file": file})).status_code == 422
        assert vehicle.requests["PARAM_SET"] == 0


async def test_a_file_of_several_vehicles_gives_the_set_of_these_ids_and_no_other() -> None:
    rows = [(2, 1, 22), (1, 5, 55), (1, 1, 11)]
    text = "".join(f"{system}\t{component}\tPARAM_04\t{value}\t6\n" for system, component, value in rows)
    file = {"name": "a.params", "text": text}
    async with browsing(generic()) as browser:
        plan = (await browser.post(f"{V}/plan", json={"file": file})).json()
        assert plan["params"]["PARAM_04"]["wanted"] == 11
        problem(await browser.post(f"{V}/plan", json={"file": file | {"component": 5}}), 422, "usage-error")


async def test_an_apply_is_limited_to_names_and_refuses_values_out_of_range(cache: str) -> None:
    vehicle = PX4Vehicle(metadata=True)
    async with browsing(vehicle, cache=cache) as browser:
        await browser.post(f"{V}/fetch", json={"metadata": True})
        high = (await browser.get(f"{V}/params/MC_ROLL_P")).json()["metadata"]["maximum"] + 1
        body: dict[str, Any] = {"values": {"MC_ROLL_P": high, "MC_PITCH_P": 5.0}}
        problem(await browser.post(f"{V}/apply", json=body), 422, "invalid-parameters")
        assert vehicle.param("MC_PITCH_P").value != 5.0
        done = (await browser.post(f"{V}/apply", json={**body, "only": ["MC_PITCH*"]})).json()
        assert list(done["params"]) == ["MC_PITCH_P"]
        for value, forced in ((high, {"include": ["MC_ROLL_P"]}), (high + 1, {"force": True})):
            body["values"]["MC_ROLL_P"] = value
            done = (await browser.post(f"{V}/apply", json={**body, **forced})).json()
            assert done["params"]["MC_ROLL_P"]["status"] == "accepted"
        for at, status in (("", 200), ("&at=2", 422)):  # perhaps of another firmware
            assert (await browser.get(f"{V}/file?changed=true{at}")).status_code == status


async def test_a_restore_goes_back_to_before_the_last_apply_once(cache: str) -> None:
    vehicle = generic()
    async with browsing(vehicle, cache=cache) as browser:
        problem(await browser.post(f"{V}/restore", json={}), 404, "not-in-cache")
        await browser.post(f"{V}/apply", json={"values": {"PARAM_04": 44}})
        assert (await browser.post(f"{V}/restore", json={})).json()["complete"]
        assert vehicle.param("PARAM_04").value == 4
        again = problem(await browser.post(f"{V}/restore", json={}), 409, "already-restored")
        assert (await browser.post(f"{V}/restore", json={"at": again["before_restore"]})).json()["complete"]
        assert vehicle.param("PARAM_04").value == 44


async def test_snapshots_are_stored_listed_read_and_applied(cache: str) -> None:
    async with browsing(small_px4(), cache=cache) as browser:
        made = await browser.post(f"{V}/snapshots", json={"reason": "before the flight"})
        assert made.status_code == 201
        await browser.put(f"{V}/params/PARAM_04", json={"value": 44})
        (kept,) = (await browser.get(f"{V}/snapshots")).json()["snapshots"]
        assert made.json() == kept
        assert (kept["reason"], kept["size"], kept["complete"]) == ("before the flight", 25, True)
        query = {"at": kept["id"]}
        assert (await browser.get(f"{V}/params", params=query)).json()["params"]["PARAM_04"]["value"] == 4
        plan = (await browser.post(f"{V}/plan", json=query)).json()
        assert [name for name, each in plan["params"].items() if each["status"] == "set"] == ["PARAM_04"]
        assert "PARAM_04\t4\t" in (await browser.get(f"{V}/file", params=query)).text
        problem(await browser.get(f"{V}/params?at=99"), 404, "not-in-cache")
    # the identity of one far away comes behind the first heartbeat
    async with service(Air.symmetric([small_px4()], delay=1.0), cache=cache, fetches=False) as (_, browser):
        await until(browser, "/api/vehicles", lambda found: bool(found["vehicles"]))
        assert (await browser.get(f"{V}/snapshots")).json()["snapshots"] == [kept]


async def test_there_is_no_snapshot_of_no_parameters(cache: str) -> None:
    async with service(generic(), cache=cache, fetches=False) as (_, browser):
        await until(browser, V, lambda found: found["state"] == "new")
        problem(await browser.post(f"{V}/snapshots", json={"reason": "none"}), 422, "usage-error")


async def test_history_has_changes_of_all_or_of_one_name(cache: str) -> None:
    sets = [("PARAM_04", 9), ("PARAM_05", 8), ("PARAM_04", 7)]
    async with browsing(generic(), cache=cache) as browser:
        for name, value in sets:
            await browser.put(f"{V}/params/{name}", json={"value": value, "durable": True})
            await asyncio.sleep(1)
        lines = (await browser.get(f"{V}/history")).json()["history"]
        assert [(each["name"], each["new"]) for each in lines] == sets
        of_one = (await browser.get(f"{V}/history?name=PARAM_04&limit=1")).json()["history"]
        assert [(each["old"], each["new"]) for each in of_one] == [(9, 7)]
        since = (await browser.get(f"{V}/history", params={"since": lines[1]["time"]})).json()["history"]
        assert since == lines[1:]
        before = (await browser.get(f"{V}/params", params={"at": lines[1]["time"]})).json()["params"]
        assert before["PARAM_04"]["value"] == 9


async def test_without_a_cache_the_past_is_a_problem() -> None:
    async with browsing(generic()) as browser:
        for what in ("history", "snapshots"):
            problem(await browser.get(f"{V}/{what}"), 409, "no-cache")
        problem(await browser.post(f"{V}/restore", json={}), 409, "no-cache")


async def test_a_vehicle_is_set_up_by_one_at_a_time(cache: str) -> None:
    async with browsing(generic(), cache=cache) as browser:
        bodies = [{"values": {"PARAM_04": number}} for number in (8, 9)]
        posts = [browser.post(f"{V}/apply", json=body) for body in bodies]
        done, *others = await asyncio.gather(*posts, browser.post(f"{V}/restore", json={}))
        assert done.status_code == 200
        for each in others:
            problem(each, 409, "busy")
        assert (await browser.post(f"{V}/apply", json=bodies[0])).status_code == 200


async def test_an_armed_vehicle_is_set_up_only_if_that_is_allowed(cache: str) -> None:
    async with service(generic(armed=True), cache=cache) as (_, browser):
        await until(browser, V, lambda found: found["is_armed"] is True and found["state"] == "synced")
        body: dict[str, Any] = {"values": {"PARAM_04": 9}}
        problem(await browser.post(f"{V}/apply", json=body), 409, "vehicle-armed")
        assert (await browser.post(f"{V}/apply", json={**body, "allow_armed": True})).json()["complete"]


async def test_a_client_that_leaves_ends_its_apply_and_frees_the_vehicle(cache: str) -> None:
    tap = Tap(generic())
    async with browsing(tap, cache=cache) as browser:
        tap.is_mute = True
        body = {"values": {"PARAM_04": 44, "PARAM_05": 55}}
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.5):
                await browser.post(f"{V}/apply", json=body)
        tap.is_mute = False
        tap.received.clear()
        await asyncio.sleep(2)
        assert not tap.messages(ParamSet)
        assert (await browser.post(f"{V}/apply", json=body)).json()["complete"]


def test_what_is_returned_is_what_the_command_prints(
    cache: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """But for times, bytes and authors."""
    file = tmp_path / "a.parm"
    file.write_text("PARAM_04 44\nPARAM_05 5\nNONE 1\n")
    with monkeypatch.context() as patches:
        leaping(patches)
        url = behind(patches, "sim:px4")(small_px4())
        command = in_process(capsys, "--cache", f"{cache}-of-the-command", "--json")
        printed = [
            command("fetch", url).json,
            command("set", url, "PARAM_03", 9, "NONE", 1).json,
            command("apply", url, file, "--dry-run", "--partial").json,
            command("apply", url, file, "--partial").json,
            command("history", "1", "--snapshots").json,
            command("restore", url).json,
            command("history", "1").json,
        ]
        printed += command("get", url, "PARAM_03").json["params"].values()

    @in_simulated_time
    async def requested() -> list[Any]:
        async with service(small_px4(), cache=cache, fetches=False) as (_, browser):
            await until(browser, V, lambda found: found["firmware"] is not None)
            wanted = {"file": {"text": file.read_text(), "name": "a.parm"}}
            answers = [
                await browser.post(f"{V}/fetch", json={}),
                await browser.patch(f"{V}/params", json={"values": {"PARAM_03": 9, "NONE": 1}}),
                await browser.post(f"{V}/plan", json=wanted),
                await browser.post(f"{V}/apply", json=wanted | {"partial": True}),
                await browser.get(f"{V}/snapshots"),
                await browser.post(f"{V}/restore", json={}),
                await browser.get(f"{V}/history"),
                await browser.get(f"{V}/params/PARAM_03"),
            ]
            return [each.json() for each in answers]

    *documents, param = requested()
    *others, read = printed
    assert [*map(lasting, documents)] == [*map(lasting, others)]
    assert param == {"name": "PARAM_03", "trust": "live", **read}


def lasting(document: Any) -> Any:
    """A document without what differs from one time to another."""
    if isinstance(document, list):
        return [lasting(each) for each in document]
    left_out = {"elapsed_s", "round_trip_s", "bytes_received", "bytes_sent", "time", "at", "by"}
    if isinstance(document, dict):
        return {key: lasting(each) for key, each in document.items() if key not in left_out}
    return document
