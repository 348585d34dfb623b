"""Let atheris look for inputs that break a target: `python -m fuzz component --seconds 1800`.

What it finds to reach new code is kept in `fuzz/corpus/<target>`, and what breaks something in
`fuzz/findings/<target>`. Further arguments go to libFuzzer. Before a corpus is committed, `python -m
fuzz.keep` leaves of it what is needed.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from pathlib import Path
from typing import Final

import atheris

HERE: Final = Path(__file__).parent
TARGETS: Final = sorted(
    path.stem
    for path in HERE.glob("*.py")
    if path.stem not in ("__init__", "__main__", "draw", "keep", "over_http")
)


def main() -> None:
    parser = argparse.ArgumentParser(prog="fuzz", description="Look for inputs that break a target.")
    parser.add_argument("target", choices=TARGETS)
    parser.add_argument("--seconds", type=int, default=1800, help="how long; 1800 unless it is said")
    parser.add_argument("--corpus", type=Path, help="where inputs are kept; fuzz/corpus/<target>")
    asked, options = parser.parse_known_args()
    corpus = asked.corpus or HERE / "corpus" / asked.target
    findings = HERE / "findings" / asked.target
    for folder in (corpus, findings):
        folder.mkdir(parents=True, exist_ok=True)
    with atheris.instrument_imports(include=["paramclient"]):
        target = importlib.import_module(f"fuzz.{asked.target}")
    arguments = [f"-max_total_time={asked.seconds}", f"-artifact_prefix={findings}/", "-print_final_stats=1"]
    arguments += [f"-max_len={target.LONGEST}", "-len_control=0"]
    atheris.Setup([sys.argv[0], *arguments, str(corpus), *options], target.run)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
