"""The benchmarks on links and on real vehicles run, and say what they should. No speed is judged here."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from paramclient.sim import PX4Vehicle
from tests.simulated_on_udp import flying
from tests.test_docs import ROOT, run

pytestmark = pytest.mark.slow


@pytest.fixture
def bench(tmp_path: Path) -> Callable[..., str]:
    """Run a benchmark, which must end with an exit code; return what it prints."""

    def call(name: str, *arguments: str, code: int = 0) -> str:
        done = run(str(ROOT / f"bench/{name}.py"), *arguments, cwd=tmp_path, timeout=120.0)
        assert done.returncode == code, done.stdout + done.stderr
        return done.stdout

    return call


def test_links_prints_the_row_of_exactly_this_name(bench: Callable[..., str]) -> None:
    name = "PX4 UDP 100 ms 20%"
    text = bench("links", "--row", name, "--seeds", "2")
    head, row = text.splitlines()
    assert head.split()[:4] == ["seconds", "worst", "oracle", "ratio"]
    figures = re.fullmatch(rf"{name} +(\S+) +(\S+) +(\S+) +(\S+) +\d+ +\d+ +\d+  2/2.*", row)
    assert figures, text
    assert all(0.3 < float(figure) < 60 for figure in figures.groups()), text  # simulated seconds


def test_gateway_prints_a_table(bench: Callable[..., str]) -> None:
    row, *_, own = bench("gateway", "--skip-direct", "--only", "PX4 clean").split("\n\n")[0].splitlines()[2:]
    assert re.fullmatch(r"\| PX4 clean \| pymavlink, the usual loop \|( \d+\.\d\d \|){4}  \|", row)
    assert re.fullmatch(r"\| PX4 clean \| the gateway itself \|  \|  \|( \d+\.\d\d \|){2} \d+ \|", own)


def test_peers_prints_a_table_of_a_real_vehicle(bench: Callable[..., str]) -> None:
    with flying(PX4Vehicle(table={"MC_ROLL_P": 6.5, "MC_PITCH_P": 6.5})) as link:
        text = bench("peers", "--repeat", "1", "--only", "paramclient", "clean", "5%", "--live", link)
    _, _, *rows = text.splitlines()[:4]
    assert [row.split(" | ")[0] for row in rows] == ["| real PX4, 2, clean", "| real PX4, 2, 5%"]
    assert all(re.search(r" \| \d+\.\d\d \(1\.0\) \|$", row) for row in rows), text
    assert re.search(r"PX4 quadrotor \d+\.\d+\.\d+", text), text


def test_live_fails_with_check_where_a_value_is_wrong(bench: Callable[..., str]) -> None:
    """The vehicle answers the fetch at the beginning with another value than those after it."""
    vehicle = PX4Vehicle(table={"MC_ROLL_P": 6.5, "MC_AIRMODE": 3})
    vehicle.when_listed(2, lambda: vehicle.set_param("MC_AIRMODE", 2))
    with flying(vehicle) as link:
        text = bench("live", link, "--kind", "px4", "--seeds", "1", "--row", "clean", "--check", code=1)
    assert "PX4, clean, run 0: 1 differ: MC_AIRMODE was 3, is 2" in text
    assert " missed |" in text
