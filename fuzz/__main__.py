"""Run atheris on a fuzz target: `python -m fuzz component --seconds 1800`.

Inputs that reach new code are stored in `fuzz/corpus/<target>`, inputs that fail in
`fuzz/findings/<target>`. Further arguments are passed to libFuzzer. Before a corpus is committed, `python -m
fuzz.keep` reduces it to the inputs that are needed.
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
    path.stem for path in HERE.glob("*.py") if path.stem not in ("__init__", "__main__", "draw", "keep")
)


def main() -> None:
    parser = argparse.ArgumentParser(prog="fuzz", description="Look for inputs that break a target.")
    parser.add_argument("target", choices=TARGETS)
    parser.add_argument("--seconds", type=int, default=1800, help="duration in seconds; default 1800")
    parser.add_argument("--corpus", type=Path, help="folder for inputs; default fuzz/corpus/<target>")
    parsed, options = parser.parse_known_args()
    corpus = parsed.corpus or HERE / "corpus" / parsed.target
    findings = HERE / "findings" / parsed.target
    for folder in (corpus, findings):
        folder.mkdir(parents=True, exist_ok=True)
    with atheris.instrument_imports(include=["paramclient"]):
        target = importlib.import_module(f"fuzz.{parsed.target}")
    arguments = [f"-max_total_time={parsed.seconds}", f"-artifact_prefix={findings}/", "-print_final_stats=1"]
    arguments += [f"-max_len={target.INPUT_SIZE_MAX}", "-len_control=0"]
    atheris.Setup([sys.argv[0], *arguments, str(corpus), *options], target.run)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
