"""The benchmarks run and say what they should. How fast anything is, is not judged here."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

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


def test_peers_prints_a_table_of_who_got_everything() -> None:
    text = bench("peers", "--repeat", "1", "--only", "paramclient", "pymavlink", "PX4 clean")
    head, _, *rows = text.splitlines()[:4]
    assert head == "| client | PX4 (903), clean |"
    for row, client in zip(rows, ("paramclient", "pymavlink"), strict=True):
        assert re.fullmatch(rf"\| {client}.* \| \d+\.\d\d \(\d+\.\d\) \|", row), text
