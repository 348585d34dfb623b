"""Every example runs by itself, as a program of its own, and prints what it should."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from tests.test_docs import run

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).parent.parent / "examples"

PRINTED = {
    "companion": [
        r"serving /dev/\S+ on http://127\.0\.0\.1:\d+",
        r"accepted: MC_ROLL_P = 6\.5",
        r"BAT1_N_CELLS = 6, was 4",
        r"the service has ended with 0",
    ],
    "demo": [
        r"903 parameters, 0 missing, hash cf579589",
        r"903 parameters from the cache",
        r"equal to the vehicle's own table: yes",
        r"accepted: MC_ROLL_P = 7\.25; on board: 7\.25",
        r"(cold fetch|second run, from the cache|one set, confirmed) +\d+\.\d+ +[\d,]+ +[\d,]+",
    ],
    "offline": [
        r"visit: <FetchResult 1/1 903 params from stream in ",
        r"known: .+ \(system 1, px4, components 1, last seen \d{4}-\d\d-\d\d \d\d:\d\dZ\)",
        r"table: <CachedComponent 1/1 px4 903 params synced ",
        r"MC_ROLL_P = 4\.0 -> MC_ROLL_P = 7\.0, by us",
    ],
    "read_one": [r"MC_ROLL_P = 4\.0 +\(index 547, bits 40800000\)"],
    "set_and_prove": [
        r"done: +MC_ROLL_P = 7\.0",
        r"done: +COM_DISARM_LAND = 3\.0",
        r"wrong: +1\.5 is not a whole number",
        r"refused: .*NO_SUCH",
    ],
    "apply_ardupilot": [
        r"1: <ApplyResult 1/1 8 accepted, 1 skipped in ",
        r"1: COMPASS_OFS_X = 5\.0, skipped: left out: ",
        r"1: as wanted",
    ],
    "apply_px4": [
        r"  SYS_AUTOSTART 10040 -> 4001, set \(takes effect after a reboot\)",
        r"CAL_ACC0_XOFF 0\.0 -> 0\.0125, skipped: left out: ",
        r"the vehicle reboots",
        r"7/7 ",
        r"<ApplyResult 1/1 7 accepted, 1 skipped in .*; the state before is in before-.*\.json",
        r"the vehicle matches the file",
    ],
    "test_your_program": [r"changed: \['MPC_XY_VEL_MAX', 'MPC_Z_VEL_MAX_UP'\]"],
    "two_vehicles": [
        r"<FetchResult 1/1 903 params from stream in ",
        r"<FetchResult 2/1 903 params from stream in ",
        r"MC_ROLL_P = 4\.0 on 1, MC_ROLL_P = 8\.0 on 2",
    ],
    "watch": [
        r"<Component 1/1 px4 synced 903 params",
        r"MC_PITCH_P = 4\.0 -> MC_PITCH_P = 7\.5, by vehicle",
        r"MC_ROLL_P = 4\.0 -> MC_ROLL_P = 7\.0, by vehicle",
    ],
}


def test_every_example_is_tested() -> None:
    assert {path.stem for path in EXAMPLES.glob("*.py")} == set(PRINTED)


@pytest.mark.parametrize("name", PRINTED)
def test_runs(name: str, tmp_path: Path) -> None:
    if name == "companion" and shutil.which("curl") is None:
        pytest.skip("its shell script needs curl, which is not installed here")
    done = run("-W", "error", str(EXAMPLES / f"{name}.py"), cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    for line in PRINTED[name]:
        assert re.search(line, done.stdout), f"{line!r} is not in\n{done.stdout}"
    assert "\x1b" not in done.stdout
