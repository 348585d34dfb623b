"""Set-ups, files and the past over HTTP, with vehicles of both autopilots."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import anyio
import httpx
import pytest

from paramclient import ParamCache
from paramclient.cache import TableState, TableUpdate
from paramclient.files import FileFormat, dumps, loads
from paramclient.links import SimLink
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import ParamType
from paramclient.protocol import wire
from paramclient.service import AccessSettings, Hub, Settings, Tokens, create_app
from paramclient.service.body_limits import LINE_BYTES_MAX, PARAM_FILE_BYTES_MAX
from paramclient.service.quota import LONG_REQUESTS_OF_HOLDER_MAX
from paramclient.service.routes.param_files import file_response
from paramclient.sim import ArduPilotVehicle, PX4Vehicle, SimParam
from paramclient.sim.vehicle import Vehicle
from tests.asgi import a_browser
from tests.caches import NOW, PX4, stored
from tests.openapi_schema import Published
from tests.shell import Tap, in_simulated_time, until

HERE = "/api/v1/components/1/1"
TUNE = {f"TUNE_{number:02}": number / 4 + 0.1 for number in range(20)}
"""What is set in most of these tests: values that no float32 holds exactly."""
FILE = "".join(f"{name},{value + 1}\n" for name, value in TUNE.items())
"""The same, each one more, as Mission Planner writes it."""
PUBLISHED: list[Published] = []
WRITABLE = list(FileFormat)


def px4(**options: Any) -> PX4Vehicle:
    rows = [SimParam(name, ParamType.REAL32, value) for name, value in TUNE.items()]
    rows += [SimParam("MODE", ParamType.INT32, 3), SimParam("CAL_ACC0_XOFF", ParamType.REAL32, 0.5)]
    return PX4Vehicle(**{"table": rows} | options)


def ardupilot(**options: Any) -> ArduPilotVehicle:
    rows = [SimParam(name, ParamType.REAL32, value, default=value) for name, value in TUNE.items()]
    rows += [SimParam("MODE", ParamType.INT8, 3), SimParam("COMPASS_OFS_X", ParamType.REAL32, 0.5)]
    return ArduPilotVehicle(**{"table": rows, "groups": {}, "live": ()} | options)


A_FILE = {"content-type": "application/octet-stream"}
BOTH = pytest.mark.parametrize("vehicle", [px4, ardupilot])


class Checked:
    """A client that holds every answer against the published schema."""

    def __init__(self, client: httpx.AsyncClient, published: Published) -> None:
        self.client = client
        self._published = published

    async def ask(self, method: str, path: str, status: int = 200, **options: Any) -> Any:
        """What is answered, as JSON; the status must be this one."""
        if "content" in options:
            options["headers"] = A_FILE
        answer = await self.client.request(method, path, **options)
        assert answer.status_code == status, answer.text
        assert answer.headers["content-type"] in ("application/json", "application/problem+json")
        content = answer.json()
        self._published.check(method, answer.url.path, status, content)
        return content

    async def get(self, path: str, status: int = 200, **query: Any) -> Any:
        return await self.ask("GET", path, status, params=query or None)

    async def post(self, path: str, body: Any, status: int = 200) -> Any:
        return await self.ask("POST", path, status, json=body)

    async def job(self, name: str, is_so: Callable[[Any], object]) -> Any:
        """A job, as soon as something is so."""
        while not is_so(reported := await self.get(f"/api/v1/jobs/{name}")):  # noqa: ASYNC110 - no event reports it
            await anyio.sleep(0.001)
        return reported

    async def file(self, path: str, **query: Any) -> httpx.Response:
        answer = await self.client.get(path, params=query or None)
        assert answer.status_code == 200, answer.text
        return answer


@asynccontextmanager
async def serving(
    *links: Any, place: Path | None = None, is_fetched: bool = True, **options: Any
) -> AsyncIterator[Checked]:
    """A service with these vehicles, whose tables it has when it begins."""
    cache = None if place is None else ParamCache(place / "cache.sqlite3")
    named = [SimLink(link, f"sim:{number}") for number, link in enumerate(links)]
    async with Hub(named, cache=cache or False, fetches=is_fetched, **options) as hub:
        app = create_app(hub)
        async with a_browser(app) as client:
            if not PUBLISHED:  # all of them publish the same, and to write it takes a while
                PUBLISHED.append(Published((await client.get("/openapi.json")).json()))
            await until(lambda: len(hub.followed) >= len(links), pause=0.1)
            if is_fetched:
                for followed in hub.followed:
                    await followed.component.fetch_all()
            yield Checked(client, PUBLISHED[0])
    if cache is not None:
        cache.close()


# set-ups


@BOTH
@in_simulated_time
async def test_a_file_is_planned_applied_and_verified(
    vehicle: Callable[..., Vehicle], tmp_path: Path
) -> None:
    on_board = vehicle()
    wanted = {"wanted": {"file": {"name": "quad.param", "text": FILE}}}
    async with serving(on_board, place=tmp_path) as service:
        plan = await service.post(f"{HERE}/plan", wanted)
        assert plan["counts"] == {"set": 20, "later": 0, "unchanged": 0, "skipped": 0, "invalid": 0}
        assert [step["name"] for stage in plan["stages"] for step in stage["steps"]] == list(TUNE)
        assert plan["params"]["TUNE_01"]["wanted"] == 1.35
        assert await service.post(f"{HERE}/apply", {**wanted, "dry_run": True}) == plan
        before = await service.post(f"{HERE}/verify", wanted)
        assert (before["met"], before["counts"]["different"]) == (False, 20)

        result = await service.post(f"{HERE}/apply", wanted)
        assert result["complete"] is True
        reported = result["vehicle"]
        assert (reported["system"], reported["component"]) == (1, 1)
        assert reported["kind"] in ("PX4 quadrotor", "ArduPilot quadrotor")
        assert reported["firmware"]
        assert result["counts"]["set"] == 20
        assert result["params"]["TUNE_01"] == {
            "status": "set",
            "type": "REAL32",
            "before": 0.35,
            "wanted": 1.35,
            "actual": 1.35,
            "category": "",
            "reason": "",
            "nearest": [],
        }
        after = await service.post(f"{HERE}/verify", wanted)
        assert after == {
            "system": 1,
            "component": 1,
            "met": True,
            "params": {},
            "counts": {"same": 20, "different": 0, "missing": 0, "left out": 0},
        }
        whole = await service.post(f"{HERE}/verify", {**wanted, "full": True})
        assert whole["params"].keys() == TUNE.keys()
        history = await service.get(f"{HERE}/history", name="TUNE_01")
        [line] = history["history"]
        assert (line["old"], line["new"], line["by"]) == (0.35, 1.35, "us for local")
    assert on_board.values["TUNE_01"] == pytest.approx(1.35)


RULES = """[{"old": "OLD_TUNE", "new": "TUNE_01", "factor": 0.01},
 {"old": "TUNE_02", "new": "NEW_TUNE"}]
"""


@BOTH
@in_simulated_time
async def test_names_that_changed_with_the_firmware_are_compared_planned_and_applied(
    vehicle: Callable[..., Vehicle], tmp_path: Path
) -> None:
    on_board = vehicle()
    renames = {"name": "names.json", "text": RULES}
    requested = {"wanted": {"values": {"OLD_TUNE": 775, "NEW_TUNE": 3.5, "GONE": 1}}, "renames": renames}
    async with serving(on_board, place=tmp_path) as service:
        differences = (await service.post(f"{HERE}/diff", {**requested, "partial": True}))["params"]
        assert differences["OLD_TUNE"]["right_name"] == "TUNE_01"
        assert differences["NEW_TUNE"]["right_name"] == "TUNE_02"
        assert differences.keys() == {"OLD_TUNE", "NEW_TUNE", "GONE"}
        plan = await service.post(f"{HERE}/plan", requested)
        assert plan["params"]["OLD_TUNE"]["vehicle_name"] == "TUNE_01"
        assert plan["params"]["OLD_TUNE"]["wanted"] == 7.75
        assert plan["params"]["GONE"]["category"] == "missing"
        assert (await service.post(f"{HERE}/verify", requested))["counts"]["different"] == 2
        result = await service.post(f"{HERE}/apply", {**requested, "only": ["OLD_*", "NEW_*"]})
        assert result["counts"]["set"] == 2
        assert (await service.post(f"{HERE}/verify", requested))["counts"]["same"] == 2
        assert on_board.values["TUNE_01"] == 7.75
        assert on_board.values["TUNE_02"] == 3.5


@pytest.mark.parametrize(
    ("text", "status", "reported"),
    [
        ('[{"old": "A", "new": "B"}, {"old": "B", "new": "A"}]', 422, "return to"),
        ('[{"old": "A", "new": "B", "factor": 0}]', 422, "factor"),
        ("{", 422, "JSON"),
        ('{"old": "A", "new": "B"},\n' * 25_000, 413, "60,000"),
        ("x" * (LINE_BYTES_MAX + 1), 413, "bytes"),
    ],
)
@in_simulated_time
async def test_a_wrong_file_of_changed_names_is_rejected(
    text: str, status: int, reported: str, tmp_path: Path
) -> None:
    requested = {"wanted": {"values": {"TUNE_01": 1}}, "renames": {"name": "names.json", "text": text}}
    async with serving(px4(), place=tmp_path) as service:
        for path in ("diff", "plan", "verify", "apply"):
            assert reported in (await service.post(f"{HERE}/{path}", requested, status))["detail"]


@BOTH
@in_simulated_time
async def test_an_apply_without_waiting_is_a_job_with_progress(
    vehicle: Callable[..., Vehicle], tmp_path: Path
) -> None:
    async with serving(vehicle(), place=tmp_path) as service:
        body = {"wanted": {"values": dict.fromkeys(TUNE, 7.5)}, "wait": False}
        answer = await service.client.post(f"{HERE}/apply", json=body)
        assert answer.status_code == 202
        where = answer.headers["location"]
        seen = [answer.json()]
        while seen[-1]["state"] == "running":
            await anyio.sleep(0.05)
            seen.append(await service.get(where))
        reported = seen[-1]
        assert (reported["kind"], reported["state"], reported["requested_by"]) == ("apply", "done", "local")
        assert reported["result"]["counts"]["set"] == 20
        assert reported["progress"]["phase"] == "reading"
        assert (reported["progress"]["done"], reported["progress"]["total"]) == (20, 20)
        assert reported["problem"] is None


@in_simulated_time
async def test_progress_of_a_set_up_is_among_the_events(tmp_path: Path) -> None:
    async with serving(px4(), place=tmp_path) as service:
        place = (await service.get("/api/v1/components"))["seq"]
        run = (await service.get("/api/v1/components"))["run"]
        await service.post(f"{HERE}/apply", {"wanted": {"values": {"MODE": 4}}})
        reported = []
        async with service.client.stream(
            "GET", "/api/v1/events", params={"after": f"{run}-{place}", "types": "job"}
        ) as stream:
            async for line in stream.aiter_lines():
                if line.startswith("data: ") and (event := json.loads(line[6:]))["type"] == "job":
                    reported.append(event["job"])
                    if reported[-1]["state"] != "running":
                        break
        assert [job["state"] for job in reported[-1:]] == ["done"]
        assert any(job["progress"] and job["progress"]["phase"] == "writing" for job in reported)
        assert all(job["result"] is None for job in reported)


@BOTH
@in_simulated_time
async def test_an_earlier_state_is_restored(vehicle: Callable[..., Vehicle], tmp_path: Path) -> None:
    on_board = vehicle()
    async with serving(on_board, place=tmp_path) as service:
        await service.post(f"{HERE}/apply", {"wanted": {"values": {"TUNE_01": 9, "TUNE_02": 9}}})
        state = await service.post(f"{HERE}/state", {})
        assert (state["system"], state["identity"]["system"]) == (1, 1)
        assert state["params"]["TUNE_01"]["value"] == pytest.approx(0.35)
        point = state.pop("restore_point")
        assert (point["at"], point["changes"].keys()) == (state["at"], {"TUNE_01", "TUNE_02"})
        assert state == await service.post(f"{HERE}/state", {"at": state["at"]})
        assert state == await service.post(f"{HERE}/state", {"snapshot": point["snapshot"]})
        planned = await service.post(f"{HERE}/restore", {"dry_run": True})
        assert planned["params"].keys() == {"TUNE_01", "TUNE_02"}
        assert planned == await service.post(f"{HERE}/restore/plan", {})
        refused = await service.post(f"{HERE}/restore/plan", {"reboot": True}, 422)
        assert refused["type"] == "urn:paramclient:invalid-request"
        back = await service.post(f"{HERE}/restore", {})
        assert back["complete"] is True
        assert back["params"].keys() == {"TUNE_01", "TUNE_02"}
        assert on_board.values["TUNE_01"] == pytest.approx(0.35)

        kept = (await service.get(f"{HERE}/snapshots"))["snapshots"]
        assert [each["reason"] for each in kept] == ["before apply", "before restore"]
        again = await service.post(f"{HERE}/restore", {"snapshot": kept[1]["id"]})
        assert again["counts"]["set"] == 2
        assert on_board.values["TUNE_01"] == 9
        for path, body in (("restore", {}), ("restore", {"dry_run": True}), ("state", {})):
            refused = await service.post(f"{HERE}/{path}", body, 409)
            assert refused["type"] == "urn:paramclient:already-restored"
            assert (refused["before_apply"], refused["before_restore"]) == (kept[0]["id"], kept[1]["id"] + 1)
            assert f"snapshot {kept[0]['id']} for the state before that apply" in refused["detail"]
        assert on_board.values["TUNE_01"] == 9, "an apply is not undone twice"
        for path in ("restore", "state"):
            unknown = await service.post(f"{HERE}/{path}", {"snapshot": 999}, 404)
            assert unknown["type"] == "urn:paramclient:unknown-state"
            both = await service.post(f"{HERE}/{path}", {"snapshot": 1, "at": 5}, 422)
            assert "exclude each other" in both["detail"]


@in_simulated_time
async def test_two_set_ups_do_not_mix_and_one_can_be_ended(tmp_path: Path) -> None:
    on_board = px4()
    tap = Tap(on_board)
    async with serving(tap, place=tmp_path) as service:
        body = {"wanted": {"values": dict.fromkeys(TUNE, 7.5)}, "wait": False}
        tap.is_mute = True
        answer = await service.client.post(f"{HERE}/apply", json=body)
        job = answer.json()["id"]
        busy = await service.post(f"{HERE}/apply", body, 409)
        assert (busy["type"], busy["job"]) == ("urn:paramclient:busy", job)
        assert (await service.post(f"{HERE}/restore", {}, 409))["type"] == "urn:paramclient:busy"
        assert (await service.client.delete(f"/api/v1/jobs/{job}")).status_code == 204
        reported = await service.job(job, lambda reported: reported["state"] != "running")
        assert (reported["state"], reported["problem"]["type"]) == ("cancelled", "urn:paramclient:cancelled")
        tap.is_mute = False
        await service.post(f"{HERE}/apply", {**body, "wait": True})
        assert on_board.values["TUNE_00"] == 7.5


@in_simulated_time
async def test_a_fetch_of_extended_parameters_refuses_no_set_up(tmp_path: Path) -> None:
    async with serving(tap := Tap(px4()), place=tmp_path) as service:
        tap.is_mute = True
        started = await service.client.post(f"{HERE}/extended/fetch", json={"wait": False})
        assert (started.status_code, started.json()["state"]) == (202, "running")
        body = {"wanted": {"values": dict.fromkeys(TUNE, 7.5)}, "wait": False}
        assert (await service.client.post(f"{HERE}/apply", json=body)).status_code == 202


class Quiet(Tap):
    """Says nothing any more after some writes."""

    def receive(self, data: bytes, now: float) -> None:
        super().receive(data, now)
        self.is_mute = len(self.messages(wire.ParamSetMessage)) > 12


@in_simulated_time
async def test_a_cancelled_apply_reports_the_values_written_so_far(tmp_path: Path) -> None:
    """Values that were acknowledged and will not be read back are said to be unproven."""
    async with serving(Quiet(px4()), place=tmp_path) as service:
        body = {"wanted": {"values": dict.fromkeys(TUNE, 7.5)}, "wait": False}
        job = (await service.client.post(f"{HERE}/apply", json=body)).json()["id"]
        await service.job(job, lambda reported: reported["progress"] and reported["progress"]["done"])
        assert (await service.client.delete(f"/api/v1/jobs/{job}")).status_code == 204
        reported = await service.job(job, lambda reported: reported["state"] != "running")
        assert (reported["state"], reported["result"]["error"]) == ("cancelled", "interrupted")
        assert reported["result"]["params"]
        assert {row["status"] for row in reported["result"]["params"].values()} == {"unproven"}


@in_simulated_time
async def test_the_service_ends_in_the_middle_of_a_set_up(tmp_path: Path) -> None:
    tap = Tap(px4())
    async with serving(tap, place=tmp_path) as service:
        tap.is_mute = True
        body = {"wanted": {"values": dict.fromkeys(TUNE, 7.5)}, "wait": False}
        assert (await service.client.post(f"{HERE}/apply", json=body)).status_code == 202


@in_simulated_time
async def test_an_apply_that_cannot_succeed_is_refused_before_the_first_write(tmp_path: Path) -> None:
    on_board = px4(armed=True)
    async with serving(on_board, place=tmp_path) as service:
        armed = await service.post(f"{HERE}/apply", {"wanted": {"values": {"MODE": 4}}}, 409)
        assert (armed["type"], armed["error"]) == ("urn:paramclient:vehicle-armed", "VehicleArmed")
        done = await service.post(f"{HERE}/apply", {"wanted": {"values": {"MODE": 4}}, "allow_armed": True})
        assert done["complete"] is True
        wrong = {"wanted": {"values": {"MODE": 4.5, "TUNE_00": 1}}, "allow_armed": True}
        invalid = await service.post(f"{HERE}/apply", wrong, 422)
        assert invalid["type"] == "urn:paramclient:invalid-parameters"
        assert invalid["problems"].keys() == {"MODE"}
        assert on_board.values["TUNE_00"] == pytest.approx(0.1)
        some = await service.post(f"{HERE}/apply", {**wrong, "skip_invalid": True})
        assert (some["complete"], some["params"]["MODE"]["status"]) == (False, "skipped")
        assert on_board.values["TUNE_00"] == 1


@in_simulated_time
async def test_the_vehicle_starts_again_where_values_count_only_then(tmp_path: Path) -> None:
    rows = [SimParam("SYS_AUTOSTART", ParamType.INT32, 4001), SimParam("MAV_SYS_ID", ParamType.INT32, 1)]
    on_board = px4(table=[*rows, SimParam("TUNE_00", ParamType.REAL32, 0.5)])
    async with serving(on_board, place=tmp_path) as service:
        wanted = {"wanted": {"values": {"SYS_AUTOSTART": 4002, "TUNE_00": 2, "MAV_SYS_ID": 7}}}
        plan = await service.post(f"{HERE}/plan", {**wanted, "include": ["identity"]})
        assert plan["reboot_for"]
        done = await service.post(
            f"{HERE}/apply", {**wanted, "include": ["identity"], "reboot": True, "full": True}
        )
        assert done["complete"] is True
        assert done["reboots"] >= 1
        assert done["now"] == {"system": 7, "component": 1}


@in_simulated_time
async def test_only_named_parameters_are_wanted_and_one_file_overlays_another() -> None:
    on_board = px4()
    async with serving(on_board) as service:
        base = {"file": {"name": "all.param", "base64": base64.b64encode(FILE.encode()).decode()}}
        body = {"wanted": base, "over": {"values": {"TUNE_03": 33}}, "only": ["TUNE_0[23]", "TUNE_11"]}
        plan = await service.post(f"{HERE}/plan", body)
        assert {name: row["wanted"] for name, row in plan["params"].items()} == {
            "TUNE_02": 1.6,
            "TUNE_03": 33.0,
            "TUNE_11": 3.85,
        }
        unmatched = await service.post(f"{HERE}/plan", {**body, "only": ["TUNE_99"]}, 422)
        assert "TUNE_99" in unmatched["detail"]
        left_out = await service.post(f"{HERE}/plan", {"wanted": {"values": {"CAL_ACC0_XOFF": 1}}})
        assert left_out["params"]["CAL_ACC0_XOFF"]["category"] == "calibration"
        chosen = {"wanted": {"values": {"CAL_ACC0_XOFF": 1}}, "include": ["CAL_ACC0_XOFF"]}
        assert (await service.post(f"{HERE}/apply", chosen))["complete"] is True
        assert on_board.values["CAL_ACC0_XOFF"] == 1


FAULTS: list[tuple[Any, str]] = [
    ({}, "wanted"),
    ({"wanted": {}}, "one of these members"),
    ({"wanted": {"snapshot": 1, "at": 1.0}}, "one of these members"),
    ({"wanted": {"defaults": True}}, "base of a comparison"),
    ({"wanted": {"file": {"name": "a.param"}}}, "either `text` or `base64`"),
    ({"wanted": {"file": {"base64": "###"}}}, "not valid base64"),
    ({"wanted": {"values": {}}}, "values"),
    ({"wanted": {"values": {"NO GOOD NAME AT ALL": 1}}}, "NO GOOD NAME"),
    ({"wanted": {"values": {"MODE": "Loiter"}}}, "not a number"),
    ({"wanted": {"at": "2026-11-20"}}, "zone"),
    ({"wanted": {"at": "yesterday"}}, "2026-11-20T14:00:00Z"),
    ({"wanted": {"at": "inf"}}, "less than"),
    ({"wanted": {"values": {"MODE": 1}}, "dryrun": True}, "dryrun"),
    ({"wanted": {"file": {"text": "TUNE_00,1\nTUNE_01;2\n", "name": "a.param"}}}, "a.param:2"),
]
"""What cannot be meant, and words of what is said of it."""


@in_simulated_time
async def test_invalid_bodies_of_plan_are_refused() -> None:
    async with serving(px4()) as service:
        for body, words in FAULTS:
            problem = await service.post(f"{HERE}/plan", body, 422)
            assert words in problem["detail"], body


# comparisons


@BOTH
@in_simulated_time
async def test_a_component_is_compared_with_anything(vehicle: Callable[..., Vehicle], tmp_path: Path) -> None:
    on_board, other = vehicle(), vehicle(system=2)
    async with serving(on_board, other, place=tmp_path) as service:
        kept = await service.ask("POST", f"{HERE}/snapshots", 201, json={"reason": "as it came"})
        await service.ask("PUT", f"{HERE}/params/TUNE_01", json={"value": 5})
        present = await service.get("/api/v1/vehicles")
        key = next(each["key"] for each in present["vehicles"] if each["system"] == 2)
        for wanted in (
            {"snapshot": kept["id"]},
            {"at": kept["at"]},
            {"component": {"system": 2, "component": 1}},
            {"vehicle": {"key": key, "component": 1}},
        ):
            found = await service.post(f"{HERE}/diff", {"wanted": wanted, "known": True})
            assert not found["same"]
            assert found["params"].keys() == {"TUNE_01"}, wanted
            row = found["params"]["TUNE_01"]
            assert (row["is"], row["left"]["value"], row["right"]["value"]) == ("different", 0.35, 5.0)

        file = {"file": {"name": "a.param", "text": "TUNE_01,5\nTUNE_02,8\n"}}
        whole = await service.post(f"{HERE}/diff", {"wanted": file})
        assert whole["counts"]["only right"] == 20
        partial = await service.post(f"{HERE}/diff", {"wanted": file, "partial": True, "full": True})
        assert {name: row["is"] for name, row in partial["params"].items()} == {
            "TUNE_01": "same",
            "TUNE_02": "different",
        }
        based = await service.post(
            f"{HERE}/diff",
            {"wanted": file, "partial": True, "base": {"snapshot": kept["id"]}, "only": ["TUNE_*"]},
        )
        assert {name: row["changed_side"] for name, row in based["params"].items()} == {
            "TUNE_01": "both",
            "TUNE_02": "left",
        }


@in_simulated_time
async def test_defaults_are_a_base_where_they_are_known() -> None:
    async with serving(ardupilot(), px4(system=2)) as service:
        file = {"file": {"name": "a.param", "text": "TUNE_02,8\n"}}
        body = {"wanted": file, "partial": True, "base": {"defaults": True}}
        found = await service.post(f"{HERE}/diff", body)
        assert found["params"]["TUNE_02"]["changed_side"] == "left"
        unknown = await service.post("/api/v1/components/2/1/diff", body, 422)
        assert "defaults are not known" in unknown["detail"]


# files


@BOTH
@in_simulated_time
async def test_a_table_is_written_to_a_file_of_every_format_and_read_back(
    vehicle: Callable[..., Vehicle],
) -> None:
    on_board = vehicle()
    async with serving(on_board) as service:
        for form in WRITABLE:
            answer = await service.file(f"{HERE}/file", format=form)
            disposition = answer.headers["content-disposition"]
            assert re.fullmatch(r'attachment; filename="[A-Za-z0-9._-]+"', disposition)
            assert answer.headers["content-type"] == "application/octet-stream"
            assert answer.headers["x-content-type-options"] == "nosniff"
            name = disposition.split('"')[1]
            read = loads(answer.content, source=name)
            assert read.file_format is form
            assert len(read.choose(1)) == 22
            known = await service.file(f"{HERE}/file", **{"format": form, "from": "known"})
            assert loads(known.content, source=name).choose(1).params == read.choose(1).params

            uploaded = await service.ask("POST", f"/api/v1/files?name={name}", content=answer.content)
            assert (uploaded["format"], uploaded["file"]) == (form, name)
            assert uploaded["params"]["TUNE_01"]["value"] == 0.35
            on_board.set_param("TUNE_01", 9.0)
            await anyio.sleep(2)  # until a received hash no longer counts
            encoded = base64.b64encode(answer.content).decode()
            wanted = {"file": {"name": name, "base64": encoded}}
            result = await service.post(f"{HERE}/apply", {"wanted": wanted, "include": ["calibration"]})
            assert (result["complete"], result["counts"]["set"]) == (True, 1)
            assert on_board.values["TUNE_01"] == pytest.approx(0.35)


@in_simulated_time
async def test_the_name_of_a_file_is_safe_for_any_vehicle_name() -> None:
    whose = replace(PX4, autopilot=200, system=9)
    params = ParamSet(
        {"A": WrittenParam("A", 1, ParamType.INT32)}, system=9, component=1, identity=whose, at=NOW
    )
    async with Hub([], cache=False) as hub:
        answer = await file_response(hub, params, FileFormat.QGC)
    name = "autopilot_200-9-1-20261118-110640.params"
    assert answer.headers["content-disposition"] == f'attachment; filename="{name}"'


@in_simulated_time
async def test_an_earlier_state_is_served_as_a_file_too(tmp_path: Path) -> None:
    async with serving(px4(), place=tmp_path) as service:
        kept = await service.ask("POST", f"{HERE}/snapshots", 201, json={"reason": "as it came"})
        await service.ask("PUT", f"{HERE}/params/TUNE_01", json={"value": 5})
        for source in (f"snapshot:{kept['id']}", repr(kept["at"]), kept["time"]):
            answer = await service.file(f"{HERE}/file", **{"format": "parm", "from": source})
            assert loads(answer.content).choose(1)["TUNE_01"].value == 0.35, source
        assert (await service.get(f"{HERE}/file", 422, **{"from": "soon"}))["type"] == "urn:paramclient:usage"
        assert (await service.get(f"{HERE}/file", 404, **{"from": "snapshot:77"}))["status"] == 404
        assert (await service.get(f"{HERE}/file", 404, **{"from": "5"}))[
            "type"
        ] == "urn:paramclient:unknown-state"
        assert (await service.get(f"{HERE}/file", 422, format="xlsx"))["status"] == 422


@in_simulated_time
async def test_an_incomplete_table_is_no_file() -> None:
    on_board = px4(dead=[4])
    async with serving(on_board) as service:
        for source, status in (("known", 409), ("live", 409)):
            problem = await service.get(f"{HERE}/file", status, **{"from": source})
            assert "not received" in problem["detail"] or problem["type"] == "urn:paramclient:incomplete"


@in_simulated_time
async def test_only_what_differs_from_the_defaults_is_a_file_too() -> None:
    on_board = ardupilot()
    async with serving(on_board, px4(system=2)) as service:
        await service.ask("PUT", f"{HERE}/params/TUNE_01", json={"value": 5})
        answer = await service.file(f"{HERE}/file", format="parm", changed=True)
        assert list(loads(answer.content).choose(1)) == ["TUNE_01"]
        unknown = await service.get("/api/v1/components/2/1/file", 422, changed=True)
        assert "defaults are not known" in unknown["detail"]


@in_simulated_time
async def test_a_file_is_read_and_its_faults_are_reported_by_line() -> None:
    async with serving(px4()) as service:

        async def upload(content: bytes, status: int = 200, **query: Any) -> Any:
            return await service.ask("POST", "/api/v1/files", status, content=content, params=query or None)

        plain = await upload(b"MC_ROLL_P 6.5\n", format="parm")
        assert plain["params"]["MC_ROLL_P"] == {"value": 6.5, "type": None, "bits": None}
        twice = await upload(b"A,1\nA,1\n", name="twice.param")
        assert twice["notes"]
        bad = await upload(b"A,1\nB;2\nC,x\n", 422, name="bad.param")
        assert (bad["error"], bad["source"], bad["line"]) == ("FileError", "bad.param", 2)
        assert "bad.param:3" in bad["detail"]
        assert (await upload(b"", 422))["error"] == "FileError"
        assert (await upload(b"{" * 50_000, 422, format="json"))["error"] == "FileError"
        assert (await upload(b"- " * 50_000, 413, format="parm"))["most"] == LINE_BYTES_MAX
        assert (await upload(b"A,1\n" * (PARAM_FILE_BYTES_MAX // 4 + 1), 413))[
            "type"
        ] == "urn:paramclient:too-large"
        large = {"file": {"name": "a.parm", "text": "A 1\n" * (PARAM_FILE_BYTES_MAX // 4 + 1)}}
        assert (await service.post(f"{HERE}/plan", {"wanted": large}, 413))["most"] == PARAM_FILE_BYTES_MAX
        several = dumps(
            [
                ParamSet({"A": WrittenParam("A", 1, ParamType.INT32)}, component=each, system=1)
                for each in (1, 154)
            ],
            file_format="qgc",
        )
        assert (await upload(several))["components"][1]["component"] == 154
        assert (await upload(several, 422, component=9))["error"] == "FileError"


@in_simulated_time
async def test_files_are_read_one_after_the_other_and_not_without_end() -> None:
    async with serving(px4()) as service:
        answers = []

        async def upload() -> None:
            answer = await service.client.post("/api/v1/files?name=a.param", content=b"A,1\n", headers=A_FILE)
            answers.append(answer.status_code)

        async with anyio.create_task_group() as tasks:
            for _ in range(LONG_REQUESTS_OF_HOLDER_MAX + 3):
                tasks.start_soon(upload)
        assert sorted(answers) == [200] * LONG_REQUESTS_OF_HOLDER_MAX + [429] * 3


@in_simulated_time
async def test_formats_are_recognized() -> None:
    async with serving(px4()) as service:
        forms = (await service.get("/api/v1/formats"))["formats"]
        assert [form["name"] for form in forms if form["writes"]] == WRITABLE
        assert {"name": "parm", "title": "MAVProxy, ArduPilot", "endings": [".parm"], "writes": True} in forms


# the past


@in_simulated_time
async def test_history_is_served_in_pages_without_a_loss(tmp_path: Path) -> None:
    """Also if many changes were received at one moment."""
    cache = ParamCache(tmp_path / "cache.sqlite3")
    updates = [
        TableUpdate(
            identity=PX4,
            component=1,
            autopilot=12,
            at=NOW + at // 4,
            params=[stored("A", at, at=NOW + at // 4), stored("B", at, at=NOW + at // 4)],
            table=TableState(complete=True, count=2),
        )
        for at in range(21)
    ]
    cache.save(updates)
    everything = cache.history(PX4.key, 1)
    cache.close()
    path = f"/api/v1/vehicles/{quote(PX4.key, safe='')}/1/history"
    async with serving(px4(), place=tmp_path, is_fetched=False) as service:
        lines: list[Any] = []
        query: dict[str, Any] = {"limit": 5}
        while True:
            page = await service.get(path, **query)
            assert len(page["history"]) >= 1
            lines[:0] = page["history"]
            if "before" not in page:
                break
            query["before"] = page["before"]
        assert [(line["at"], line["name"], line["new"]) for line in lines] == [
            (each.at, each.name, each.new.value) for each in everything if each.new is not None
        ]
        assert len(lines) == len(everything) == 40
        assert lines[0]["old_exact"] == {"type": "INT32", "bits": "00000000"}
        only = await service.get(path, name="A", since=NOW + 4, limit=3)
        assert {line["name"] for line in only["history"]} == {"A"}
        assert (await service.get(path, 422, limit=0))["type"] == "urn:paramclient:invalid-request"


@BOTH
@in_simulated_time
async def test_cached_data_of_a_vehicle_is_the_same_with_and_without_its_link(
    vehicle: Callable[..., Vehicle], tmp_path: Path
) -> None:
    async with serving(vehicle(), place=tmp_path) as service:
        kept = await service.ask("POST", f"{HERE}/snapshots", 201, json={"reason": "<b>before</b>"})
        await service.ask("PUT", f"{HERE}/params/TUNE_01", json={"value": 5})
        here = {
            "history": await service.get(f"{HERE}/history"),
            "snapshots": await service.get(f"{HERE}/snapshots"),
            f"snapshots/{kept['id']}": await service.get(f"{HERE}/snapshots/{kept['id']}"),
            f"state?at={kept['at']}": await service.get(f"{HERE}/state?at={kept['at']}"),
        }
        assert here[f"snapshots/{kept['id']}"]["params"]["TUNE_01"]["value"] == 0.35
        assert here["snapshots"]["snapshots"][0]["reason"] == "<b>before</b>"
        assert (await service.get(f"{HERE}/snapshots/77", 404))["type"] == "urn:paramclient:unknown-snapshot"

        vehicles = (await service.get("/api/v1/vehicles"))["vehicles"]
        assert [each["system"] for each in vehicles] == [1]
        assert vehicles[0]["components"][0]["size"] == 22
        there = f"/api/v1/vehicles/{quote(vehicles[0]['key'], safe='')}/1"
        for what, content in here.items():
            assert await service.get(f"{there}/{what}") == content
        table = await service.get(f"{there}/params")
        assert table["params"]["TUNE_01"]["value"] == 5
        assert table["params"]["TUNE_01"]["trust"] == "cached"
        live = await service.file(f"{HERE}/file", format="parm")
        cached = await service.file(f"{there}/file", format="parm")
        assert loads(cached.content).choose(1).params == loads(live.content).choose(1).params
        for what in ("params", "history", "snapshots", "snapshots/1", "state?at=5", "file"):
            for key in ("uid:00", "system:1@serial:/dev/ttyACM0:57600", "%27%20OR%201", "%"):
                problem = await service.get(f"/api/v1/vehicles/{quote(key, safe='')}/1/{what}", 404)
                assert problem["type"] == "urn:paramclient:unknown-vehicle"


@in_simulated_time
async def test_without_a_cache_nothing_is_known_of_earlier_times() -> None:
    async with serving(px4()) as service:
        for path in (f"{HERE}/history", f"{HERE}/snapshots", f"{HERE}/state?at=5", "/api/v1/vehicles"):
            assert (await service.get(path, 409))["type"] == "urn:paramclient:no-cache"
        assert (await service.post(f"{HERE}/restore", {}, 409))["type"] == "urn:paramclient:no-cache"


# descriptions


@in_simulated_time
async def test_a_vehicle_describes_its_parameters_on_request(tmp_path: Path) -> None:
    async with serving(PX4Vehicle(metadata=True), place=tmp_path) as service:
        assert (await service.get(f"{HERE}/metadata", 404))["type"] == "urn:paramclient:not-described"
        reported = await service.post(f"{HERE}/metadata", {})
        assert reported["count"] > 100
        infos = await service.get(f"{HERE}/metadata", names="MC_ROLL_P")
        assert infos["params"]["MC_ROLL_P"]["short_description"]
        compared = await service.post(
            f"{HERE}/diff",
            {"wanted": {"values": {"MC_ROLL_P": 5}}, "partial": True, "known": True},
        )
        assert compared["params"].keys() == {"MC_ROLL_P"}
        outside = await service.post(f"{HERE}/plan", {"wanted": {"values": {"MC_ROLL_P": 5_000}}})
        assert outside["params"]["MC_ROLL_P"]["category"] == "out-of-range"


@in_simulated_time
async def test_a_file_describes_parameters_too(tmp_path: Path) -> None:
    content = json.dumps(
        {"parameters": [{"name": "TUNE_00", "type": "Float", "max": 2.0, "units": "m"}], "version": 1}
    )
    async with serving(px4()) as service:
        reported = await service.ask("PUT", f"{HERE}/metadata?name=p.json", content=content.encode())
        assert reported["count"] == 1
        assert (await service.get(f"{HERE}/metadata"))["params"]["TUNE_00"] == {"units": "m", "maximum": 2.0}
        bad = await service.ask("PUT", f"{HERE}/metadata", 422, content=b"what")
        assert bad["error"] == "MetadataError"
        assert (await service.post(f"{HERE}/metadata", {}, 404))["type"] == "urn:paramclient:not-described"


@in_simulated_time
async def test_a_token_that_may_only_read_plans_a_restore(tmp_path: Path) -> None:
    async with Hub([px4()], cache=tmp_path / "cache") as hub:
        await until(lambda: hub.followed, pause=0.1)
        tokens = Tokens.of_text("guest read guest-may-read-only-0123\nanna write anna-may-write-0123456")
        app = create_app(hub, Settings(access=AccessSettings(tokens=tokens)))
        async with a_browser(app) as client:
            client.headers["authorization"] = "Bearer anna-may-write-0123456"
            assert (await client.post(f"{HERE}/apply", json={"wanted": {"values": {"MODE": 4}}})).is_success
            client.headers["authorization"] = "Bearer guest-may-read-only-0123"
            planned = await client.post(f"{HERE}/restore/plan", json={})
            assert (planned.status_code, planned.json()["params"]["MODE"]["wanted"]) == (200, 3)
            assert (await client.post(f"{HERE}/restore", json={"dry_run": True})).status_code == 403


@in_simulated_time
async def test_a_token_that_may_only_read_changes_nothing(tmp_path: Path) -> None:
    on_board = px4()
    async with Hub([on_board], cache=False) as hub:
        await until(lambda: hub.followed, pause=0.1)
        tokens = Tokens.of_text("guest read guest-may-read-only-0123")
        app = create_app(hub, Settings(access=AccessSettings(tokens=tokens)))
        async with a_browser(app) as client:
            client.headers["authorization"] = "Bearer guest-may-read-only-0123"
            body = {"wanted": {"values": {"MODE": 4}}}
            for path in ("apply", "restore", "snapshots"):
                assert (await client.post(f"{HERE}/{path}", json=body)).status_code == 403
            assert (await client.put(f"{HERE}/metadata", json={})).status_code == 403
            for path in ("plan", "verify", "diff"):
                assert (await client.post(f"{HERE}/{path}", json=body)).status_code == 200
            assert (await client.post(f"{HERE}/metadata", json={})).status_code == 404
    assert on_board.values["MODE"] == 3
