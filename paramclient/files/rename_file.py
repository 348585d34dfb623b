"""Files of renamed parameters, in YAML: a list of entries with `old`, `new` and an optional `factor`.

- {old: WPNAV_SPEED, new: WP_SPD, factor: 0.01}
- old: SYSID_THISMAV
  new: MAV_SYSID
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any, Final, TypeAlias

from paramclient.errors import FileError
from paramclient.files.disk import read_bytes
from paramclient.files.text import decode_text, excerpt
from paramclient.model.renames import Rename, Renames

__all__ = ["loads_renames", "read_renames"]

Place: TypeAlias = tuple[str | int, ...]
"""A position in the document: keys and list indices from the top."""

SIZE_MAX: Final = 1024 * 1024
"""Largest file, in bytes: some 20,000 entries, more than an autopilot has parameters."""
MEMBERS: Final = ("old", "new", "factor")
"""The members of an entry; `factor` is optional."""


def read_renames(path: str | os.PathLike[str]) -> Renames:
    """Read a file of renamed parameters. Needs PyYAML.

    Raises:
        FileError: the file cannot be read, or is invalid; `line` is the line of the problem.
    """
    source = os.fspath(path)
    return loads_renames(read_bytes(source), source=source)


def loads_renames(data: bytes, *, source: str = "") -> Renames:
    """Parse the content of a file of renamed parameters. Needs PyYAML.

    Args:
        data: the content.
        source: the file's name, for messages.

    Raises:
        FileError: the content is invalid; `line` is the line of the problem.
    """
    if find_spec("yaml") is None:
        raise FileError("YAML is read with PyYAML: pip install 'paramclient[yaml]'", source=source)
    from paramclient.files.yaml_parser import InvalidYaml, load  # imported here because it needs the extra

    if len(data) > SIZE_MAX:
        raise FileError(f"a file of renamed parameters has at most {SIZE_MAX} bytes", source=source)
    lines: dict[Place, int] = {}
    try:
        content = load(decode_text(data, source), lines)
    except InvalidYaml as error:
        raise FileError(f"expected YAML: {error}", source=source, line=error.line, expected="YAML") from None
    if not isinstance(content, list) or not content:
        raise FileError(
            "expected a list of entries with `old` and `new`", source=source, line=lines.get((), 1)
        )
    return Renames((_entry(each, number, lines, source) for number, each in enumerate(content)), source)


def _entry(content: Any, number: int, lines: Mapping[Place, int], source: str) -> Rename:
    """Return the entry at a position of the list; `Renames` checks its names and its factor."""
    line = lines[number,]
    if not isinstance(content, dict):
        raise FileError("expected an entry with `old` and `new`", source=source, line=line)
    for member in content:
        if member not in MEMBERS:
            known = ", ".join(MEMBERS)
            raise FileError(
                f"unknown member {excerpt(member)}; the members are {known}",
                source=source,
                line=lines[number, member],
            )
    for member in ("old", "new"):
        if member not in content:
            raise FileError(f"the entry has no `{member}`", source=source, line=line)
    return Rename(content["old"], content["new"], content.get("factor", 1), line)
