"""The diagnosis of a vehicle and its link: measurements, findings, report; it changes nothing."""

from __future__ import annotations

import io
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from paramclient import ParamClient, UsageError
from paramclient.cli.exit_codes import ExitCode
from paramclient.diagnosis import (
    FileService,
    HashService,
    HeardStation,
    LinkReport,
    ListService,
    ReadService,
    Severity,
    VehicleReport,
    check_vehicle,
    findings_of,
)
from paramclient.links import SimLink
from paramclient.links.tlog import read_records
from paramclient.model.identity import Identity
from paramclient.model.values import Encoding, ParamType
from paramclient.sim import (
    Air,
    ArduPilotVehicle,
    FaultyLink,
    GenericVehicle,
    OtherStation,
    PX4Vehicle,
    SimParam,
)
from paramclient.wire import frames, messages
from tests.commands import Command, Put, behind, in_process, leaping

UID = "0002000000003338470e3034"


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Command:
    """Run the command line in this process, on simulated time."""
    leaping(monkeypatch)
    return in_process(capsys)


@pytest.fixture
def live_command(capsys: pytest.CaptureFixture[str]) -> Command:
    """Run the command line in this process in real time."""
    return in_process(capsys)


@pytest.fixture
def put(monkeypatch: pytest.MonkeyPatch) -> Put:
    return behind(monkeypatch, "sim:custom")


def texts(document: dict[str, Any], severity: str) -> list[str]:
    return [each["text"] for each in document["findings"] if each["severity"] == severity]


# Measurements


def test_px4(command: Command, put: Put) -> None:
    vehicle = PX4Vehicle(uid=0x1234567890)
    done = command("check", put(vehicle), "--json")
    assert (done.code, done.err) == (ExitCode.DONE, "")
    document = done.json
    assert (document["system"], document["component"], document["autopilot"]) == (1, 1, "px4")
    assert document["vehicle_type"] == "quadrotor"
    assert document["has_version"]
    assert document["encoding"] == "bytewise"
    assert "PARAM_ENCODE_BYTEWISE" in document["encoding_reason"]
    listed = document["list"]
    assert (listed["count"], listed["received"], listed["missing"], listed["lost"]) == (903, 903, 0, 0)
    assert listed["per_s"] > 0
    assert document["hash"]["before"] == document["hash"]["after"] == "cf579589"
    assert document["hash"]["confirms_list"]
    assert document["files"]["is_announced"]
    assert document["files"]["size"] is None
    assert document["link"]["round_trip"]["count"] == 10
    assert document["link"]["loss"] == 0.0
    assert document["reads"]["answered"] == document["reads"]["in_flight"] == 30
    assert texts(document, "problem") == []


def test_ardupilot(command: Command, put: Put) -> None:
    document = command("check", put(ArduPilotVehicle()), "--json").json
    assert document["autopilot"] == "ardupilot"
    assert document["encoding"] == "c-cast"
    assert 0 < document["reads"]["per_s"] <= 60  # no machine makes it quicker than the vehicle
    assert document["reads"]["single_s"] > 0
    assert document["list"]["per_s"] > 0
    files = document["files"]
    assert (files["is_serving"], files["size"], files["parameters"]) == (True, 15_295, 1_382)
    assert files["defaults"] == 1_382
    assert document["hash"] == {
        "before": None,
        "after": None,
        "seconds": document["hash"]["seconds"],
        "confirms_list": None,
        "error": "ArduPilot has no parameter hash",
    }
    assert texts(document, "problem") == []
    assert any("no parameter hash" in text for text in texts(document, "note"))


def test_an_ardupilot_without_mavftp_is_slow_with_advice(command: Command, put: Put) -> None:
    document = command("check", put(ArduPilotVehicle(ftp=False)), "--json").json
    assert document["files"]["is_announced"] is False
    assert document["files"]["size"] is None
    assert any("packed parameter file cannot be read" in text for text in texts(document, "slow"))
    [finding] = [each for each in document["findings"] if "packed parameter file" in each["text"]]
    assert "BRD_OPTIONS" in finding["advice"]


def test_a_component_with_few_services(command: Command, put: Put) -> None:
    table = [SimParam(f"CAM_{n}", ParamType.REAL32, float(n)) for n in range(8)]
    document = command("check", put(GenericVehicle(table)), "--json").json
    assert document["hash"]["before"] is None
    assert document["list"]["received"] == document["list"]["count"]


def test_a_lossy_link_is_measured(command: Command, put: Put) -> None:
    air = Air(
        [PX4Vehicle(uid=1, telemetry=50.0)],
        uplink=FaultyLink(loss=0.1, delay=0.03, seed=3),
        downlink=FaultyLink(loss=0.1, delay=0.03, seed=4),
    )
    done = command("check", put(air), "--json")
    document = done.json
    assert done.code == ExitCode.DONE
    assert 0.05 <= document["link"]["loss"] <= 0.16
    assert document["link"]["round_trip"]["min_s"] >= 0.06
    assert document["list"]["received"] == 903
    assert document["list"]["lost"] > 0
    assert any("frames were lost" in each["text"] for each in document["findings"])


def test_a_list_that_takes_too_long_is_cut_short(command: Command, put: Put) -> None:
    """Measurements without time left are reported as not measured."""
    slow = ArduPilotVehicle(ftp=False, burst=1, period=0.05)
    done = command("check", put(slow), "--json", "--timeout", "9")
    document = done.json
    assert done.code == ExitCode.INCOMPLETE
    assert document["list"]["is_cut_short"]
    assert 0 < document["list"]["received"] < 1_382
    assert 0 < document["list"]["per_s"] < 200
    assert any("cut short" in text and "All of it takes" in text for text in texts(document, "slow"))
    assert document["elapsed_s"] < 11


def test_parameters_that_are_never_received_are_a_problem(command: Command, put: Put) -> None:
    done = command("check", put(PX4Vehicle(uid=1, dead=[100])), "--json")
    assert done.code == ExitCode.INCOMPLETE
    assert done.json["list"]["missing"] == 1
    assert any(text.startswith("1 index of 903 stayed missing") for text in texts(done.json, "problem"))


def test_other_stations_and_vehicles_are_named(command: Command, put: Put) -> None:
    air = Air(
        [PX4Vehicle(uid=1), ArduPilotVehicle(system=2)],
        others=[OtherStation(), OtherStation(system=255)],
    )
    document = command("check", put(air), "--system", "1", "--json").json
    assert document["link"]["autopilots"] == ["2/1"]
    assert document["link"]["stations"] == [
        {"system": 254, "component": 190, "has_our_address": False},
        {"system": 255, "component": 190, "has_our_address": True},
    ]
    assert any("has this one's address, 255/190" in text for text in texts(document, "problem"))
    assert any("254/190" in text for text in texts(document, "note"))


def test_nothing_is_changed(command: Command, put: Put, tmp_path: Path) -> None:
    """No message that is sent can write a parameter, a file or a setting."""
    for vehicle in (PX4Vehicle(uid=1, ftp=True, metadata=True), ArduPilotVehicle()):
        log = tmp_path / f"{type(vehicle).__name__}.tlog"
        before = {row.name: row.value for row in vehicle.params.values()}
        command("check", put(vehicle), "--tlog", log)
        sent: Counter[str] = Counter()
        for record in read_records(io.BytesIO(log.read_bytes())):
            for frame in frames.Framer(stream=False).receive(record.data):
                if frame.system != 255:
                    continue
                message = messages.decode(frame)
                sent[frames.message_name(frame.message_id)] += 1
                if isinstance(message, messages.CommandLong):
                    assert message.command in (
                        messages.MAV_CMD_REQUEST_MESSAGE,
                        messages.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES,
                    )
                if isinstance(message, messages.FileTransfer):
                    # terminate, reset, list, open to read, read, burst
                    assert message.payload[3] in (1, 2, 3, 4, 5, 15)
        assert set(sent) == {
            *("HEARTBEAT", "COMMAND_LONG", "FILE_TRANSFER_PROTOCOL"),
            *("PARAM_REQUEST_READ", "PARAM_REQUEST_LIST"),
        }
        assert {row.name: row.value for row in vehicle.params.values()} == before


# what is printed


def test_the_output_is_a_table(live_command: Command, put: Put) -> None:
    done = live_command("check", put(PX4Vehicle(uid=0x1234567890)))
    rows = {row[0]: row[1:] for row in done.rows if row}
    assert done.code == ExitCode.DONE
    assert rows["vehicle"] == ["1/1 px4 quadrotor, disarmed"]
    assert rows["firmware"][0].startswith("1.17.0-alpha, commit ")
    assert rows["hardware id"] == ["0000001234567890"]
    assert rows["list"][0].startswith("903 of 903 in ")
    assert rows["hash"][0].startswith("cf579589, the same after ")
    assert rows["other stations"] == ["none"]
    assert rows["note"]


def test_a_report_can_be_attached_to_an_issue(command: Command, put: Put, tmp_path: Path) -> None:
    path = tmp_path / "check.md"
    done = command("check", put(ArduPilotVehicle(armed=True)), "--report", path)
    assert done.code == ExitCode.DONE
    assert done.err == f"written to {path}\n"
    text = path.read_text(encoding="utf-8")
    assert text.startswith("# paramclient check sim:custom\n\nparamclient ")
    assert "| list | 1382 of 1382 in " in text
    assert "- **note**: The vehicle is armed" in text
    body = text[text.index("```json\n") + 8 : text.rindex("```")]
    assert '"findings": [' in body
    assert str(Path.home()) not in text


def test_an_existing_report_is_not_overwritten(command: Command, tmp_path: Path) -> None:
    path = tmp_path / "check.md"
    path.write_text("mine")
    done = command("check", "sim:px4", "--report", path)
    assert done.code == ExitCode.USAGE
    assert "exists already" in done.err
    assert path.read_text() == "mine"


def test_a_report_that_cannot_be_written(command: Command, tmp_path: Path) -> None:
    done = command("check", "sim:px4", "--report", tmp_path / "none" / "check.md")
    assert done.code == ExitCode.USAGE
    assert "cannot be written: No such file or directory" in done.err


def test_a_hostile_name_stays_in_its_cell(command: Command, put: Put, tmp_path: Path) -> None:
    path = tmp_path / "check.md"
    vehicle = PX4Vehicle(uid=1, ftp=True, metadata=True)
    command("check", put(vehicle), "--report", path)
    table = path.read_text(encoding="utf-8").split("## Slow or unusual")[0]
    rows = [line for line in table.splitlines() if line.startswith("| ")]
    assert all(line.count("|") - line.count("\\|") == 3 for line in rows)


@pytest.mark.parametrize("url", ["http://127.0.0.1:8765", "replay:nothing.tlog"])
def test_only_a_link_can_be_measured(command: Command, url: str, tmp_path: Path) -> None:
    done = command("check", url)
    assert done.code in (ExitCode.USAGE, ExitCode.LINK)
    assert done.out == ""


def test_a_log_cannot_be_measured(command: Command, tmp_path: Path) -> None:
    log = Path(__file__).parents[1] / "data" / "px4_get_set.tlog"
    done = command("check", f"replay:{log}")
    assert done.code == ExitCode.USAGE
    assert "is a log: check needs a link to a vehicle" in done.err


def test_no_vehicle(command: Command, put: Put) -> None:
    done = command("check", put(Air([])), "--timeout", "0.5")
    assert done.code == ExitCode.NO_ANSWER


# the API


@pytest.mark.anyio
async def test_the_diagnosis_needs_a_client_that_counts_traffic() -> None:
    async with ParamClient(SimLink(PX4Vehicle()), cache=False) as client:
        vehicle = await client.component()
        with pytest.raises(UsageError, match="traffic=True"):
            await check_vehicle(client, vehicle)


# what is found unusual


def report(**changes: Any) -> VehicleReport:
    """Return the report of a vehicle without findings, with these changes."""
    link = LinkReport(
        name="udpin:0.0.0.0:14550",
        seconds=5.0,
        round_trips=(0.002, 0.003, 0.004),
        unanswered=0,
        loss=0.0,
        lost=0,
        repeated=0,
        damaged=0,
        unusable_names=0,
        unknown=0,
        other_bytes=0,
        bytes_received=50_000,
        bytes_sent=2_000,
        mavlink=2,
        signed=0,
        autopilots=(),
        stations=(),
        radio_free=None,
    )
    plain = VehicleReport(
        system=1,
        component=1,
        autopilot="px4",
        vehicle_type="quadrotor",
        identity=Identity(1, link.name, UID),
        has_version=True,
        encoding=Encoding.BYTEWISE,
        encoding_reason="the vehicle's capability PARAM_ENCODE_BYTEWISE",
        is_armed=False,
        descriptions="mftp:///etc/extras/component_general.json.xz",
        link=link,
        reads=ReadService(0.001, 500.0, 30, 30, 30),
        list=ListService(900, 900, 0.9, 0.02, 1_000.0, 0.1, 0, 0, False, None),
        files=FileService(True, True, ("log/",), 15_000, 0.4, 900, 900, None),
        hash=HashService(0xCF579589, 0xCF579589, 2.0, True, None),
        elapsed=5.0,
    )
    parts = {
        name: replace(getattr(plain, name), **value) if isinstance(value, dict) else value
        for name, value in changes.items()
    }
    return replace(plain, **parts)


def test_nothing_unusual() -> None:
    assert findings_of(report()) == []


@pytest.mark.parametrize(
    ("changes", "severity", "text"),
    [
        ({"link": {"loss": 0.02, "lost": 40}}, Severity.SLOW, "2.0% of the vehicle's frames were lost"),
        ({"link": {"loss": 0.3, "lost": 400}}, Severity.PROBLEM, "30.0% of the vehicle's frames were lost"),
        ({"link": {"damaged": 1}}, Severity.PROBLEM, "1 frame had a wrong checksum"),
        ({"link": {"unusable_names": 2}}, Severity.PROBLEM, "2 messages had a parameter name"),
        ({"link": {"repeated": 7}}, Severity.NOTE, "7 frames arrived twice"),
        ({"link": {"unknown": 2}}, Severity.NOTE, "2 frames had message ids"),
        ({"link": {"mavlink": 1}}, Severity.NOTE, "speaks MAVLink 1"),
        ({"link": {"round_trips": (0.1, 0.6, 0.9)}}, Severity.SLOW, "The round trip is 0.60 s"),
        ({"link": {"round_trips": (), "unanswered": 1}}, Severity.PROBLEM, "No command was acknowledged"),
        ({"link": {"unanswered": 1}}, Severity.SLOW, "1 of 4 commands"),
        ({"link": {"stations": (HeardStation(255, 190, True),)}}, Severity.PROBLEM, "has this one's address"),
        (
            {"link": {"stations": (HeardStation(254, 190, False),)}},
            Severity.NOTE,
            "Another ground station, 254/190",
        ),
        ({"link": {"autopilots": ((2, 1), (3, 1))}}, Severity.NOTE, "2/1, 3/1"),
        ({"link": {"radio_free": 10}}, Severity.SLOW, "transmit buffer is 90 % full"),
        ({"link": {"signed": 12}}, Severity.NOTE, "has signed 12 frames"),
        ({"has_version": False}, Severity.PROBLEM, "did not answer the request for AUTOPILOT_VERSION"),
        (
            {"identity": {"uid": None}},
            Severity.NOTE,
            "no hardware id: the cache identifies it by system id and link",
        ),
        (
            {"identity": {"uid": "4954414c44494e4f"}},
            Severity.NOTE,
            "the cache identifies it by hardware id and system id",
        ),
        ({"encoding_reason": "the standard's encoding, …"}, Severity.PROBLEM, "bytewise is assumed"),
        ({"is_armed": True}, Severity.NOTE, "is armed"),
        ({"reads": {"single": None}}, Severity.PROBLEM, "No PARAM_REQUEST_READ was answered"),
        ({"reads": {"answered": 28}}, Severity.PROBLEM, "2 of 30 reads stayed unanswered"),
        ({"list": {"error": "no reply"}}, Severity.PROBLEM, "could not be downloaded: no reply"),
        ({"list": {"is_cut_short": True, "rate": 450.0}}, Severity.SLOW, "All of it takes 2 s"),
        ({"list": {"missing": 3}}, Severity.PROBLEM, "3 indices of 900 stayed missing"),
        ({"list": {"rate": 8.0}}, Severity.SLOW, "at 8 values per second"),
        ({"list": {"longest_pause": 1.2}}, Severity.SLOW, "paused for 1.2 s"),
        ({"files": {"size": None, "is_serving": False, "error": "x"}}, Severity.SLOW, "does not answer: x"),
        ({"files": {"size": None, "error": "file not found"}}, Severity.NOTE, "no packed parameter file"),
        ({"hash": {"before": None, "error": "silence"}}, Severity.SLOW, "silence: each session downloads"),
        ({"hash": {"after": 1}}, Severity.NOTE, "changed from cf579589 to 00000001 within 2.0 s"),
        ({"hash": {"confirms_list": False}}, Severity.SLOW, "did not confirm the downloaded list"),
        (
            {"files": {"defaults": 0}, "descriptions": None},
            Severity.NOTE,
            "neither defaults nor descriptions",
        ),
    ],
    ids=lambda value: str(value)[:40],
)
def test_an_unusual_result_becomes_a_finding(changes: dict[str, Any], severity: Severity, text: str) -> None:
    [finding] = findings_of(report(**changes))
    assert finding.severity is severity
    assert text in finding.text


def test_a_lossy_list_may_pause() -> None:
    """Requests for lost values explain a pause."""
    assert findings_of(report(list={"longest_pause": 1.2, "lost": 30})) == []


def test_problems_are_first() -> None:
    found = findings_of(report(is_armed=True, link={"damaged": 1}, list={"rate": 8.0}))
    assert [each.severity for each in found] == [Severity.PROBLEM, Severity.SLOW, Severity.NOTE]


def test_missing_measurements_have_no_findings() -> None:
    assert findings_of(report(reads=None, list=None, files=None, hash=None)) == []
