"""apply, verify and restore over a service: the output and exit codes of a link; Ctrl-C cancels the job."""

from __future__ import annotations

import asyncio
import re
import signal
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import anyio
import pytest

from paramclient import LinkError
from paramclient.cache import ParamCache
from paramclient.cli import apply_over_service
from paramclient.cli import session as cli_session
from paramclient.links import SimLink
from paramclient.remote import RemoteComponent
from paramclient.service import Hub
from paramclient.sim import Air, ArduPilotVehicle, GenericVehicle, PX4Vehicle
from tests.client_kinds import ServedClient
from tests.commands import Command, Put, behind, in_process, leaping

SERVICE = "http://127.0.0.1:8765"
TABLE: dict[str, int | float] = {"GAIN": 4.0, "MODE": 2, "RATE": 0.5}


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Command:
    """Run the command line in this process, on simulated time, with a new cache."""
    leaping(monkeypatch)
    return in_process(capsys, "--cache", str(tmp_path / "cache.sqlite3"))


class ApartHub:
    """A hub in a task of its own, which the end of the command does not cancel, as that of another program.

    Args:
        hub: the hub.
    """

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._closing = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> None:
        opened = asyncio.Event()

        async def run() -> None:
            async with self._hub:
                opened.set()
                await self._closing.wait()

        self._task = asyncio.get_running_loop().create_task(run())
        await opened.wait()

    async def __aexit__(self, *_: object) -> None:
        self._closing.set()
        with anyio.CancelScope(shield=True):
            assert self._task is not None
            await self._task


def serving(monkeypatch: pytest.MonkeyPatch, kept: ParamCache | None = None) -> Put:
    """Return a function that connects every URL to a service with the vehicle."""

    def place(far_end: Any) -> str:
        def client(url: str, **_: Any) -> ServedClient:
            made = ServedClient(SimLink(far_end, "sim:custom"), kept=kept)
            monkeypatch.setattr(made, "hub", ApartHub(made.hub))
            return made

        monkeypatch.setattr(cli_session, "ParamClient", client)
        return SERVICE

    return place


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> Put:
    """Connect every URL to a service with the vehicle."""
    return serving(monkeypatch)


@pytest.fixture
def kept(tmp_path: Path) -> Iterator[ParamCache]:
    """The cache of a service."""
    with ParamCache(tmp_path / "service.sqlite3") as cache:
        yield cache


@pytest.fixture
def keeping(monkeypatch: pytest.MonkeyPatch, kept: ParamCache) -> Put:
    """Connect every URL to a service with the vehicle and a cache."""
    return serving(monkeypatch, kept)


@pytest.fixture
def put(monkeypatch: pytest.MonkeyPatch) -> Put:
    return behind(monkeypatch, "udpin:0.0.0.0:14550")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "tuned.parm"
    path.write_text("GAIN,6.5\nRATE,0.1\nMODE,2\nABSENT,1\n")
    return path


def copter(**options: Any) -> ArduPilotVehicle:
    return ArduPilotVehicle(live=(), table=TABLE, **options)


def comparable(text: str) -> str:
    """The text without durations, times, ages and the name of the link."""
    return re.sub(
        r'in \d+\.\d s|"elapsed_s": [\d.]+|on (udpin|http)\S+|\d{4}-\d\d-\d\dT\S+|\d+ s ago', "", text
    )


@pytest.mark.parametrize("options", [[], ["--full"], ["--json"], ["--json", "--full"], ["--dry-run"]])
@pytest.mark.parametrize("kind", [copter, lambda: PX4Vehicle(table=TABLE)])
def test_it_prints_what_it_prints_on_a_link(
    command: Command, put: Put, served: Put, file: Path, options: list[str], kind: Callable[[], Any]
) -> None:
    on_link = command("apply", put(kind()), file, *options)
    vehicle = kind()
    done = command("apply", served(vehicle), file, *options)
    assert done.code == on_link.code == 1  # ABSENT is not on the vehicle
    assert comparable(done.out) == comparable(on_link.out)
    assert comparable(done.err) == comparable(on_link.err)
    is_written = "--dry-run" not in options
    assert vehicle.values["GAIN"] == (6.5 if is_written else 4.0)


def test_a_dry_run_in_json_is_the_plan(command: Command, put: Put, served: Put, file: Path) -> None:
    words = (file, "--dry-run", "--json")
    assert command("apply", served(copter()), *words).json == command("apply", put(copter()), *words).json


def test_the_exit_code_is_0_if_the_vehicle_has_all_values(
    command: Command, served: Put, tmp_path: Path
) -> None:
    file = tmp_path / "one.parm"
    file.write_text("GAIN,6.5\n")
    assert command("apply", served(copter()), file).code == 0


def test_an_armed_vehicle_refuses(command: Command, put: Put, served: Put, file: Path) -> None:
    on_link = command("apply", put(copter(armed=True)), file)
    vehicle = copter(armed=True)
    done = command("apply", served(vehicle), file)
    assert (done.code, done.out) == (on_link.code, on_link.out)
    assert done.err.splitlines()[-1] == on_link.err.splitlines()[-1]
    assert dict(vehicle.values) == TABLE


class Dying(GenericVehicle):
    """Falls silent at its 12th PARAM_SET."""

    def _on_set(self, request: Any, sender: Any) -> None:
        super()._on_set(request, sender)
        if self.requests["PARAM_SET"] == 12:
            self._switch_on(float("inf"))


class Interrupting(GenericVehicle):
    """Presses Ctrl-C at its 12th PARAM_SET, and ignores that and all further ones until it `ends`."""

    ends = False

    def _on_set(self, request: Any, sender: Any) -> None:
        if self.requests["PARAM_SET"] == 12:
            signal.raise_signal(signal.SIGINT)
        if self.requests["PARAM_SET"] < 12 or self.ends:
            super()._on_set(request, sender)


NAMES = [f"P{number:02}" for number in range(40)]


@pytest.fixture
def many(tmp_path: Path) -> Path:
    path = tmp_path / "many.parm"
    path.write_text("".join(f"{name},2\n" for name in NAMES))
    return path


def test_the_error_that_ends_a_set_up_has_the_same_exit_code(
    command: Command, put: Put, served: Put, many: Path
) -> None:
    on_link = command("apply", put(Dying(dict.fromkeys(NAMES, 1))), many)
    done = command("apply", served(Dying(dict.fromkeys(NAMES, 1))), many)
    assert done.code == on_link.code == 3
    assert re.search(r"1/1 generic: no reply: .*; run it again to continue\n", done.err)
    reported = command("apply", served(Dying(dict.fromkeys(NAMES, 1))), many, "--json")
    assert reported.json["error"].startswith("no reply")
    assert "problem" not in reported.json


@pytest.mark.parametrize("as_json", [False, True])
def test_ctrl_c_cancels_the_job_and_prints_the_outcomes_so_far(
    command: Command, served: Put, many: Path, as_json: bool
) -> None:
    vehicle = Interrupting(dict.fromkeys(NAMES, 1))
    done = command("apply", served(vehicle), many, *(["--json"] if as_json else []))
    assert done.code == 130
    assert sum(value == 2 for value in vehicle.values.values()) < len(NAMES)
    if as_json:
        assert (done.json["complete"], done.json["error"]) == (False, "interrupted")
        assert {row["status"] for row in done.json["params"].values()} == {"unproven"}
    else:
        assert done.rows[1][4:] == ["unproven", "acknowledged, and not read back"]
        assert re.search(r"interrupted: \d+ values? acknowledged, not proven, .*; run it again", done.err)


def test_a_job_that_ends_before_it_is_cancelled_prints_its_result(
    command: Command, served: Put, many: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def too_late(component: RemoteComponent, job: str) -> None:
        pass

    monkeypatch.setattr(RemoteComponent, "cancel_job", too_late)
    vehicle = Interrupting(dict.fromkeys(NAMES, 1))
    vehicle.ends = True
    done = command("apply", served(vehicle), many)
    assert done.code == 130
    assert len(done.rows) == 1 + len(NAMES)
    assert "40 set in" in done.err


def test_a_job_that_cannot_be_cancelled_is_named(
    command: Command, served: Put, many: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def lost(component: RemoteComponent, job: str) -> None:
        raise LinkError("the service cannot be reached", link=SERVICE)

    monkeypatch.setattr(RemoteComponent, "cancel_job", lost)
    done = command("apply", served(Interrupting(dict.fromkeys(NAMES, 1))), many)
    assert done.code == 130
    address = r"http://127\.0\.0\.1:8765/api/v1/jobs/\w+"
    assert re.search(
        rf"the set-up of 1/1 generic goes on at the service as job \w+: GET {address} shows it, "
        rf"DELETE {address} cancels it\n",
        done.err,
    )


def test_changes_are_confirmed_on_a_terminal(
    command: Command, served: Put, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def decline(question: str) -> bool:
        return False

    monkeypatch.setattr(apply_over_service, "can_confirm", lambda options: True)
    monkeypatch.setattr(apply_over_service, "confirm", decline)
    vehicle = copter()
    done = command("apply", served(vehicle), file)
    assert (done.code, dict(vehicle.values)) == (1, TABLE)
    assert ["1", "GAIN", "4.0", "6.5", "set", "all other parameters"] in done.rows
    assert command("apply", served(vehicle), file, "--yes").code == 1
    assert vehicle.values["GAIN"] == 6.5


def test_renames_and_an_overlay_are_used(command: Command, served: Put, file: Path, tmp_path: Path) -> None:
    over, renames = tmp_path / "over.parm", tmp_path / "renames.yaml"
    over.write_text("GAIN,7.5\n")
    file.write_text("GAIN,6.5\nOLD_RATE,0.1\n")
    renames.write_text("- {old: OLD_RATE, new: RATE}\n")
    vehicle = copter()
    done = command("apply", served(vehicle), file, "--overlay", over, "--renames", renames)
    assert done.code == 0, done.err
    assert vehicle.values["GAIN"] == 7.5
    assert vehicle.values["RATE"] == pytest.approx(0.1)
    assert "RATE on this vehicle" in done.out


def test_several_vehicles_are_refused(command: Command, served: Put, file: Path) -> None:
    vehicles = [copter(system=1), copter(system=2)]
    done = command("apply", served(Air(vehicles)), file)
    assert done.code == 2
    assert "2 vehicles on" in done.err
    assert all(dict(each.values) == TABLE for each in vehicles)
    assert command("apply", served(Air([copter(system=1), copter(system=2)])), file, "--system", 2).code == 1


@pytest.mark.parametrize("option", [["--all"], ["--backup", "x.parm"], ["--metadata", "FILE"]])
def test_options_that_need_the_link_are_refused(
    command: Command, served: Put, file: Path, tmp_path: Path, option: list[str]
) -> None:
    described = Path(__file__).parents[2] / "examples/metadata/copter.pdef.xml"
    words = [str(described) if word == "FILE" else word for word in option]
    if words[0] == "--backup":
        words[1] = str(tmp_path / words[1])
    vehicle = copter()
    done = command("apply", served(vehicle), file, *words)
    assert done.code == 2
    assert "need the link itself" in done.err
    assert dict(vehicle.values) == TABLE


# verify


@pytest.mark.parametrize("options", [[], ["--full"], ["--json"], ["--json", "--full"]])
def test_verify_prints_what_it_prints_on_a_link(
    command: Command, put: Put, served: Put, file: Path, options: list[str]
) -> None:
    on_link = command("verify", put(copter()), file, *options)
    vehicle = copter()
    done = command("verify", served(vehicle), file, *options)
    assert done.code == on_link.code == 1
    assert (done.out, comparable(done.err)) == (on_link.out, comparable(on_link.err))
    assert "ABSENT" in done.out
    assert dict(vehicle.values) == TABLE


def test_verify_ends_with_0_if_the_vehicle_has_all_values(
    command: Command, served: Put, tmp_path: Path
) -> None:
    file = tmp_path / "one.parm"
    file.write_text("GAIN,4\n")
    for options in ([], ["--json"]):
        assert command("verify", served(copter()), file, *options).code == 0


def test_verify_uses_renames_and_an_overlay(
    command: Command, put: Put, served: Put, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # a service receives the name of a file, not its folder
    over, renames = Path("over.parm"), Path("renames.yaml")
    over.write_text("GAIN,4.0\n")
    file.write_text("GAIN,6.5\nOLD_RATE,0.5\nGONE,1\n")
    renames.write_text("- {old: OLD_RATE, new: RATE}\n- {old: GONE, new: GONE_TOO}\n")
    words = (file, "--overlay", over, "--renames", renames, "--full")
    done = command("verify", served(copter()), *words)
    on_link = command("verify", put(copter()), *words)
    assert (done.code, done.out) == (on_link.code, on_link.out)
    assert "RATE on this vehicle" in done.out
    assert "GONE_TOO" in done.out


@pytest.mark.parametrize("option", [["--all"], ["--all", "--expect", "2"], ["--metadata", "FILE"]])
def test_verify_refuses_options_that_need_the_link(
    command: Command, served: Put, file: Path, option: list[str]
) -> None:
    described = Path(__file__).parents[2] / "examples/metadata/copter.pdef.xml"
    done = command(
        "verify", served(copter()), file, *[described if word == "FILE" else word for word in option]
    )
    assert done.code == 2
    assert "--all, --expect and --metadata FILE need the link itself" in done.err


# restore


@pytest.mark.parametrize("options", [[], ["--full"], ["--json"], ["--json", "--full"], ["--dry-run"]])
@pytest.mark.parametrize("kind", [copter, lambda: PX4Vehicle(table=TABLE)])
def test_restore_prints_what_it_prints_on_a_link(
    command: Command, put: Put, keeping: Put, file: Path, options: list[str], kind: Callable[[], Any]
) -> None:
    on_board = kind()
    command("apply", put(on_board), file)
    on_link = command("restore", put(on_board), *options)
    vehicle = kind()
    assert command("apply", keeping(vehicle), file).code == 1
    assert vehicle.values["GAIN"] == 6.5
    done = command("restore", keeping(vehicle), *options)
    assert done.code == on_link.code == 0, done.err
    assert comparable(done.out) == comparable(on_link.out)
    assert comparable(done.err).strip() == comparable(on_link.err).strip()
    assert re.search(
        r"^the state is that before the last apply, \d+ s ago \(snapshot 1\); "
        r"changed since then: (GAIN \d+ s ago, RATE \d+ s ago|RATE \d+ s ago, GAIN \d+ s ago)$",
        done.err,
        re.MULTILINE,
    ), done.err
    assert done.err.count("restored the state before the last apply, ") == ("--dry-run" not in options)
    assert "the state: 3 parameters of 1/1" in done.err
    assert vehicle.values["GAIN"] == (6.5 if "--dry-run" in options else 4.0)


def test_restore_takes_the_number_of_a_snapshot_and_a_time(
    command: Command, keeping: Put, file: Path, kept: ParamCache
) -> None:
    vehicle = copter()
    command("apply", keeping(vehicle), file)
    command("restore", keeping(vehicle))
    assert vehicle.values["GAIN"] == 4.0
    [before_apply, before_restore] = kept.snapshots(kept.components()[0].key, 1)
    vehicle = copter()  # a new one, as each command begins its simulated time anew
    assert command("restore", keeping(vehicle), before_restore.id).code == 0
    assert vehicle.values["GAIN"] == 6.5
    done = command("restore", keeping(vehicle), before_apply.id, "--dry-run", "--json")
    assert (done.code, done.json["params"]["GAIN"]["wanted"]) == (0, 4.0)
    assert vehicle.values["GAIN"] == 6.5
    assert command("restore", keeping(copter()), "2h ago").code == 5
    vehicle = ArduPilotVehicle(live=(), table=dict(vehicle.values))
    moment = datetime.fromtimestamp(before_apply.at, UTC).isoformat()
    assert command("restore", keeping(vehicle), moment).code == 0
    assert vehicle.values["GAIN"] == 4.0


def test_restore_does_not_undo_an_apply_twice(command: Command, keeping: Put, file: Path) -> None:
    vehicle = copter()
    command("apply", keeping(vehicle), file)
    assert command("restore", keeping(vehicle)).code == 0
    vehicle = copter()  # a new one, as each command begins its simulated time anew
    assert command("set", keeping(vehicle), "RATE", 0.75).code == 0
    for options in ((), ("--dry-run",)):
        again = command("restore", keeping(vehicle), *options)
        assert again.code == 2
        assert re.search(r"a restore ran \d+ s ago, after the last apply", again.err)
        assert f"`paramclient restore {SERVICE} 1` for the state before that apply" in again.err
        assert f"`paramclient restore {SERVICE} 2` for the state before that restore" in again.err
        assert re.search(rf"or a time, as in `paramclient restore {SERVICE} '\d+s ago'`", again.err)
        assert f"GET {SERVICE}/api/v1/components/1/1/snapshots lists the snapshots" in again.err
    assert vehicle.values["RATE"] == 0.75


def test_restore_names_what_the_cache_of_the_service_lacks(command: Command, put: Put, keeping: Put) -> None:
    for words in ([], ["99"]):
        on_link = command("restore", put(copter()), *words)
        done = command("restore", keeping(copter()), *words)
        assert (done.code, done.out) == (on_link.code, "")
        assert on_link.err.splitlines()[-1].startswith(done.err.splitlines()[-1].rstrip("."))


def test_restore_is_confirmed_on_a_terminal(
    command: Command, keeping: Put, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def decline(question: str) -> bool:
        return False

    vehicle = copter()
    command("apply", keeping(vehicle), file)
    monkeypatch.setattr(apply_over_service, "can_confirm", lambda options: True)
    monkeypatch.setattr(apply_over_service, "confirm", decline)
    done = command("restore", keeping(vehicle))
    assert (done.code, vehicle.values["GAIN"]) == (1, 6.5)
    assert ["1", "GAIN", "6.5", "4.0", "set", "all other parameters"] in done.rows
    assert command("restore", keeping(vehicle), "--yes").code == 0
    assert vehicle.values["GAIN"] == 4.0


def test_ctrl_c_cancels_a_restore(command: Command, keeping: Put, many: Path) -> None:
    vehicle = GenericVehicle(dict.fromkeys(NAMES, 1))
    assert command("apply", keeping(vehicle), many).code == 0
    interrupting = Interrupting(dict.fromkeys(NAMES, 2))
    done = command("restore", keeping(interrupting))
    assert done.code == 130
    assert f"to continue: `paramclient restore {SERVICE} 1`" in done.err
    assert list(interrupting.values.values()).count(2) > 0


def test_an_armed_vehicle_refuses_a_restore(command: Command, keeping: Put, file: Path) -> None:
    vehicle = copter()
    command("apply", keeping(vehicle), file)
    armed = ArduPilotVehicle(live=(), table=dict(vehicle.values), armed=True)
    refused = command("restore", keeping(armed))
    assert (refused.code, armed.values["GAIN"]) == (1, 6.5)
    assert "armed" in refused.err
    assert command("restore", keeping(armed), "--allow-armed").code == 0
    assert armed.values["GAIN"] == 4.0


@pytest.mark.parametrize("words", [["--backup", "x.parm"], ["FILE"]])
def test_restore_refuses_files(
    command: Command, keeping: Put, file: Path, tmp_path: Path, words: list[str]
) -> None:
    vehicle = copter()
    given = [{"x.parm": tmp_path / "x.parm", "FILE": file}.get(word, word) for word in words]
    done = command("restore", keeping(vehicle), *given)
    assert done.code == 2
    assert "a backup file and --backup need the link itself" in done.err
    assert dict(vehicle.values) == TABLE
