"""The benchmarks run and say what they should. How fast anything is, is not judged here."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from paramclient.sim import ArduPilotVehicle

ROOT = Path(__file__).parent.parent


def bench(name: str, *arguments: str) -> str:
    """What a benchmark prints."""
    run = subprocess.run(
        [sys.executable, f"bench/{name}.py", *arguments],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert run.returncode == 0, run.stderr
    return run.stdout


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
    """Without loss it takes one round trip and the burst; what is lost then costs whole round trips."""
    monkeypatch.syspath_prepend(ROOT / "bench")
    from oracle import TellingLink, file_oracle_time

    def seconds(loss: float, trip: float) -> float:
        links = [TellingLink(loss=loss, delay=trip / 2, seed=seed) for seed in (1, 2)]
        vehicle = partial(ArduPilotVehicle, ftp_rate=48_500.0)
        return file_oracle_time(vehicle, *links, burst_rate=48_500.0, reads_per_second=547.0)

    burst = seconds(0.0, 0.0)
    assert 0.3 < burst < 0.4
    assert seconds(0.0, 2.5) == pytest.approx(burst + 2.5, abs=0.01)
    assert burst + 2.5 < seconds(0.05, 2.5) < burst + 4 * 2.5


def test_service_prints_what_many_clients_at_once_cost() -> None:
    text = bench("service", "--listeners", "4", "--reads", "20", "--seconds", "1")
    assert re.search(
        r"^4 listeners: 4 were told of every one of [\d,]+ events or more, in order: met$", text, re.MULTILINE
    )
    assert re.search(r"^20 reads at 20 a second, .*ms for the slowest of 100", text, re.MULTILINE), text
    assert re.search(r"^\d\.\d\d of a core in 1\.0 s", text, re.MULTILINE), text


def test_peers_prints_a_table_of_who_got_everything() -> None:
    text = bench("peers", "--repeat", "1", "--only", "paramclient", "pymavlink", "clean")
    head, _, *rows = text.splitlines()[:5]
    assert head == "| vehicle, parameters, loss | paramclient | pymavlink, the usual loop |"
    seconds = r"\d+\.\d\d \(\d+\.\d\)"
    assert re.fullmatch(rf"\| PX4, 903, clean \| {seconds} \| {seconds} \|", rows[0]), text
    assert re.fullmatch(rf"\| ArduPilot, 1382, clean \| {seconds} \| {seconds} \|", rows[1]), text
    assert re.fullmatch(rf"\| ArduPilot by file, 1382, clean \| {seconds} \| has no .* \|", rows[2]), text
    assert re.search(r"\d{4}-\d\d-\d\d, \d+ cores, .*Python \S+, load [\d.]+ to [\d.]+", text), text
