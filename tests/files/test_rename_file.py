"""Files of renamed parameters: what they contain, and the line of each error."""

from __future__ import annotations

from pathlib import Path

import pytest

from paramclient import FileError
from paramclient.files import loads_renames, read_renames
from paramclient.files.rename_file import SIZE_MAX
from paramclient.model.renames import Rename

FILE = b"""\
[
  {"old": "WPNAV_SPEED", "new": "WP_SPD", "factor": 0.01},

  {"old": "SYSID_THISMAV",
   "new": "MAV_SYSID"}
]
"""


def test_a_file_is_a_list_of_entries(tmp_path: Path) -> None:
    path = tmp_path / "names.json"
    path.write_bytes(FILE)
    renames = read_renames(path)
    assert renames.entries == (
        Rename("WPNAV_SPEED", "WP_SPD", 0.01),
        Rename("SYSID_THISMAV", "MAV_SYSID"),
    )
    assert [entry.line for entry in renames.entries] == [2, 4]
    assert renames.source == str(path)


@pytest.mark.parametrize(
    ("text", "line", "reason"),
    [
        ("[]", 1, "expected a list of entries with `old` and `new`"),
        ('{"renames": []}', 1, "expected a list of entries with `old` and `new`"),
        ('[{"old": "A", "new": "B"},\n"C"]', 2, "expected an entry with `old` and `new`"),
        (
            '[\n{"old": "A", "new": "B", "faktor": 2}]',
            2,
            "unknown member 'faktor'; the members are old, new, factor",
        ),
        ('[{"old": "A", "new": "B"},\n{"old": "C"}]', 2, "the entry has no `new`"),
        ('[{"new": "C"}]', 1, "the entry has no `old`"),
        ('[{"old": "A", "new": "B"},\n{"old": "A", "new": "C"}]', 2, "A has two new names: B and C"),
        ('[{"old": "A", "new": "B"},\n{"old": "C", "new": "B"}]', 2, "B has two old names: A and C"),
        ('[{"old": "A", "new": "B"},\n{"old": "B", "new": "A"}]', 2, "the renames return to B: B to A to B"),
        (
            '[{"old": "A", "new": "B"},\n\n{"old": "B",\n "new": "C", "factor": 0}]',
            3,
            "the factor of B is 0; ",
        ),
        ('[{"old": "A", "new": "B", "factor": "2"}]', 1, "the factor of A is not a number: '2'"),
        ('[{"old": "A", "new": "B", "factor": null}]', 1, "the factor of A is not a number: None"),
        ('[{"old": 5, "new": "B"}]', 1, "a parameter name is a string, not int"),
        ('[{"old": "A", "new": "SEVENTEEN_LETTERS"}]', 1, "parameter name 'SEVENTEEN_LETTERS' has 17 bytes"),
        ('[{"old": "A",\n "old": "B"}]', 2, "'old' occurs twice"),
        ("- {old: A, new: B}", 1, "expected JSON: "),
    ],
)
def test_errors_name_the_line(text: str, line: int, reason: str) -> None:
    with pytest.raises(FileError) as error:
        loads_renames(text.encode(), source="names.json")
    assert error.value.line == line
    assert str(error.value).startswith(f"names.json:{line}: {reason}")


def test_a_file_that_is_missing_or_too_large_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="cannot be read"):
        read_renames(tmp_path / "none.json")
    with pytest.raises(FileError, match="at most"):
        loads_renames(b" " * (SIZE_MAX + 1))
