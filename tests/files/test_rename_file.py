"""Files of renamed parameters: what they contain, and the line of each error."""

from __future__ import annotations

from pathlib import Path

import pytest

from paramclient import FileError, Rename, read_renames
from paramclient.files import loads_renames
from paramclient.files.rename_file import SIZE_MAX

FILE = b"""\
# ArduPilot 4.6 to 4.7
- {old: WPNAV_SPEED, new: WP_SPD, factor: 0.01}
- old: SYSID_THISMAV
  new: MAV_SYSID
"""


def test_a_file_is_a_list_of_entries(tmp_path: Path) -> None:
    path = tmp_path / "names.yaml"
    path.write_bytes(FILE)
    renames = read_renames(path)
    assert renames.entries == (
        Rename("WPNAV_SPEED", "WP_SPD", 0.01),
        Rename("SYSID_THISMAV", "MAV_SYSID"),
    )
    assert [entry.line for entry in renames.entries] == [2, 3]
    assert renames.source == str(path)


@pytest.mark.parametrize(
    ("text", "line", "reason"),
    [
        ("", 1, "expected a list of entries with `old` and `new`"),
        ("[]", 1, "expected a list of entries with `old` and `new`"),
        ("\nrenames: []", 2, "expected a list of entries with `old` and `new`"),
        ("- {old: A, new: B}\n- C", 2, "expected an entry with `old` and `new`"),
        ("- old: A\n  new: B\n  faktor: 2", 3, "unknown member 'faktor'; the members are old, new, factor"),
        ("- {old: A, new: B}\n- old: C", 2, "the entry has no `new`"),
        ("- new: C", 1, "the entry has no `old`"),
        ("- {old: A, new: B}\n- {old: A, new: C}", 2, "A has two new names: B and C"),
        ("- {old: A, new: B}\n- {old: C, new: B}", 2, "B has two old names: A and C"),
        ("- {old: A, new: B}\n- {old: B, new: A}", 2, "the renames return to B: B to A to B"),
        ("- old: A\n  new: B\n- old: B\n  new: C\n  factor: 0", 3, "the factor of B is 0; "),
        ("- {old: A, new: B, factor: 1e999}", 1, "the factor of A is inf; "),
        ("- {old: A, new: B, factor: NaN}", 1, "the factor of A is not a number: 'NaN'"),
        ("- {old: A, new: B, factor: }", 1, "the factor of A is not a number: None"),
        ("- {old: 5, new: B}", 1, "a parameter name is a string, not int"),
        ("- {old: A, new: SEVENTEEN_LETTERS}", 1, "parameter name 'SEVENTEEN_LETTERS' has 17 bytes"),
        ("- {old: A,\n old: B}", 2, "expected YAML: 'old' occurs twice"),
        ("- {old: A, new: *a}", 1, "expected YAML: found an alias"),
        ("- {old: A\n", 2, "expected YAML: "),
    ],
)
def test_errors_name_the_line(text: str, line: int, reason: str) -> None:
    with pytest.raises(FileError) as error:
        loads_renames(text.encode(), source="names.yaml")
    assert error.value.line == line
    assert str(error.value).startswith(f"names.yaml:{line}: {reason}")


def test_a_file_that_is_missing_or_too_large_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="cannot be read"):
        read_renames(tmp_path / "none.yaml")
    with pytest.raises(FileError, match="at most"):
        loads_renames(b" " * (SIZE_MAX + 1))
