"""The packed parameter file (param.pck): the whole table as one file, with types and defaults.

The file (ArduPilot, AP_Filesystem/README.md; MAVLink guide, "Parameters over MAVLink FTP"; newest PX4 serves
the same) has a header of three 16-bit numbers: a magic, the number of entries in the file, and the number of
parameters of the vehicle; in a file for writing, the last is the length of the file. An entry has: zero bytes
as padding; the type, with a flag for a default; the number of characters that the name shares with the one
before; the other characters; the value in its own size; the default likewise. Integers are exact, also those
that a PARAM_VALUE of ArduPilot would round.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Iterator
from typing import Final, NamedTuple

from paramclient.errors import PackError, UsageError
from paramclient.model.values import NAME_LENGTH, ParamType, check_name

PARAM_FILE: Final = "@PARAM/param.pck"
"""The path of the file in MAVFTP."""
READ_SIZE_DEFAULT: Final = 239
"""Bytes in one message of MAVFTP, at most, and the usual size of reads of the file."""
PACK_SIZE_MAX: Final = 6 + 65535 * (2 + NAME_LENGTH + 2 * 4 + 7)
"""Bytes of the largest possible file: as many entries as the header can count, each with the longest name, a
default, and the most padding that is useful. Longer files are rejected."""

PACKABLE: Final = frozenset({ParamType.INT8, ParamType.INT16, ParamType.INT32, ParamType.REAL32})
"""The parameter types that a file can contain."""

_MAGIC = 0x671B
_MAGIC_WITH_DEFAULTS = 0x671C
MAGICS: Final = tuple(magic.to_bytes(2, "little") for magic in (_MAGIC, _MAGIC_WITH_DEFAULTS))
"""The first two bytes of every such file, without and with defaults."""
_HEADER = struct.Struct("<HHH")
_TYPES = {1: ParamType.INT8, 2: ParamType.INT16, 3: ParamType.INT32, 4: ParamType.REAL32}
_NUMBERS = {kind: number for number, kind in _TYPES.items()}
_HAS_DEFAULT = 0x10
_padding = re.compile(rb"\0*").match


class PackedParam(NamedTuple):
    """One entry.

    Attributes:
        name: param_id.
        type: INT8, INT16, INT32 or REAL32; the file has no others.
        bits: the value, as in `Param.bits`.
        default: the firmware's default, likewise; None where the file has none, and in a file with defaults
            where the value is the default. ArduPilot compares the two as float32.
    """

    name: str
    type: ParamType
    bits: int
    default: int | None = None


class Pack(NamedTuple):
    """The content of a file.

    Attributes:
        entries: in the order of the file, which is that of the parameters' indices.
        total: the number of parameters of the vehicle: more than entries in a part of the table.
        with_defaults: whether an entry without a default has its default value.
    """

    entries: tuple[PackedParam, ...]
    total: int
    with_defaults: bool


def decode(data: bytes, *, checks_names: bool = True) -> Pack:
    """Decode a file from a vehicle.

    Without `checks_names`, a name may have characters that no param_id has; bytes are read as Latin-1.

    Raises:
        PackError: the file is invalid: magic, type, flag or name, a name that occurs twice, a truncated file,
            another number of entries than in the header, or more bytes than possible.
    """
    pack, number = decode_prefix(data, checks_names=checks_names)
    if len(pack.entries) < number:
        raise PackError(f"the file is cut off: {len(pack.entries)} of {number} entries", offset=len(data))
    return pack


def decode_prefix(data: bytes, *, checks_names: bool = True) -> tuple[Pack, int]:
    """Decode the complete entries at the beginning of a file from a vehicle.

    No entry depends on later ones, so each of these is valid, whatever is missing. Also returns the number of
    entries in the whole file by its header.

    Raises:
        PackError: as in `decode`, except for a file that is truncated behind its header.
    """
    if len(data) > PACK_SIZE_MAX:
        raise PackError(f"no packed parameter file has {len(data)} bytes", offset=PACK_SIZE_MAX)
    if len(data) < _HEADER.size:
        raise PackError("the file is cut off in its header", offset=len(data))
    magic, number, total = _HEADER.unpack_from(data)
    if magic not in (_MAGIC, _MAGIC_WITH_DEFAULTS):
        raise PackError(f"a packed parameter file does not begin with 0x{magic:04x}", offset=0)
    if total < number:
        raise PackError(f"{number} entries of a table of {total}", offset=2)
    with_defaults = magic == _MAGIC_WITH_DEFAULTS
    return Pack(_entries(data, number, with_defaults, checks_names), total, with_defaults), number


def encode(
    entries: Iterable[PackedParam],
    *,
    total: int | None = None,
    with_defaults: bool = False,
    read_size: int = READ_SIZE_DEFAULT,
) -> bytes:
    """Encode the file that ArduPilot serves to a client that reads `read_size` bytes at a time.

    Padding keeps a value from being split between two reads, so that a repeated read cannot replace half of
    it. ArduPilot aligns only the last bytes of an entry: a default, where there is one.

    Args:
        entries: in the order of their indices.
        total: the number of parameters of the vehicle; None: these are all.
        with_defaults: include the defaults of entries that have one; otherwise they are left out.
        read_size: 1 to 239.

    Raises:
        UsageError: a name, type or value does not fit such a file, or a name occurs twice.
    """
    if not 1 <= read_size <= READ_SIZE_DEFAULT:
        raise UsageError(f"a file is read by 1 to {READ_SIZE_DEFAULT} bytes, not {read_size}")
    rows = list(entries)
    total = len(rows) if total is None else total
    if not len(rows) <= total <= 0xFFFF:
        raise UsageError(f"{len(rows)} entries of a table of {total}, and the file counts to 65535")
    body = b"".join(encode_entries(rows, with_defaults=with_defaults, read_size=read_size))
    return header(len(rows), total, with_defaults=with_defaults) + body


def header(number: int, total: int, *, with_defaults: bool = False) -> bytes:
    """Return the header of a file with a number of entries, of a table with `total`."""
    return _HEADER.pack(_MAGIC_WITH_DEFAULTS if with_defaults else _MAGIC, number, total)


def _entries(data: bytes, number: int, with_defaults: bool, checks_names: bool) -> tuple[PackedParam, ...]:
    """Decode the entries behind the header: that many, or the complete ones of a truncated file."""
    found: dict[str, PackedParam] = {}
    name = b""
    at = _HEADER.size
    for place in range(number):
        match = _padding(data, at)
        at = at if match is None else match.end()
        if at + 2 > len(data):
            break
        kind = _TYPES.get(data[at] & 0x0F)
        flags = data[at] & 0xF0
        if kind is None or flags not in (0, _HAS_DEFAULT) or (flags and not with_defaults):
            raise PackError(f"entry {place} begins with 0x{data[at]:02x}", offset=at)
        shared, more = data[at + 1] & 0x0F, (data[at + 1] >> 4) + 1
        value_at = at + 2 + more
        end = value_at + (2 * kind.size if flags else kind.size)
        if end > len(data):
            break
        if shared > len(name):
            raise PackError(f"entry {place} shares {shared} characters with {name!r}", offset=at)
        name = name[:shared] + data[at + 2 : value_at]
        text = name.decode("latin-1")
        if len(name) > NAME_LENGTH or (checks_names and not (text.isascii() and text.isprintable())):
            raise PackError(f"entry {place} has the name {text!r}", offset=at)
        if text in found:
            raise PackError(f"{text} occurs twice", offset=at)
        bits = int.from_bytes(data[value_at : value_at + kind.size], "little")
        default = int.from_bytes(data[value_at + kind.size : end], "little") if flags else None
        found[text] = PackedParam(text, kind, bits, default)
        at = end
    if len(found) == number and at < len(data):
        raise PackError(f"{len(data) - at} bytes are left over behind {number} entries", offset=at)
    return tuple(found.values())


def encode_entries(rows: Iterable[PackedParam], *, with_defaults: bool, read_size: int) -> Iterator[bytes]:
    """Yield each entry behind the header, with its padding before it; see `encode`."""
    last, length = "", _HEADER.size
    names = set()
    for name, kind, bits, default in rows:
        check_name(name)
        if name in names:
            raise UsageError(f"{name} stands twice among the parameters")
        names.add(name)
        number = _NUMBERS.get(kind)
        if number is None:
            raise UsageError(f"{name}: a packed parameter file has no {kind.name}")
        try:
            value = bits.to_bytes(kind.size, "little")
            if with_defaults and default is not None:
                number |= _HAS_DEFAULT
                value += default.to_bytes(kind.size, "little")
        except OverflowError:
            raise UsageError(f"{name}: its value or default has more bits than {kind.name}") from None
        others = (at for at, letter in enumerate(name[:-1]) if last[at : at + 1] != letter)
        shared = next(others, len(name) - 1)  # one character remains, as the file cannot encode none
        own = name[shared:].encode("ascii")
        entry = bytes((number, shared | len(own) - 1 << 4)) + own + value
        over = (length + len(entry)) % read_size
        if 0 < over < kind.size:
            entry = bytes(kind.size - over) + entry
        length += len(entry)
        yield entry
        last = name
