"""Ten programs that write the cache are killed; `make kills` kills a thousand."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.postgres import PROGRAMS

ROOT = Path(__file__).parent.parent


@pytest.mark.skipif(sys.platform != "linux", reason="the clocks of processes are compared")
def test_nothing_that_was_acknowledged_and_flushed_is_lost_by_a_kill() -> None:
    """With a slack for computers on which everything else runs too; `make kills` is stricter."""
    kinds = "station,service" if PROGRAMS is None else "station,service,database"
    words = ["--kills", "10", "--slack", "2", "--only", kinds]
    ended = subprocess.run(
        [sys.executable, ROOT / "bench" / "kills.py", *words], capture_output=True, text=True, timeout=120
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    rows = ended.stdout.splitlines()[-len(kinds.split(",")) :]
    assert sum(int(row.split()[1]) for row in rows) == 10
