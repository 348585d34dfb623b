"""Files of renamed parameters, in JSON: a list of entries with `old`, `new` and an optional `factor`.

[{"old": "WPNAV_SPEED", "new": "WP_SPD", "factor": 0.01},
 {"old": "SYSID_THISMAV", "new": "MAV_SYSID"}]
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from typing import Any, Final

from paramclient.errors import FileError
from paramclient.files.disk import read_bytes
from paramclient.files.json_format import read_json_text
from paramclient.files.reading import decode_text, excerpt
from paramclient.model.renames import Rename, Renames

__all__ = ["loads_renames", "read_renames"]

SIZE_MAX: Final = 1024 * 1024
"""Largest file, in bytes: some 20,000 entries, more than an autopilot has parameters."""
MEMBERS: Final = ("old", "new", "factor")
"""The members of an entry; `factor` is optional."""
_between_entries: Final = re.compile(r"[\s,]*")


def read_renames(path: str | os.PathLike[str]) -> Renames:
    """Read a file of renamed parameters.

    Raises:
        FileError: the file cannot be read, or is invalid; `line` is the line of the problem.
    """
    source = os.fspath(path)
    return loads_renames(read_bytes(source), source=source)


def loads_renames(data: bytes, *, source: str = "") -> Renames:
    """Parse the content of a file of renamed parameters.

    Args:
        data: the content.
        source: the file's name, for messages.

    Raises:
        FileError: the content is invalid; `line` is the line of the problem.
    """
    if len(data) > SIZE_MAX:
        raise FileError(f"a file of renamed parameters has at most {SIZE_MAX} bytes", source=source)
    text = decode_text(data, source)
    content = read_json_text(text, source)
    if not isinstance(content, list) or not content:
        raise FileError("expected a list of entries with `old` and `new`", source=source, line=1)
    return Renames((_entry(each, line, source) for each, line in _with_lines(content, text)), source)


def _with_lines(content: list[Any], text: str) -> Iterator[tuple[Any, int]]:
    """Generate the entries of a list, each with the line on which it begins."""
    decoder = json.JSONDecoder()
    at, line, end = text.index("[") + 1, 1, 0
    for each in content:
        found = _between_entries.match(text, at)
        begin = at if found is None else found.end()
        line += text.count("\n", end, begin)
        yield each, line
        _, at = decoder.raw_decode(text, begin)
        end = begin


def _entry(content: Any, line: int, source: str) -> Rename:
    """Return an entry of the list; `Renames` checks its names and its factor."""
    problem = None
    if not isinstance(content, dict):
        problem = "expected an entry with `old` and `new`"
    elif unknown := [member for member in content if member not in MEMBERS]:
        problem = f"unknown member {excerpt(unknown[0])}; the members are {', '.join(MEMBERS)}"
    elif missing := [member for member in MEMBERS[:2] if member not in content]:
        problem = f"the entry has no `{missing[0]}`"
    if problem is not None:
        raise FileError(problem, source=source, line=line)
    return Rename(content["old"], content["new"], content.get("factor", 1), line)
