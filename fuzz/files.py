"""Parameter files: only FileError comes, and what is read says the same when it is written again."""

from __future__ import annotations

from typing import Final

from fuzz.draw import Draw
from paramclient.errors import FileError
from paramclient.files import FileForm, ParamFile, dumps, loads

__all__ = ["LONGEST", "run"]

LONGEST: Final = 1024
"""Bytes of an input: longer ones take their time and say nothing new."""

NAMES: Final = ("", "a.params", "a.parm", "a.param", "a.pck", "a.json", "a.yaml", "a.txt")
WRITABLE: Final = tuple(form for form in FileForm if form is not FileForm.PX4_SCRIPT)


def run(data: bytes) -> None:
    """The first byte chooses the name and the form that it is read as; the others are the file."""
    draw = Draw(data)
    how = draw.number()
    form = None if how & 8 else list(FileForm)[how % 7]
    try:
        held = loads(draw.rest(), source=NAMES[how >> 4 & 7], form=form)
    except FileError as error:
        assert str(error)
        return
    assert any(held.sets)
    for form in WRITABLE:
        is_exact = form in (held.form, FileForm.JSON, FileForm.YAML)
        try:
            written = dumps(held, form=form)
        except FileError:
            continue  # not every form can say everything
        again = loads(written, source=NAMES[how >> 4 & 7], form=form)
        assert _names(again) == _names(held), f"{form} has other parameters"
        if is_exact:
            assert _told(again) == _told(held), f"{form} says something else"


def _names(file: ParamFile) -> list[str]:
    return [name for params in file.sets for name in params]


def _told(file: ParamFile) -> list[tuple[object, ...]]:
    """What a file says of values; NaN equals itself here. Comments may be written otherwise."""
    return [
        (params.system, params.component, each.name, each.type, repr(each.value), repr(each.default))
        for params in file.sets
        for each in params.values()
    ]
