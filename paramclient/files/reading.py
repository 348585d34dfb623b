"""One file while it is read: its parameters, its notes for the user, and its faults, raised as one error."""

from __future__ import annotations

from functools import cached_property
from typing import Final

from paramclient.errors import FileError
from paramclient.files.formats import FileFormat, ParamFile
from paramclient.files.text import TextLine, decode_text, excerpt, lines_of, undecoded_byte
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import ParamType, format_value, type_name
from paramclient.model.wording import first_of

__all__ = ["Reading"]

FAULTS_MAX: Final = 20
"""Bad lines that an error lists: in a file of another kind, every line is bad."""


class Reading:
    """One file while it is read, with the files that it includes.

    If a name occurs twice, the last value is used, as in ground stations and autopilots, which set one value
    after the other. A note reports the repetition.

    Args:
        data: the content.
        source: the file's name.
        partial: leave out parameters with a name that no vehicle can have, with a note; else it is a fault.
        is_on_disk: whether the file can include others: bytes have no folder.
    """

    def __init__(self, data: bytes, source: str, *, partial: bool = False, is_on_disk: bool = False) -> None:
        self.data = data
        self.source = source
        self.is_on_disk = is_on_disk
        self.fault_count = 0
        self.notes: list[str] = []
        self._partial = partial
        self._faults: list[tuple[str, int | None, str, str | None]] = []
        self._sets: dict[tuple[int | None, int | None], dict[str, tuple[WrittenParam, str]]] = {}
        self._repetitions: list[str] = []
        self.foreign: list[str] = []  # places of comments that are not UTF-8

    @cached_property
    def text(self) -> str:
        """The content as text; FileError if it is none."""
        return decode_text(self.data, self.source)

    @cached_property
    def first(self) -> str:
        """The first line with content, without comments; FileError if there is none."""
        if self.text.lstrip().startswith("{"):  # it may be one line of megabytes, with `#` in its texts
            return "{"
        for line in lines_of(self.text):
            if line.text:
                return line.text
        raise FileError("the file contains no parameters", source=self.source)

    @property
    def is_full(self) -> bool:
        """Whether further faults are only counted."""
        return self.fault_count >= FAULTS_MAX

    def fault(
        self,
        line: int | None,
        what: str,
        expected: str | None = None,
        source: str = "",
        *,
        is_name: bool = False,
    ) -> None:
        """Add a fault.

        Args:
            line: the bad line; None for an unknown one.
            what: the fault, as the end of a sentence.
            expected: the expected content of the line, if it has a description.
            source: the file, if it is another one.
            is_name: whether only the name of a parameter is bad.
        """
        if is_name and self._partial:
            place = _place("" if source == self.source else source, line)
            self.notes.append(f"{place + ': ' if place else ''}{what}; left out.")
            return
        if not self.is_full:
            self._faults.append((source or self.source, line, what, expected))
        self.fault_count += 1

    def bad_line(self, line: TextLine, expected: str, source: str = "", *, is_name: bool = False) -> None:
        """Add a line that has other content than expected."""
        byte = undecoded_byte(line.text)
        what = f"expected {expected}, found {excerpt(line.text)}" if byte is None else byte[1]
        self.fault(line.number, what, expected, source, is_name=is_name)

    def add(
        self, param: WrittenParam, place: str, system: int | None = None, component: int | None = None
    ) -> None:
        """Add a parameter of a component; it replaces an earlier one with the same name.

        Args:
            param: the parameter.
            place: its position, for notes.
            system, component: the ids of the set.
        """
        params = self._sets.setdefault((system, component), {})
        if (before := params.get(param.name)) is not None:
            used, ignored, at = _value(param), _value(before[0]), before[1]
            same = f"with the same value, in {at} and {place}"
            other = f": {used} in {place} is used, not {ignored} in {at}"
            self._repetitions.append(f"{param.name} occurs twice{f' {same}' if used == ignored else other}.")
        params[param.name] = param, place

    def check(self) -> None:
        """Raise one FileError for all faults, if there are any."""
        if not self._faults:
            return
        more = [": ".join(filter(None, (_place(of, at), what))) for of, at, what, _ in self._faults[1:]]
        if self.fault_count > len(self._faults):
            more.append(f"and {self.fault_count - len(self._faults)} more")
        source, line, what, expected = self._faults[0]
        raise FileError(what, source=source, line=line, expected=expected, more=tuple(more))

    def file(
        self,
        file_format: FileFormat,
        header: tuple[str, ...] = (),
        footer: tuple[str, ...] = (),
        sets: tuple[ParamSet, ...] | None = None,
    ) -> ParamFile:
        """Return the content: the added parameters, or `sets`.

        Raises:
            FileError: the file has faults, or no parameters.
        """
        self.check()
        if sets is None:
            sets = tuple(
                ParamSet({name: p for name, (p, _) in each.items()}, component, system, source=self.source)
                for (system, component), each in self._sets.items()
            )
        if not any(sets):
            raise FileError("the file contains no parameters", source=self.source)
        notes = [*self.notes, *self._repetitions[:FAULTS_MAX]]
        if (more := len(self._repetitions) - FAULTS_MAX) > 0:
            notes.append(f"{more} more {'line repeats' if more == 1 else 'lines repeat'} a name.")
        if self.foreign:
            places = first_of(self.foreign, FAULTS_MAX)
            notes.append(f"Comments that are not UTF-8 were read as Windows-1252: {places}.")
        return ParamFile(sets, file_format, self.source, header, footer, tuple(notes))


def _place(source: str, line: int | None) -> str:
    if line is None:
        return source
    return f"{source}:{line}" if source else f"line {line}"


def _value(param: WrittenParam) -> str:
    kind = "" if param.type_number is None else f" ({type_name(param.type_number)})"
    return format_value(param.settable, ParamType.REAL64) + kind
