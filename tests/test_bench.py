"""The benchmarks run and say what they should. How fast anything is, is not judged here."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from paramclient.model.values import ParamType
from paramclient.sim import ArduPilotVehicle, PX4Vehicle
from tests.simulated_on_udp import flying

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parent.parent


def bench(name: str, *arguments: str, code: int = 0) -> str:
    """What a benchmark prints; it must end with this exit code."""
    run = subprocess.run(
        [sys.executable, f"bench/{name}.py", *arguments],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert run.returncode == code, run.stdout + run.stderr
    return run.stdout


@pytest.mark.parametrize(
    "group",
    [
        *("handshakes over", "requests", "large fleet", "slices", "waiting", "parsing", "guesses", "origins"),
        *("stuck", "hostile", "similar", "extended", "long"),
    ],
)
def test_attacks_are_held(group: str) -> None:
    """The quick ones, with time for a machine that does other things besides."""
    text = bench("attack", "--quick", "--slack", "40", "--only", group)
    assert re.match(r"attack +what +limit +measured +held$", text, re.MULTILINE), text
    assert " NO" not in text


def test_cost_prints_every_figure_beside_its_target() -> None:
    text = bench("cost", "--rounds", "1", "--seconds", "0.2")
    for way in ("pymavlink, parsing only", "in a fetch", "first values", "values known"):
        assert re.search(rf"{way} +[\d,]+ +\d+\.\d\d +[\d,]+ +\d+\.\d\d$", text, re.MULTILINE), text
    assert len(re.findall(r"^hearing [\d,]+ other frames a second.* of a core", text, re.MULTILINE)) == 2, (
        text
    )
    assert re.search(r"^memory of 1,000 parameters: \d+ KiB", text, re.MULTILINE), text
    assert len(re.findall(r"target.*: (?:met|missed)\b", text)) == 4, text


@pytest.mark.parametrize("name", ["PX4 UDP 100 ms 20%", "ArduPilot by FTP UDP 100 ms 20%"])
def test_links_prints_the_row_of_exactly_this_name(name: str) -> None:
    text = bench("links", "--row", name, "--seeds", "2")
    head, row = text.splitlines()
    assert head.split()[:4] == ["seconds", "worst", "oracle", "ratio"]
    figures = re.fullmatch(rf"{name} +(\S+) +(\S+) +(\S+) +(\S+) +\d+ +\d+ +\d+  2/2.*", row)
    assert figures, text
    assert all(0.3 < float(figure) < 60 for figure in figures.groups()), text  # simulated seconds


def test_the_oracle_by_file_waits_one_round_trip_for_what_was_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Without loss it takes two round trips, the second to close the session, and the burst. What is lost
    then costs whole round trips."""
    monkeypatch.syspath_prepend(ROOT / "bench")
    from oracle import TellingLink, file_oracle_time

    def seconds(loss: float, trip: float) -> float:
        links = [TellingLink(loss=loss, delay=trip / 2, seed=seed) for seed in (1, 2)]
        vehicle = partial(ArduPilotVehicle, ftp_rate=48_500.0)
        return file_oracle_time(vehicle, *links, burst_rate=48_500.0, reads_per_second=547.0)

    burst = seconds(0.0, 0.0)
    assert 0.3 < burst < 0.4
    assert seconds(0.0, 2.5) == pytest.approx(burst + 2 * 2.5, abs=0.01)
    assert burst + 2 * 2.5 < seconds(0.05, 2.5) < burst + 5 * 2.5


def test_service_prints_what_many_clients_at_once_cost() -> None:
    text = bench("service", "--listeners", "4", "--reads", "20", "--seconds", "1")
    assert re.search(
        r"^4 listeners: 4 received every one of [\d,]+ events or more, in order: met$", text, re.MULTILINE
    )
    assert re.search(r"^20 reads at 20 a second, .*ms for the slowest of 100", text, re.MULTILINE), text
    assert re.search(r"^\d\.\d\d of a core in 1\.0 s", text, re.MULTILINE), text


def test_peers_prints_a_table_of_who_got_everything() -> None:
    text = bench("peers", "--repeat", "1", "--only", "paramclient", "pymavlink", "clean")
    head, _, *rows = text.splitlines()[:5]
    assert head == "| vehicle, parameters, loss | paramclient | pymavlink, the usual loop |"
    seconds = r"\d+\.\d\d \(\d+\.\d\)"
    assert re.fullmatch(rf"\| PX4, 903, clean \| {seconds} \| {seconds} \|", rows[0]), text
    assert re.fullmatch(rf"\| ArduPilot by list, 1382, clean \| {seconds} \| {seconds} \|", rows[1]), text
    assert re.fullmatch(rf"\| ArduPilot by file, 1382, clean \| {seconds} \| not supported \|", rows[2]), text
    assert re.search(r"\d{4}-\d\d-\d\d, \d+ cores, .*Python \S+, load [\d.]+ to [\d.]+", text), text


def test_peers_prints_a_table_of_a_real_vehicle() -> None:
    with flying(PX4Vehicle(table={"MC_ROLL_P": 6.5, "MC_PITCH_P": 6.5})) as link:
        text = bench("peers", "--repeat", "1", "--only", "paramclient", "clean", "5%", "--live", link)
    _, _, *rows = text.splitlines()[:4]
    assert [row.split(" | ")[0] for row in rows] == ["| real PX4, 2, clean", "| real PX4, 2, 5%"]
    assert all(re.search(r" \| \d+\.\d\d \(1\.0\) \|$", row) for row in rows), text
    assert re.search(r"PX4 quadrotor \d+\.\d+\.\d+", text), text


def test_live_prints_the_rows_of_a_vehicle_and_what_is_promised() -> None:
    with flying(PX4Vehicle(table={"MC_ROLL_P": 6.5, "MC_AIRMODE": 3})) as link:
        text = bench("live", link, "--kind", "px4", "--seeds", "2", "--row", "clean", "--row", "command")
    head, _, *rows = text.splitlines()[:4]
    assert head == "| real autopilot | median | worst | limit (median / worst) |"
    figures = r"\d+\.\d\d \| \d+\.\d\d \|"
    assert re.fullmatch(rf"\| PX4, clean \| {figures} 0\.95 / 1 \|", rows[0]), text
    assert re.fullmatch(rf"\| PX4, command: .* \| {figures} 0\.6 / 0\.9(?: missed)? \|", rows[1]), text
    assert re.search(r"\d{4}-\d\d-\d\d, \d+ cores, .* load .* PX4 quadrotor", text), text


def test_live_fails_with_check_where_a_value_is_wrong() -> None:
    """The vehicle answers the fetch at the beginning with another value than those after it."""
    vehicle = PX4Vehicle(table={"MC_ROLL_P": 6.5, "MC_AIRMODE": 3})
    vehicle.when_listed(2, lambda: vehicle.set_param("MC_AIRMODE", 2))
    with flying(vehicle) as link:
        arguments = ["live", link, "--kind", "px4", "--seeds", "1", "--row", "clean", "--check"]
        text = bench(*arguments, code=1)
    assert "PX4, clean, run 0: 1 differ: MC_AIRMODE was 3, is 2" in text
    assert " missed |" in text


def test_live_applies_values_in_groups_and_puts_everything_back() -> None:
    switches = ("FENCE_ENABLE", "GRIP_ENABLE", "SCR_ENABLE", "FOLL_ENABLE")
    vehicle = ArduPilotVehicle(
        table=dict.fromkeys(switches, (ParamType.INT8, 0)),
        groups={
            switch: {f"{switch[:4]}_LIMIT{number}": (ParamType.REAL32, 5.0) for number in range(7)}
            for switch in switches
        },
    )
    before = vehicle.values
    with flying(vehicle) as link:
        text = bench("live", link, "--kind", "ardupilot", "--seeds", "2", "--row", "apply")
    row = text.splitlines()[2]
    assert re.match(r"\| ArduPilot, apply 30 values in 4 groups \| \d+\.\d\d \| \d+\.\d\d \|", row), text
    assert vehicle.values == before
    vehicle.set_param("GRIP_ENABLE", 1)
    assert vehicle.values["GRIP_LIMIT0"] == 5.0  # what is hidden too
