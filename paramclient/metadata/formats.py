"""A file that describes parameters, whichever of the known forms it has."""

from __future__ import annotations

import lzma
import os
from pathlib import Path
from typing import Final

from paramclient.errors import MetadataError
from paramclient.metadata.info import Metadata

__all__ = ["LARGEST_PACKED", "json_of", "read_content", "read_metadata", "unpacked"]

LARGEST_PACKED: Final = 4 << 20
"""Bytes of a file that is packed, or comes from a vehicle; PX4's has about 0.1 million."""
LARGEST: Final = 16 << 20
"""Bytes of a file, and of what a packed one may become; those of ArduPilot and PX4 have 2 to 5 million."""
MOST_MEMORY: Final = 96 << 20
"""Bytes that unpacking may take. PX4 packs with a dictionary of 64 million, `xz -9`."""


def read_metadata(path: str | os.PathLike[str]) -> Metadata:
    """Read a file of descriptions: PX4's parameters.json, or ArduPilot's apm.pdef.xml or apm.pdef.json.

    Each may be packed with xz. The form is told by the content, not by the name.

    Raises:
        MetadataError: it cannot be read, is too large, or is none of these.
    """
    source = os.fspath(path)
    try:
        with Path(path).open("rb") as file:
            content = file.read(LARGEST + 1)
    except OSError as error:
        raise MetadataError(f"{source}: cannot be read: {error.strerror or error}", source=source) from error
    return read_content(content, source=source)


def read_content(content: bytes, *, source: str) -> Metadata:
    """The same with the bytes of a file, as they are.

    Args:
        content: the bytes.
        source: their name, for errors and for people.

    Raises:
        MetadataError: as `read_metadata`.
    """
    content = unpacked(content, source=source).removeprefix(b"\xef\xbb\xbf")
    start = content.lstrip(b" \t\r\n")[:64]
    if start.startswith(b"<"):
        from paramclient.metadata import ardupilot  # only here: both load pydantic

        return ardupilot.read_xml(content, source=source)
    if not start.startswith(b"{"):
        what = "PX4's parameters.json, ArduPilot's apm.pdef.xml or apm.pdef.json"
        raise MetadataError(f"{source}: is neither JSON nor XML; expected {what}", source=source)
    from paramclient.metadata import ardupilot, px4  # only here: both load pydantic

    document = json_of(content, source=source)
    if "parameters" in document:
        return px4.read_parameters(document, source=source)
    if "metadataTypes" in document:
        raise MetadataError(
            f"{source}: is the general metadata file, which only says where others are; "
            f"the one with the parameters is wanted",
            source=source,
        )
    return ardupilot.read_json(document, source=source)


def json_of(content: bytes, *, source: str) -> dict[str, object]:
    """The object that a JSON text is.

    Raises:
        MetadataError: it is none.
    """
    from pydantic_core import from_json  # only here: it takes time to load

    try:
        document = from_json(content)
    except ValueError as error:
        raise MetadataError(f"{source}: no JSON: {error}", source=source) from None
    if not isinstance(document, dict):
        raise MetadataError(f"{source}: is JSON, and no object", source=source)
    return document


def unpacked(content: bytes, *, source: str) -> bytes:
    """The content of a file that may be packed with xz.

    Raises:
        MetadataError: it is damaged, or too large.
    """
    is_packed = content.startswith(_XZ)
    if len(content) > (LARGEST_PACKED if is_packed else LARGEST):
        raise _too_large(source)
    if not is_packed:
        return content
    unpacker = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=MOST_MEMORY)
    try:
        result = unpacker.decompress(content, LARGEST + 1)
    except lzma.LZMAError as error:
        raise MetadataError(f"{source}: cannot be unpacked: {error}", source=source) from None
    if len(result) > LARGEST:
        raise _too_large(source)
    if not unpacker.eof:
        raise MetadataError(f"{source}: cannot be unpacked: it is cut short", source=source)
    return result


_XZ: Final = b"\xfd7zXZ\0"


def _too_large(source: str) -> MetadataError:
    return MetadataError(f"{source}: is too large for a description of parameters", source=source)
