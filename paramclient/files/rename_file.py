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
from paramclient.files.json_reader import read_json_text
from paramclient.files.text import decode_text, excerpt
from paramclient.model.renames import Rename, Renames

__all__ = ["loads_renames", "read_renames"]

SIZE_MAX: Final = 1024 * 1024
"""Largest file, in bytes: some 20,000 entries, more than an autopilot has parameters."""
MEMBERS: Final = ("old", "new", "factor")
"""The members of an entry; `factor` is optional."""
_between_entries: Final = re.compile(r"[\s,]*").match


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
    entries = zip(content, _lines_of_entries(text), strict=True)
    return Renames((_entry(each, line, source) for each, line in entries), source)


def _lines_of_entries(text: str) -> Iterator[int]:
    """Generate the line on which each entry of a valid JSON list begins."""
    decoder = json.JSONDecoder()
    at, line, end = text.index("[") + 1, 1, 0
    while True:
        found = _between_entries(text, at)
        assert found is not None, "it may be empty"
        begin = found.end()
        line += text.count("\n", end, begin)
        if text[begin] == "]":
            return
        yield line
        _, at = decoder.raw_decode(text, begin)
        end = begin


def _entry(content: Any, line: int, source: str) -> Rename:
    """Return an entry of the list; `Renames` checks its names and its factor."""

    def error(message: str) -> FileError:
        return FileError(message, source=source, line=line)

    if not isinstance(content, dict):
        raise error("expected an entry with `old` and `new`")
    for member in content:
        if member not in MEMBERS:
            raise error(f"unknown member {excerpt(member)}; the members are {', '.join(MEMBERS)}")
    for member in ("old", "new"):
        if member not in content:
            raise error(f"the entry has no `{member}`")
    return Rename(content["old"], content["new"], content.get("factor", 1), line)
