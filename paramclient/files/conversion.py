"""The table of formats: recognition, reading and writing of parameter files."""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import PurePath
from typing import Any, Final, NamedTuple, TypeAlias

from paramclient.errors import FileError, PackError, UsageError
from paramclient.files import json_format, lists
from paramclient.files.disk import LARGEST_FILE, read_bytes, replace_file
from paramclient.files.formats import AUTOPILOT, ENDINGS, FileFormat, ParamFile, address, format_of_name
from paramclient.files.reading import UTF16_MARKS, Reading, lacks_begin
from paramclient.model.identity import version_text
from paramclient.model.names import counted, first_of
from paramclient.model.notation import time_text
from paramclient.model.paramset import ParamSet, WrittenParam, set_of
from paramclient.model.values import Param, ParamType, Settable, bits_of, check_name, from_bits, same_bits
from paramclient.protocol import param_pck

LEFT_OUT_SHOWN_MAX: Final = 20
"""Names that the header of a file shows, of those that are left out."""

Content: TypeAlias = ParamFile | ParamSet | Mapping[str, Param | Settable] | Iterable[ParamSet]
"""Content to write: a file as read, the parameters of one component, also plain values, or of several."""


class _Format(NamedTuple):
    """How a format is read and written.

    Attributes:
        read: returns the content, or raises FileError.
        write: returns the lines or bytes of sets, or raises UsageError.
        express: returns what is written of one parameter, or raises UsageError.
    """

    read: Callable[[Reading, FileFormat], ParamFile]
    write: Callable[[Sequence[ParamSet], ParamFile], Iterator[str] | bytes]
    express: Callable[[ParamSet, WrittenParam], object]


# param.pck: types, exact values and defaults, without vehicle and component


def _read_packed(reading: Reading, file_format: FileFormat) -> ParamFile:
    """Read a packed file in the format that a vehicle serves.

    Raises:
        FileError: the file is invalid.
    """
    try:
        pack = param_pck.decode(reading.data, checks_names=False)
    except PackError as error:
        raise FileError(f"invalid packed parameter file: {error}", source=reading.source) from error
    if pack.total > len(pack.entries):
        reading.notes.append(f"The file has {len(pack.entries)} of the vehicle's {pack.total} parameters.")
    for name, kind, bits, default in pack.entries:
        known = bits if default is None and pack.with_defaults else default
        value, own = from_bits(bits, kind), None if known is None else from_bits(known, kind)
        try:
            reading.add(WrittenParam(check_name(name), value, kind, own), "")
        except UsageError as error:
            reading.fault(None, str(error), is_row=True)
    return reading.file(file_format)


def _write_packed(params: ParamSet) -> bytes:
    """Return the bytes of a packed file, with defaults if all of them are known.

    Raises:
        UsageError: the format cannot express a parameter: it has four types, and only numbers.
    """
    entries = [_pack_entry(params, each) for each in params.values()]
    return param_pck.encode(entries, with_defaults=all(each.default is not None for each in params.values()))


def _pack_entry(_: ParamSet, param: WrittenParam) -> param_pck.PackedParam:
    """Return the entry of a parameter, or raise UsageError if the format cannot express it."""
    kind = param.type
    if not isinstance(kind, ParamType) or kind not in param_pck.PACKABLE:
        known = ", ".join(each.name for each in sorted(param_pck.PACKABLE))
        has = "no type" if kind is None else f"the type {ParamType(kind).name}"
        raise UsageError(f"{param.name} has {has}, and a packed file holds {known}")
    if param.is_raw:
        raise UsageError(f"{param.name} is not a number; json can keep it")
    bits = param.bits_as(kind)
    default = None if param.default is None else bits_of(param.default, kind)
    if default is not None and same_bits(kind, bits, default):
        default = None  # as vehicles write it: an entry without a default has its default value
    return param_pck.PackedParam(param.name, kind, bits, default)


# The table of formats


def _pairs(separator: str) -> _Format:
    line = functools.partial(lists.pair_line, separator)
    return _Format(lists.read_pairs, functools.partial(lists.write_list, line), line)


_FORMATS: Final = {
    FileFormat.PCK: _Format(_read_packed, lambda sets, _: _write_packed(sets[0]), _pack_entry),
    FileFormat.JSON: _Format(json_format.read_json, json_format.write_json, json_format.json_fields),
    FileFormat.QGC: _Format(lists.read_qgc, lists.write_qgc, lists.qgc_line),
    FileFormat.PARM: _pairs(" "),
    FileFormat.MISSION_PLANNER: _pairs(","),
}


def loads(
    data: bytes, *, source: str = "", file_format: FileFormat | str | None = None, partial: bool = False
) -> ParamFile:
    """Parse a parameter file.

    Detects the format from the content. MAVProxy and Mission Planner read each other's lists, so the
    extension decides between them (`.parm`, `.param`); with another extension, a comma means Mission
    Planner. If the first line matches no format, the extension decides which format the error describes.

    Args:
        data: the complete file. It includes no others, as bytes have no folder.
        source: the file's name, for errors and `ParamSet.source`.
        file_format: the format; None to detect it.
        partial: leave out parameters that cannot be taken, such as those with a name that no vehicle can
            have or a value that is no number, and note their lines. A fault of the whole file is an error.

    Raises:
        FileError: unknown format, damaged, or without parameters. The error names up to 20 bad lines; for a
            file of another program, it names that.
        UsageError: unknown format name.
    """
    return _read(Reading(data, source, partial=partial), file_format)


def read_file(
    path: str | os.PathLike[str], *, file_format: FileFormat | str | None = None, partial: bool = False
) -> ParamFile:
    """Read a parameter file of any supported format. Blocks until the disk has delivered it.

    A list in MAVProxy's or Mission Planner's format may include others with `@include FILE`. The path is
    relative to the file's folder, and the included file must be in that folder, beside it, or below either.
    Its lines replace the `@include` line.

    Args:
        path: the file.
        file_format, partial: as for `loads`.

    Raises:
        FileError: the file cannot be read, is too large, has no known format or is damaged. Nothing is
            returned then; the error names up to 20 bad lines.
        UsageError: unknown format.
    """
    source = os.fspath(path)
    return _read(Reading(read_bytes(source), source, partial=partial, is_on_disk=True), file_format)


def _read(reading: Reading, file_format: FileFormat | str | None) -> ParamFile:
    if len(reading.data) > LARGEST_FILE:
        raise FileError(f"a parameter file has at most {LARGEST_FILE} bytes", source=reading.source)
    try:
        reading.partial &= kind_of(reading.data) is None  # a file of another kind is no part of a file
        chosen = _format_of(reading) if file_format is None else FileFormat(file_format)
        file = _FORMATS[chosen].read(reading, chosen)
        _check(file.sets, chosen, reading.source)
        return file
    except FileError as error:
        if (kind := kind_of(reading.data)) is None:
            raise
        raise FileError(f"not a parameter file: {kind}", source=reading.source) from error


def _format_of(reading: Reading) -> FileFormat:
    if reading.data.startswith(param_pck.MAGICS):
        return FileFormat.PCK
    if reading.first.startswith("{"):
        return FileFormat.JSON
    if lists.is_qgc_row(reading.first):
        return FileFormat.QGC
    named = ENDINGS.get(PurePath(reading.source).suffix.lower(), FileFormat.PCK)
    is_list = named in (FileFormat.PARM, FileFormat.MISSION_PLANNER)
    if is_list or not (named is FileFormat.PCK or lists.is_pair(reading.first)):
        return named  # else no other format is possible, and reading gives the error for this one
    return FileFormat.MISSION_PLANNER if "," in reading.first else FileFormat.PARM


def dumps(content: Content, *, file_format: FileFormat | str | None = None, target: str = "") -> bytes:
    """Return the bytes of a parameter file.

    Args:
        content: the content to write. A `ParamFile` keeps its header, footer and comments if the format
            supports them; other content gets a header that names the vehicle.
        file_format: the format; None for that of a `ParamFile`.
        target: the name of the target file, for errors.

    Raises:
        FileError: the format cannot express the content (the guide lists what each can), or there are no
            parameters.
        UsageError: unknown format, or none given.
    """
    if file_format is None and isinstance(content, ParamFile):
        file_format = content.file_format
    if file_format is None:
        raise UsageError("give the format in which to write the parameters")
    chosen = FileFormat(file_format)
    try:
        around = content if isinstance(content, ParamFile) else _as_file(content, chosen)
        sets = [each for each in around.sets if each]
        _check(sets, chosen)
        written = _FORMATS[chosen].write(sets, around)
        if isinstance(written, bytes):
            return written
        return "".join(f"{line}\n" for line in written).encode("utf-8", "backslashreplace")
    except UsageError as error:
        raise FileError(str(error), source=target) from error


def write_file(
    path: str | os.PathLike[str], content: Content, *, file_format: FileFormat | str | None = None
) -> FileFormat:
    """Write a parameter file, and replace an existing one atomically. Blocks until the file is on disk.

    The old file stays unchanged until the new one is completely on disk, and also if writing fails. The mode
    is kept. If the path is a symbolic link, the link stays and its target is replaced.

    Args:
        path: the file.
        content: a file as read, the parameters of one component, or of several.
        file_format: the format; None to choose it by the file extension.

    Returns:
        The format of the written file.

    Raises:
        FileError: the format cannot express the content, the extension is unknown, or writing failed.
        UsageError: unknown format.
    """
    source = os.fspath(path)
    chosen = format_of_name(source) if file_format is None else FileFormat(file_format)
    replace_file(source, dumps(content, file_format=chosen, target=source))
    return chosen


def writable(params: ParamSet, file_format: FileFormat) -> tuple[ParamSet, list[str]]:
    """Return a set without what a format cannot hold, and these names.

    If the format can hold none of the parameters, the set is returned unchanged: writing it gives the reason.
    """
    kept = {}
    for name, param in params.items():
        with suppress(UsageError):
            _FORMATS[file_format].express(params, param)
            kept[name] = param
    left_out = [name for name in params if name not in kept]
    if not left_out or not kept or params.is_extended:
        return params, []
    lacks = f"without {first_of(left_out, LEFT_OUT_SHOWN_MAX)}"
    return replace(params, params=kept, lacks="; ".join(filter(None, (params.lacks, lacks)))), left_out


def _as_file(content: Mapping[str, Any] | Iterable[ParamSet], file_format: FileFormat) -> ParamFile:
    sets = (set_of(content),) if isinstance(content, Mapping) else tuple(content)
    if wrong := [each for each in sets if not isinstance(each, ParamSet)]:
        raise TypeError(f"{wrong[0]!r} is not a ParamSet, nor are these parameters by name")
    header = (line for each in sets for line in _header_lines(each, lacks_begin(each, sets)))
    # a document has fields for these facts
    return ParamFile(sets, file_format, header=() if file_format is FileFormat.JSON else tuple(header))


def _header_lines(params: ParamSet, lacks: str) -> Iterator[str]:
    """Generate a description of a set, for the header of a file."""
    identity = params.identity
    kind = f", {params.autopilot}" if params.autopilot else ""
    yield f"{counted(len(params), 'parameter')} of {address(params)}{kind}"
    if identity is not None:
        commit = f", commit {identity.git_hash}" if identity.git_hash else ""
        firmware = f", firmware {version_text(identity.firmware)}{commit}" if identity.firmware else ""
        yield f"of the vehicle {identity.key}{firmware}"
    if params.at is not None:
        yield f"as of {time_text(params.at, 'seconds')}"
    yield from (f"{begin}{text}" for begin, text in (("from ", params.source), (lacks, params.lacks)) if text)


def _check(sets: Sequence[ParamSet], file_format: FileFormat, source: str = "") -> None:
    """Raise UsageError for sets that are not valid, or FileError if no format holds them together."""
    if not sets:
        raise UsageError("there are no parameters to write")
    if len(sets) > 1 and file_format not in (FileFormat.JSON, FileFormat.QGC):
        there = ", ".join(map(address, sets))
        raise UsageError(f"the format {file_format} holds one component, and there are {there}; choose one")
    extended = {each.is_extended for each in sets}
    if True in extended and file_format is not FileFormat.JSON:
        raise UsageError(f"the format {file_format} cannot hold extended parameters; write .json")
    if len(extended) > 1:
        raise FileError("a file has either plain or extended parameters, not both", source=source)
    seen = set()
    for each in sets:
        for param in each.values():
            check_name(param.name)
        ids = (each.system, AUTOPILOT if each.component is None else each.component)
        if ids in seen:  # nothing distinguishes the two
            raise FileError(f"two sets have the same component, {address(each)}", source=source)
        seen.add(ids)


# Files that are no parameter files, although they are mistaken for them

BEGIN_SIZE: Final = 65_536
"""Bytes at the beginning of a file that show what it is."""

_NUMBER: Final = r"[-+.0-9eE]+"
_TOP: Final = r"\A(?:[ \t]*(?:#.*)?\n)*"
"""Comments and empty lines at the beginning."""
_BYTES: Final = (
    (b"SQLite format 3\0", "an SQLite database"),
    (b"ULog\x01\x12\x35", "an on-board log of PX4 (ULog)"),
    (b"\xa3\x95", "an on-board log of ArduPilot (dataflash)"),
    ((b"\xfd7zXZ\0", b"\x1f\x8b", b"PK\x03\x04"), "a compressed file; unpack it first"),
)
"""What files that begin with these bytes are."""
_TEXTS: Final = (
    (r"\A\s*(?s:<.{,999})?<(?:!doctype html|html)", "a page of HTML; download the file itself"),
    (
        r'\A(?s:.{,999})<paramfile\b|"(shortDesc|DisplayName|metadataTypes)":|"parameters":\s*\[\s*\{(?![^}]*"value":)',
        "metadata of parameters without values, which goes with --metadata",
    ),
    (r"\A\s*<(?:\?xml|!--|\w+[ >])", "XML"),
    (r'"fileType"\s*:\s*"Plan"', "a plan of QGroundControl (JSON): a mission, without parameters"),
    (
        r"^Symbols: x = used|^[x ] [ +*] \w+ \[[0-9]+,[0-9]+\] : |^BSON_\w+: ",
        "the output of PX4's `param show` or `bsondump`; save the parameters with a ground station",
    ),
    (
        rf"{_TOP}[0-9]+[ \t]+[0-9]+[ \t]+[A-Za-z]\w*[ \t]+{_NUMBER}\s*$",
        "a list with four columns, of an old QGroundControl: it has no type column",
    ),
    (
        r"^[ \t]*param[ \t]+(?:set|set-default|greater|compare)\s",
        "a start script of PX4, whose values depend on the vehicle",
    ),
    (r"\A#!.*sh\b|^[ \t]*\.[ \t]+\$\{R\}", "a script that sets no parameter; it may call another script"),
    (
        rf"{_TOP}(?:\w+[ \t,]+{_NUMBER}(?:[ \t]+[-+.0-9]|,[-+0-9]*\.).*\n){{2}}",
        "a list with a third column, perhaps of defaults; remove it",
    ),
)
"""What texts in which these patterns are found are, in upper or lower case. The first one counts."""


def kind_of(data: bytes) -> str | None:
    """Return what a file that is no parameter file seems to be; None if that is not known."""
    for magic, kind in _BYTES:
        if data.startswith(magic):
            return kind
    if re.match(rb"(?s:.{4})(?:[\x01\x10]\w{1,16}\0|\0\Z)", data):  # the size is 0 before PX4 1.12
        return "parameter storage of PX4 (BSON); save the parameters with a ground station"
    if data[8:9] in (b"\xfd", b"\xfe") and b"\0" in data[:BEGIN_SIZE]:
        return "a telemetry log (.tlog), which goes as replay:FILE"
    text = data[:BEGIN_SIZE].decode("utf-16" if data.startswith(UTF16_MARKS) else "utf-8-sig", "replace")
    return next((kind for pattern, kind in _TEXTS if re.search(f"(?im){pattern}", text)), None)
