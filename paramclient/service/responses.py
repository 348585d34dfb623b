"""Responses with documents, encoded in a worker thread or as they are sent, a long member entry by entry."""

from __future__ import annotations

import json
import zlib
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator, Sequence
from typing import Any, Final

import anyio.lowlevel
from fastapi import Response
from fastapi.responses import StreamingResponse

from paramclient.documents.document import Document
from paramclient.service.event_feed import COMPACT_SEPARATORS

__all__ = [
    "JSON",
    "document_response",
    "encode_document",
    "pack_entries",
    "packed_response",
    "streamed_response",
]

JSON: Final = "application/json"
"""Media type of JSON."""
LONG_MEMBER_ENTRIES: Final = 64
"""Maximum number of entries of a member that is encoded at once."""

PACKED_CHUNK_BYTES: Final = 65_536
"""Maximum number of bytes of a packed response that are unpacked at once."""
STREAMED_ENTRIES_MAX: Final = 32
"""Maximum number of entries of a streamed response that are encoded in one turn of the event loop: 1 ms."""
STREAMED_CHUNK_LENGTH: Final = 32_768
"""Number of characters from which the entries encoded so far are sent."""


async def document_response(
    run: Callable[[Callable[[], bytes]], Awaitable[bytes]],
    make: Callable[[], Document],
    *,
    status: int = 200,
) -> Response:
    """Return a response with a document.

    Args:
        run: runs the work, such as `Hub.run_in_thread`.
        make: creates the document.
        status: HTTP status code.

    Raises:
        Exception: any exception of `make`.
    """
    return Response(await run(lambda: encode_document(make())), status, media_type=JSON)


def encode_document(document: Document, **entries: Iterable[Document | tuple[str, Document]]) -> bytes:
    """Encode a document as JSON, with the result of `model_dump_json`.

    `model_dump_json` would hold the GIL for long with thousands of entries.

    Args:
        document: the document.
        entries: iterables that replace members of this name, lists or objects; those of an object with the
            names of its entries. Each entry is created, encoded and released before the next one.
    """
    return ("{" + ",".join(filter(None, _members(document, entries))) + "}").encode()


def pack_entries(entries: Iterable[Document]) -> bytes:
    """Encode entries of a list as JSON with a comma before each, and compress them."""
    packer = zlib.compressobj(level=1)
    packed = [packer.compress(f",{_encode_entry(each)}".encode()) for each in entries]
    return b"".join([*packed, packer.flush()])


def packed_response(document: Document, parts: Sequence[bytes]) -> Response:
    """Return a response with a document whose last member is a list of many entries, unpacked as it is sent.

    A response of 30 MB would otherwise take 60 MB until the client has received it.

    Args:
        document: the document, with an empty list.
        parts: entries by `pack_entries`.
    """
    begin, end = document.model_dump_json().encode()[:-2], b"]}"

    async def chunks() -> AsyncIterator[bytes]:
        yield begin
        is_first = True
        for part in parts:
            unpacker = zlib.decompressobj()
            data = unpacker.decompress(part, PACKED_CHUNK_BYTES)
            while data:
                yield data[1:] if is_first else data
                is_first = False
                await anyio.lowlevel.checkpoint()
                data = unpacker.decompress(unpacker.unconsumed_tail, PACKED_CHUNK_BYTES)
        yield end

    return StreamingResponse(chunks(), media_type=JSON)


def streamed_response(begin: str, entries: Iterable[str], end: str) -> Response:
    """Return a JSON response with many entries that are encoded as they are sent.

    It takes little memory until the client has received it, whatever the size of its entries.

    Args:
        begin, end: the text before and after the entries.
        entries: creates each entry on demand, in the event loop.
    """

    async def chunks() -> AsyncIterator[str]:
        yield begin
        separator, part, length = "", list[str](), 0
        for entry in entries:
            part.append(entry)
            length += len(entry)
            if len(part) >= STREAMED_ENTRIES_MAX or length >= STREAMED_CHUNK_LENGTH:
                yield separator + ",".join(part)
                separator, part, length = ",", [], 0
                await anyio.lowlevel.checkpoint()
        yield (separator + ",".join(part) if part else "") + end

    return StreamingResponse(chunks(), media_type=JSON)


def _members(
    document: Document, entries: dict[str, Iterable[Document | tuple[str, Document]]]
) -> Iterator[str]:
    for name, field in type(document).model_fields.items():
        key = json.dumps(field.serialization_alias or name)
        if name in entries:
            is_object = isinstance(getattr(document, name), dict)
            texts = ",".join(map(_encode_entry, entries[name]))
            yield f"{key}:{{{texts}}}" if is_object else f"{key}:[{texts}]"
            continue
        content = getattr(document, name)
        if isinstance(content, dict) and len(content) > LONG_MEMBER_ENTRIES:
            pairs = [f"{json.dumps(str(each))}:{_json(value)}" for each, value in content.items()]
            yield f"{key}:{{{','.join(pairs)}}}"
        elif isinstance(content, list) and len(content) > LONG_MEMBER_ENTRIES:
            yield f"{key}:[{','.join(map(_json, content))}]"
        else:
            yield document.model_dump_json(include={name})[1:-1]


def _encode_entry(entry: Document | tuple[str, Document]) -> str:
    if isinstance(entry, Document):
        return entry.model_dump_json()
    name, document = entry
    return f"{json.dumps(name)}:{document.model_dump_json()}"


def _json(content: Any) -> str:
    if isinstance(content, Document):
        return content.model_dump_json()
    return json.dumps(content, allow_nan=False, separators=COMPACT_SEPARATORS)
