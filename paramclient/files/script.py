"""Reading the parameters that a PX4 start script sets.

A script is a program (PX4 guide, "System Startup"; the command `param`): the parameters that it sets may
depend on the vehicle. The file alone shows only which ones it sets in every case, so a `param set` inside an
`if` or a loop, after an `exit`, or with a variable is an error. Parameters that called scripts set are not
included.
"""

from __future__ import annotations

import re
from typing import Final

from paramclient.errors import UsageError
from paramclient.files.formats import FileFormat
from paramclient.files.param_file import ParamFile, TooManyParams
from paramclient.files.text import Builder, Problems, TextLine, excerpt, lines_of, parse_number
from paramclient.model.paramset import WrittenParam
from paramclient.model.values import check_name

__all__ = ["is_script_line", "read_script"]

SKIPPED_LISTED_MAX: Final = 5
"""Line numbers that the note on skipped lines lists, so that the note stays readable."""

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
    """Return whether a line sets, resets or loads parameters, which only scripts do."""
    return _changes(text) is not None


def read_script(text: str, source: str, params_max: int | None = None) -> ParamFile:
    """Read the parameters that a script sets in every case. The default of `set-default` is read as a value.

    If a name is set twice, the last value is used, but a value of `set` takes precedence over `set-default`:
    a later default does not replace a value.

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
            skipped += [line.number] if left_out <= SKIPPED_LISTED_MAX else []
            continue
        comments = [*waiting, *([line.comment] if line.comment else [])]
        waiting = []
        try:
            if obstacle:
                raise UsageError(f"{_EXPECTED}, not {obstacle}")
            param, is_default = _param(line, "\n".join(comments))
            if is_default and param.name in assigned:
                existing, place = builder.sets[None, None][param.name], builder.place_of(param.name)
                builder.note_repeated(existing, place, param, f"line {line.number}")
                continue
            builder.add(param)
            if not is_default:
                assigned.add(param.name)
        except TooManyParams:
            raise
        except UsageError as error:
            builder.problems.add(line.number, str(error), excerpt(line.text))
    sets = builder.result()
    if skipped:
        builder.notes.append(_skipped_note(skipped, left_out))
    return ParamFile(sets, FileFormat.PX4_SCRIPT, source, tuple(header), tuple(waiting), tuple(builder.notes))


class _Flow:
    """Control flow of a script: whether the next line runs in every case."""

    def __init__(self) -> None:
        self._depth = 0
        self._left = False

    @property
    def obstacle(self) -> str:
        """Why the next line may not run; "" if it runs in every case."""
        if self._left:
            return "after an exit"
        return "inside a condition, loop or function" if self._depth else ""

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


def _param(line: TextLine, comment: str) -> tuple[WrittenParam, bool]:
    """Return the parameter that a line sets, and whether the line is a `set-default`."""
    match = _sets(line.text)
    if match is None:
        raise UsageError(f"{_EXPECTED} and nothing else")
    name, value = match[2], parse_number(match[3])
    if "$" in line.text:
        raise UsageError(f"{_EXPECTED} without variables")
    if value is None:
        raise UsageError(f"{_EXPECTED} with a number")
    return WrittenParam(check_name(name), value, comment=comment, line=line.number), match[1] is not None


def _skipped_note(lines: list[int], count: int) -> str:
    named = ", ".join(map(str, lines)) + (", …" if count > SKIPPED_LISTED_MAX else "")
    one = count == 1
    return (
        f"{'Line' if one else 'Lines'} {named} of the script {'sets' if one else 'set'} no parameter. "
        f"Parameters of other scripts that {'it calls' if one else 'they call'} are not included."
    )
