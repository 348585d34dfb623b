"""Fuzz target: parameter files. Only FileError is raised; a file that is read can be written unchanged."""

from __future__ import annotations

from typing import Final

from fuzz.draw import Draw
from paramclient.errors import FileError
from paramclient.files import FileFormat, ParamFile, dumps, loads

__all__ = ["INPUT_SIZE_MAX", "run"]

INPUT_SIZE_MAX: Final = 1024
"""Maximum bytes of an input: longer ones are slow and find nothing new."""

NAMES: Final = ("", "a.params", "a.parm", "a.param", "a.pck", "a.json", "a.txt")


def run(data: bytes) -> None:
    """Read a file: the first byte chooses its name and file format, all other bytes are the content."""
    draw = Draw(data)
    how = draw.number()
    form = None if how & 8 else list(FileFormat)[how % len(FileFormat)]
    try:
        held = loads(draw.rest(), source=NAMES[(how >> 4) % len(NAMES)], file_format=form)
    except FileError as error:
        assert str(error)
        return
    assert any(held.sets)
    for form in FileFormat:
        is_exact = form in (held.file_format, FileFormat.JSON)
        try:
            written = dumps(held, file_format=form)
        except FileError:
            continue  # not every file format can hold every value
        again = loads(written, source=NAMES[(how >> 4) % len(NAMES)], file_format=form)
        assert _names(again) == _names(held), f"{form} has other parameters"
        if is_exact:
            assert _described(again) == _described(held), f"{form} says something else"


def _names(file: ParamFile) -> list[str]:
    return [name for params in file.sets for name in params]


def _described(file: ParamFile) -> list[tuple[object, ...]]:
    """Return the values of a file, in which NaN equals itself. Comments may be written differently."""
    return [
        (params.system, params.component, each.name, each.type, repr(each.value), repr(each.default))
        for params in file.sets
        for each in params.values()
    ]
