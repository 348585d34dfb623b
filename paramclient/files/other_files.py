"""Files that are no parameter files, although they are mistaken for them: what they seem to be."""

from __future__ import annotations

import re
from typing import Final

BEGIN_SIZE: Final = 65_536
"""Bytes at the beginning of a file that show what it is."""

_NUMBER: Final = r"[-+.0-9eE]+"
_TOP: Final = r"\A(?:[ \t]*(?:#.*)?\n)*"
"""Comments and empty lines at the beginning."""
_BYTES: Final = (
    (b"SQLite format 3\0", "an SQLite database"),
    (b"ULog\x01\x12\x35", "an on-board log of PX4 (ULog)"),
    (b"\xa3\x95", "an on-board log of ArduPilot (dataflash)"),
    (b"\xfd7zXZ\0", "a compressed file (xz); unpack it first"),
    (b"\x1f\x8b", "a compressed file (gzip); unpack it first"),
    (b"PK\x03\x04", "a compressed file (zip); unpack it first"),
)
"""What files that begin with these bytes are."""
_TEXTS: Final = tuple(
    (re.compile(pattern, re.IGNORECASE | re.MULTILINE), kind)
    for pattern, kind in (
        (r"\A\s*<(?:!doctype html|html)", "a page of HTML; download the file itself"),
        (r"\A(?s:.{,999})<paramfile\b", "metadata of parameters without values, which goes with --metadata"),
        (r"\A\s*<(?:\?xml|!--|\w+[ >])", "XML"),
        (
            r'\A\s*\{(?s:.*?)"(?:shortDesc|DisplayName|metadataTypes)"\s*:',
            "metadata of parameters without values (JSON), which goes with --metadata",
        ),
        (r'"fileType"\s*:\s*"Plan"', "a plan of QGroundControl (JSON): a mission, without parameters"),
        (
            r"^Symbols: x = used|^[x ] [ +*] \w+ \[[0-9]+,[0-9]+\] : ",
            "the output of `param show` of PX4's console; save the parameters with a ground station",
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
)
"""What texts in which these patterns are found are. The first one counts."""


def kind_of(data: bytes) -> str | None:
    """Return what a file that is no parameter file seems to be; None if that is not known."""
    for magic, kind in _BYTES:
        if data.startswith(magic):
            return kind
    if len(data) > 4 and int.from_bytes(data[:4], "little") == len(data) and data.endswith(b"\0"):
        return "parameter storage of PX4 (BSON); save the parameters with a ground station"
    if data[8:9] in (b"\xfd", b"\xfe") and b"\0" in data[:BEGIN_SIZE]:
        return "a telemetry log (.tlog), which goes as replay:FILE"
    text = data[:BEGIN_SIZE].decode("utf-8", "replace")
    return next((kind for pattern, kind in _TEXTS if pattern.search(text)), None)
