"""Reduce a corpus to the inputs that are needed for its coverage: `python -m fuzz.keep component FOUND`.

From the corpus of a target and the inputs in a folder, the smallest inputs are kept that together cover every
step from line to line of the package that any of them covers.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import sys
from pathlib import Path
from types import FrameType
from typing import Any, Final

HERE: Final = Path(__file__).parent


def main() -> None:
    parser = argparse.ArgumentParser(prog="fuzz.keep", description="Keep the inputs that reach everything.")
    parser.add_argument("target")
    parser.add_argument("found", type=Path, nargs="?", help="a folder with further inputs")
    arguments = parser.parse_args()
    corpus = HERE / "corpus" / arguments.target
    target = importlib.import_module(f"fuzz.{arguments.target}")
    folders = [corpus] if arguments.found is None else [corpus, arguments.found]
    inputs = {path.read_bytes() for folder in folders for path in folder.iterdir() if path.is_file()}
    reached: set[tuple[str, int, int]] = set()
    kept = []
    for data in sorted(inputs, key=lambda each: (len(each), each)):
        steps = steps_of(target, data)
        if len(data) <= target.INPUT_SIZE_MAX and not steps <= reached:
            kept.append(data)
            reached |= steps
    for path in corpus.iterdir():
        path.unlink()
    for data in kept:
        (corpus / hashlib.sha1(data).hexdigest()).write_bytes(data)
    sys.stdout.write(f"{len(kept)} of {len(inputs)} inputs are kept, {sum(map(len, kept))} bytes\n")


def steps_of(target: Any, data: bytes) -> set[tuple[str, int, int]]:
    """Return the steps from line to line that an input covers."""
    steps: set[tuple[str, int, int]] = set()
    lines: dict[int, int] = {}

    def line(frame: FrameType, _event: str, _arg: Any) -> Any:
        steps.add((frame.f_code.co_filename, lines.get(id(frame), 0), frame.f_lineno))
        lines[id(frame)] = frame.f_lineno
        return line

    def call(frame: FrameType, _event: str, _arg: Any) -> Any:
        lines[id(frame)] = 0
        return line if "/paramclient/" in frame.f_code.co_filename else None

    sys.settrace(call)
    try:
        target.run(data)
    finally:
        sys.settrace(None)
    return steps


if __name__ == "__main__":
    main()
