"""Size and time limits of data from a service, which may be damaged, of another program, or hostile."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Mapping
from typing import Any, Final

from httpx_sse._decoders import SSEDecoder  # the public EventSource reads lines of unlimited length

__all__ = ["EventReader", "ResponseDeadline", "checked_document", "decoder_of"]

RESPONSE_BYTES_MAX: Final = 32 << 20
"""Maximum size of a response in bytes: the largest possible table takes 15 million."""
EVENT_BYTES_MAX: Final = 4 << 20
"""Maximum size of an event in bytes: one with every parameter name of the largest table takes 2 million."""
DOCUMENT_VALUES_MAX: Final = 1_000_000
"""Maximum number of values in a document, without names: the largest table has 655,350. Each takes
up to 0.2 kB."""
JSON_NESTING_MAX: Final = 32
"""Maximum nesting of lists and objects in a document: documents of a service have at most 8 levels."""
RESPONSE_TIMEOUT: Final = 30.0
"""Timeout in seconds for the rest of a response or event after its first bytes."""
RESPONSE_RATE_MIN: Final = 1_000
"""Bytes for which the timeout is extended by 1 s: a radio of 57600 baud transfers five times as many."""


def checked_document(data: bytes) -> Any:
    """Parse JSON within the limits.

    Raises:
        ValueError: the data is not JSON, or exceeds a limit.
    """
    if data.count(b",") + data.count(b"[") + data.count(b"{") > DOCUMENT_VALUES_MAX:
        raise ValueError(f"a document of more than {DOCUMENT_VALUES_MAX} values")
    try:
        document = json.loads(data)
    except RecursionError:
        raise ValueError(f"a document deeper than {JSON_NESTING_MAX}") from None
    level = [document]
    for _ in range(JSON_NESTING_MAX):
        level = [
            each for container in level for each in _children(container) if isinstance(each, dict | list)
        ]
        if not level:
            return document
    raise ValueError(f"a document deeper than {JSON_NESTING_MAX}")


def decoder_of(encoding: str) -> Callable[[bytes, int], bytes]:
    """Return a decoder of the chunks of a response: a function of a chunk and a maximum size in bytes.

    It returns one byte more than the maximum if the decoded chunk is larger.

    Args:
        encoding: value of the header Content-Encoding.

    Raises:
        ValueError: the encoding was not requested; or, from the decoder, the data is damaged.
    """
    if encoding in ("", "identity"):
        return lambda data, most: data
    if encoding not in ("gzip", "deflate"):
        raise ValueError(f"the content encoding {encoding:.40} was not requested")
    inflater = zlib.decompressobj(zlib.MAX_WBITS | 32)

    def decode(data: bytes, most: int) -> bytes:
        try:
            return inflater.decompress(data, most + 1)
        except zlib.error as error:
            raise ValueError(str(error)) from error

    return decode


class ResponseDeadline:
    """Deadline of a response or event that has begun, extended by received bytes.

    Args:
        now: time of the start, in seconds.
    """

    def __init__(self, now: float) -> None:
        self._ends = now + RESPONSE_TIMEOUT

    def left(self, size: int, now: float) -> float:
        """Return the seconds left after this number of received bytes."""
        return self._ends + size / RESPONSE_RATE_MIN - now


class EventReader:
    """Parses server-sent events (WHATWG HTML, "Server-sent events") of bounded size into the data of each.

    Lines are split here, because httpx-sse has no limit for their length; its decoder parses their fields. An
    event without data, or with empty data, is skipped.

    Attributes:
        size: received bytes of the incomplete event.
    """

    def __init__(self) -> None:
        self.size = 0
        self._line = bytearray()
        self._decoder = SSEDecoder()

    def receive(self, chunk: bytes) -> list[bytes]:
        """Return the data of the events that end with this chunk.

        Raises:
            ValueError: an event exceeds `EVENT_BYTES_MAX`.
        """
        events = []
        begin = 0
        while (end := chunk.find(b"\n", begin)) >= 0:
            self._line += chunk[begin:end]
            self.size += end + 1 - begin
            begin = end + 1
            # Latin-1 keeps each byte as one character; the JSON parser decodes UTF-8, and rejects damage
            line, self._line = self._line.removesuffix(b"\r").decode("latin-1"), bytearray()
            if not line:
                self.size = 0
            event = self._decoder.decode(line)
            if event is not None and event.data:
                events.append(event.data.encode("latin-1"))
            if self.size > EVENT_BYTES_MAX:
                break
        self._line += chunk[begin:]
        self.size += len(chunk) - begin
        if self.size > EVENT_BYTES_MAX:
            raise ValueError(f"an event of more than {EVENT_BYTES_MAX} bytes")
        return events


def _children(value: Any) -> Any:
    return value.values() if isinstance(value, Mapping) else value if isinstance(value, list) else ()
