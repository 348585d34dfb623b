"""Lines of a PX4 start script that set parameters.

A script is a program (PX4 guide, "System Startup"; the command `param`): what it sets may depend on what
the vehicle has. Only what it sets in any case can be told from the file alone, so a `param set` that stands
in an `if` or a loop, behind an `exit`, or with a variable is an error. What other scripts set that it calls
is not in it.
"""

from __future__ import annotations

import re
from typing import Final

from paramclient.errors import UsageError
from paramclient.files.param_file import FileForm, ParamFile, TooManyParams
from paramclient.files.text import Builder, Line, Problems, lines_of, parse_number, shown
from paramclient.model.paramset import WrittenParam
from paramclient.model.values import check_name

__all__ = ["is_script_line", "read_script"]

MOST_NOTED: Final = 5
"""Lines that a note names."""

_EXPECTED: Final = "param set NAME VALUE or param set-default NAME VALUE"
_OPENING: Final = frozenset({"if", "while", "until", "for", "case"})
_CLOSING: Final = frozenset({"fi", "done", "esac", "}"})
_INNER: Final = frozenset({"then", "else", "elif", "do"})
_LEAVING: Final = frozenset({"exit", "return"})
_hash: Final = re.compile(r"(?:(?<=[ \t])|^)#")
_changes: Final = re.compile(r"\bparam\s+(?:set(?:-default)?|reset\w*|load|import|select\w*)\b").search
_sets: Final = re.compile(
    r"param[ \t]+set(-default(?:[ \t]+-s)?)?[ \t]+(\S+)[ \t]+(\S+)(?:[ \t]+fail)?"
).fullmatch


def is_script_line(text: str) -> bool:
    """Whether a line could only be one of a script that sets parameters."""
    return _changes(text) is not None


def read_script(text: str, source: str, params_max: int | None = None) -> ParamFile:
    """Read what a script sets in any case. The default of `set-default` counts as a value.

    Of a name that is set twice the last value counts, but a value of `set` more than any of `set-default`: a
    default that comes later does not replace a value.

    Raises:
        FileError: a line sets, loads or resets parameters in a way that depends on more than the file.
    """
    builder = Builder(Problems(source), params_max)
    header: list[str] = []
    waiting: list[str] = []
    skipped: list[int] = []
    left_out = 0
    state = _Flow()
    assigned: set[str] = set()
    for line in lines_of(text, _hash):
        if not line.text:
            if line.comment is not None:
                waiting.append(line.comment)
            continue
        if not (builder.sets or skipped):
            header, waiting = waiting, []
        obstacle = state.obstacle
        state.follow(line.text)
        if not _changes(line.text):
            left_out += 1
            skipped += [line.number] if left_out <= MOST_NOTED else []
            continue
        comments = [*waiting, *([line.comment] if line.comment else [])]
        waiting = []
        try:
            if obstacle:
                raise UsageError(f"{_EXPECTED}, not {obstacle}")
            param, is_default = _param(line, "\n".join(comments))
            if is_default and param.name in assigned:
                held, place = builder.sets[None, None][param.name], builder.place_of(param.name)
                builder.note_repeated(held, place, param, f"line {line.number}")
                continue
            builder.add(param)
            if not is_default:
                assigned.add(param.name)
        except TooManyParams:
            raise
        except UsageError as error:
            builder.problems.add(line.number, str(error), shown(line.text))
    sets = builder.result()
    if skipped:
        builder.notes.append(_left_out(skipped, left_out))
    return ParamFile(sets, FileForm.PX4_SCRIPT, source, tuple(header), tuple(waiting), tuple(builder.notes))


class _Flow:
    """Whether a line is reached in any case."""

    def __init__(self) -> None:
        self._depth = 0
        self._left = False

    @property
    def obstacle(self) -> str:
        """Why the next line may not be reached; "" where it is in any case."""
        if self._left:
            return "behind an exit"
        return "inside of a condition, loop or function" if self._depth else ""

    def follow(self, text: str) -> None:
        for command in re.split(r"[;&|]+", text):
            words = command.split()
            while words and words[0] in _INNER:
                words.pop(0)
            if not words:
                continue
            opens = words[0] in _OPENING or words[-1] == "{"
            self._depth += opens - (words[0] in _CLOSING)
            self._left = self._left or words[0] in _LEAVING


def _param(line: Line, comment: str) -> tuple[WrittenParam, bool]:
    """The parameter that a line sets, and whether only its default; UsageError says what was expected."""
    match = _sets(line.text)
    if match is None:
        raise UsageError(f"{_EXPECTED} and nothing else")
    name, value = match[2], parse_number(match[3])
    if "$" in line.text:
        raise UsageError(f"{_EXPECTED} without variables")
    if value is None:
        raise UsageError(f"{_EXPECTED} with a number")
    return WrittenParam(check_name(name), value, comment=comment, line=line.number), match[1] is not None


def _left_out(lines: list[int], count: int) -> str:
    named = ", ".join(map(str, lines)) + (", …" if count > MOST_NOTED else "")
    one = count == 1
    return (
        f"{'Line' if one else 'Lines'} {named} of the script {'sets' if one else 'set'} no parameter; "
        f"what other scripts set that {'it calls' if one else 'they call'} is not in this."
    )
