"""Detection and reading of metadata files in all supported formats."""

from __future__ import annotations

import lzma
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Final

from paramclient.errors import FileError, UsageError
from paramclient.files.disk import read_bytes
from paramclient.metadata.info import Metadata

PACKED_SIZE_MAX: Final = 4 << 20
"""Bytes of a packed file, or of a file from a vehicle; PX4's has about 0.1 million."""
CONTENT_SIZE_MAX: Final = 8 << 20
"""Bytes of a file, and of an unpacked one; those of ArduPilot and PX4 have 2 to 5 million. To read one takes
up to seven times as much memory, if its text is not ASCII."""
UNPACKING_MEMORY_MAX: Final = 96 << 20
"""Bytes of memory for unpacking. PX4 packs with a dictionary of 64 million, `xz -9`."""


def read_metadata(path: str | os.PathLike[str]) -> Metadata:
    """Read a metadata file: PX4's parameters.json, or ArduPilot's apm.pdef.xml or apm.pdef.json.

    Each may be packed with xz. The format is detected from the content, not from the name.

    Raises:
        FileError: the file cannot be read, is too large, or has another format.
    """
    source = os.fspath(path)
    return read_content(read_bytes(source), source=source)


def read_content(content: bytes, *, source: str) -> Metadata:
    """Read the bytes of a metadata file, as `read_metadata`.

    Args:
        content: the bytes, possibly packed.
        source: their origin, for errors and for users.

    Raises:
        FileError: as `read_metadata`.
    """
    with naming(source):
        metadata = _read_unpacked(unpacked(content).removeprefix(b"\xef\xbb\xbf"))
    return replace(metadata, source=source)


@contextmanager
def naming(source: str) -> Iterator[None]:
    """Turn UsageError into FileError with the origin of a file."""
    try:
        yield
    except UsageError as error:
        raise FileError(str(error), source=source) from None


def json_of(content: bytes) -> dict[str, object]:
    """Parse a JSON object.

    Raises:
        UsageError: the text is not a JSON object.
    """
    from pydantic_core import from_json  # imported here: loads pydantic

    try:
        document = from_json(content)
    except ValueError as error:
        raise UsageError(f"not JSON: {error}") from None
    if not isinstance(document, dict):
        raise UsageError("is JSON, but not an object")
    return document


def unpacked(content: bytes) -> bytes:
    """Return the content of a file that may be packed with xz.

    Raises:
        UsageError: the file is damaged, or too large.
    """
    is_packed = content.startswith(_XZ)
    if len(content) > (PACKED_SIZE_MAX if is_packed else CONTENT_SIZE_MAX):
        raise UsageError("is too large for a metadata file")
    if not is_packed:
        return content
    unpacker = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=UNPACKING_MEMORY_MAX)
    try:
        result = unpacker.decompress(content, CONTENT_SIZE_MAX + 1)
    except lzma.LZMAError as error:
        raise UsageError(f"cannot be unpacked: {error}") from None
    if len(result) > CONTENT_SIZE_MAX:
        raise UsageError("is too large for a metadata file")
    if not unpacker.eof:
        raise UsageError("cannot be unpacked: the file is truncated")
    return result


_XZ: Final = b"\xfd7zXZ\0"


def _read_unpacked(content: bytes) -> Metadata:
    start = content.lstrip(b" \t\r\n")[:1]
    if start not in (b"<", b"{"):
        what = "PX4's parameters.json, ArduPilot's apm.pdef.xml or apm.pdef.json"
        raise UsageError(f"is neither JSON nor XML; expected {what}")
    from paramclient.metadata import ardupilot, px4  # imported here: both load pydantic

    if start == b"<":
        return ardupilot.read_xml(content)
    document = json_of(content)
    if "parameters" in document:
        return px4.read_parameters(document)
    if "metadataTypes" in document:
        raise UsageError(
            "is the general metadata file, which only names other files; use the file with the parameters"
        )
    return ardupilot.read_json(document)
