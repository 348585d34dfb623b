"""Parameter files on disk: reading, atomic replacement, included files."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from paramclient import FileError, ParamSet, ParamType, WrittenParam, read_file, write_file
from paramclient.files import LARGEST_FILE, FileFormat, dumps, loads
from paramclient.files.formats import ENDINGS
from paramclient.files.lists import FILES_MAX

PARAMS = ParamSet({"A": WrittenParam("A", 5, ParamType.INT32), "B": WrittenParam("B", 0.5)}, 1, 1)
TYPED = ParamSet({"A": PARAMS["A"]}, 1, 1)
OLD = b"OLD,1\n"


def listed(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def refused(call: Callable[[], object]) -> FileError:
    with pytest.raises(FileError) as caught:
        call()
    return caught.value


@pytest.mark.parametrize(("ending", "form"), ENDINGS.items())
def test_the_extension_selects_the_format_to_write(ending: str, form: FileFormat, tmp_path: Path) -> None:
    path = tmp_path / f"quad{ending.upper()}"
    assert write_file(path, TYPED) is form
    file = read_file(path)
    assert (file.file_format, file.source, file.choose().source) == (form, str(path), str(path))
    assert file.choose()["A"].value == 5
    assert listed(tmp_path) == [path.name]


def test_a_file_may_have_the_longest_name(tmp_path: Path) -> None:
    path = tmp_path / f"{'é' * 124}.param"  # 254 bytes
    write_file(path, PARAMS)
    assert listed(tmp_path) == [path.name]


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """A file that is there already, alone in its folder."""
    path = tmp_path / "real/quad.param"
    path.parent.mkdir()
    path.write_bytes(OLD)
    path.chmod(0o640)
    return path


def test_a_replaced_file_keeps_its_mode_and_a_symbolic_link_to_it(old: Path, tmp_path: Path) -> None:
    link = tmp_path / "link.param"
    link.symlink_to(old)
    for path in (old, link):
        old.write_bytes(OLD)
        write_file(path, {"A": 5})
        assert read_file(old).choose()["A"].value == 5
        assert stat.S_IMODE(old.stat().st_mode) == 0o640
        assert listed(old.parent) == [old.name]
    assert link.is_symlink()


FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize(
    ("call", "fault"), [("fsync", KeyboardInterrupt()), ("fsync", FULL), ("fchmod", FULL)], ids=repr
)
def test_a_write_that_fails_leaves_the_old_file_unchanged(
    call: str, fault: BaseException, old: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise fault

    monkeypatch.setattr(os, call, fail)
    with pytest.raises((KeyboardInterrupt, FileError)) as caught:
        write_file(old, PARAMS)
    monkeypatch.undo()
    if fault is FULL:
        assert str(caught.value) == f"{old}: cannot be written: No space left on device"
        assert caught.value.__cause__ is FULL
    assert (old.read_bytes(), listed(old.parent)) == (OLD, [old.name])


def test_inexpressible_content_fails_before_writing(old: Path) -> None:
    path = old.rename(old.with_suffix(".params"))
    error = refused(lambda: write_file(path, PARAMS))
    assert str(error) == f"{path}: B has no type that MAVLink defines, and this format needs one"
    with pytest.raises(TypeError, match="5 is not a ParamSet"):
        write_file(path, [5])  # type: ignore[list-item]
    assert path.read_bytes() == OLD


def test_errors_of_opening_a_file_have_the_reason(tmp_path: Path) -> None:
    missing = tmp_path / "none.param"
    assert str(refused(lambda: read_file(missing))) == f"{missing}: cannot be read: No such file or directory"
    assert "cannot be read: not a regular file" in str(refused(lambda: read_file(tmp_path)))
    assert "cannot be read: embedded null byte" in str(refused(lambda: read_file("a\0b")))
    assert "cannot be written: embedded null byte" in str(refused(lambda: write_file("a\0b.parm", PARAMS)))
    deep = missing / "quad.param"
    assert "cannot be written: No such file or directory" in str(refused(lambda: write_file(deep, PARAMS)))
    folder = tmp_path / "folder.param"
    folder.mkdir()
    assert "cannot be written: not a regular file" in str(refused(lambda: write_file(folder, PARAMS)))


def test_a_too_large_file_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "huge.param"
    with path.open("wb") as file:
        file.truncate(LARGEST_FILE + 1)
    assert f"a parameter file has at most {LARGEST_FILE} bytes" in str(refused(lambda: read_file(path)))


# Included files


def tree(folder: Path, **files: str) -> Path:
    """Write files, with `__` in a key for `/` and `_parm` for the extension; return the first path."""
    paths = []
    for key, text in files.items():
        path = folder / key.replace("__", "/").replace("_parm", ".parm")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        paths.append(path)
    return paths[0]


def values(path: Path) -> dict[str, object]:
    return {name: param.value for name, param in read_file(path).sets[0].items()}


def test_an_included_file_replaces_its_line(tmp_path: Path) -> None:
    first = tree(
        tmp_path,
        board__new__defaults_parm="A 1\n@include ../base/defaults.parm  # as on the other board\nB 20\n",
        board__base__defaults_parm="# of the base\nA 10 # ten\nB 11\n@include more.parm\n",
        board__base__more_parm="C 12\n",
    )
    file = read_file(first)
    params = file.sets[0]
    assert values(first) == {"A": 10, "B": 20, "C": 12}
    assert (params["A"].comment, params["A"].line, params["B"].line) == ("ten", None, 3)
    base = f"{first.parent}/../base/defaults.parm"
    assert file.notes == (
        f"A occurs twice: 10 in {base}:2 is used, not 1 in line 1.",
        f"B occurs twice: 20 in line 3 is used, not 11 in {base}:3.",
    )
    assert loads(dumps(file)).sets[0] == ParamSet(params.params)


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("@include gone.parm", "x/y/gone.parm: cannot be read: No such file or directory"),
        ("@include ../y", "x/y/../y: cannot be read: not a regular file"),
        ("@include ../../outside.parm", "lies outside of"),
        ("@include ../z/../../outside.parm", "lies outside of"),
        ("@include /etc/hostname", "absolute paths are not allowed"),
        ("@include link.parm", "lies outside of"),
        ("@include first.parm", "circular @include"),
        ("@include round.parm", "circular @include"),
    ],
)
def test_an_impossible_include_is_reported_with_its_line(line: str, problem: str, tmp_path: Path) -> None:
    first = tree(
        tmp_path,
        x__y__first_parm=f"A 1\n{line}\nbad\n",
        x__y__round_parm="@include first.parm\n",
        x__z__other_parm="B 1\n",
        outside_parm="SECRET 1\n",
    )
    (first.parent / "link.parm").symlink_to(tmp_path / "outside.parm")
    reported = str(refused(lambda: read_file(first)))
    assert problem in reported
    assert f"{first}:2: " in reported
    assert "SECRET" not in reported


def test_an_error_in_an_included_file_names_both_lines(tmp_path: Path) -> None:
    first = tree(tmp_path, a_parm="A 1\n@include b.parm\n", b_parm="B 1\nbad\n")
    error = refused(lambda: read_file(first))
    bad = f"{tmp_path}/b.parm:2: expected NAME VALUE, found 'bad'"
    assert str(error).splitlines() == [bad, f"{first}:2: includes that file"]
    assert (error.source, error.line) == (f"{tmp_path}/b.parm", 2)
    (tmp_path / "b.parm").write_bytes(b"B 1\n\xff\n")
    assert "includes that file" in str(refused(lambda: read_file(first)))
    assert len(read_file(first, partial=True).notes) == 1, "the line of the included file"


def test_includes_are_limited(tmp_path: Path) -> None:
    chain = {f"f{number}_parm": f"@include f{number + 1}.parm\n" for number in range(FILES_MAX)}
    assert values(tree(tmp_path, **chain, **{f"f{FILES_MAX}_parm": "A 1\n"})) == {"A": 1}
    (tmp_path / f"f{FILES_MAX}.parm").write_text("@include g.parm\n")
    assert f"more than {FILES_MAX} files" in str(refused(lambda: read_file(tmp_path / "f0.parm")))
    (tmp_path / "large.parm").write_text("# " + "x" * (LARGEST_FILE // 2) + "\nA 1\n")
    (tmp_path / "twice.parm").write_text("@include large.parm\n@include large.parm\n")
    assert "too large" in str(refused(lambda: read_file(tmp_path / "twice.parm")))
