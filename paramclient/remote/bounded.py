"""What a service sends, read within bounds: it may be damaged, another program, or one that means harm."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Mapping
from typing import Any, Final

from httpx_sse._decoders import SSEDecoder  # EventSource, which is offered, reads lines of any length

__all__ = ["EventReader", "Pace", "checked_document", "decoder_of"]

MOST_ANSWER: Final = 32 << 20
"""Bytes that an answer may have: the largest table there can be takes some 15 million."""
MOST_EVENT: Final = 4 << 20
"""Bytes that one event may have: one that names every parameter of the largest table takes two million."""
MOST_VALUES: Final = 1_000_000
"""Values that a document may have, names left out: the largest table has 655,350. Each takes up to 0.2 kB."""
DEEPEST: Final = 32
"""Lists and objects in each other in a document; those of a service have eight at most."""
SLOW_PATIENCE: Final = 30.0
"""Seconds for an answer to come once it has begun, or an event, where it comes slowly."""
SLOWEST: Final = 1_000
"""Bytes a second, above which there is more time: a radio of 57600 baud has five times as many."""


def checked_document(data: bytes) -> Any:
    """JSON within the bounds.

    Raises:
        ValueError: it is none, or beyond them.
    """
    if data.count(b",") + data.count(b"[") + data.count(b"{") > MOST_VALUES:
        raise ValueError(f"a document of more than {MOST_VALUES} values")
    try:
        document = json.loads(data)
    except RecursionError:
        raise ValueError(f"a document deeper than {DEEPEST}") from None
    level = [document]
    for _ in range(DEEPEST):
        level = [each for held in level for each in _held(held) if isinstance(each, dict | list)]
        if not level:
            return document
    raise ValueError(f"a document deeper than {DEEPEST}")


def decoder_of(encoding: str) -> Callable[[bytes, int], bytes]:
    """What decodes the pieces of an answer, each to at most so many bytes; beyond these it gives one more.

    Args:
        encoding: what Content-Encoding says.

    Raises:
        ValueError: it was not asked for; or, when decoding, it is not what it says.
    """
    if encoding in ("", "identity"):
        return lambda data, most: data
    if encoding not in ("gzip", "deflate"):
        raise ValueError(f"the content encoding {encoding:.40} was not asked for")
    inflater = zlib.decompressobj(zlib.MAX_WBITS | 32)

    def decode(data: bytes, most: int) -> bytes:
        try:
            return inflater.decompress(data, most + 1)
        except zlib.error as error:
            raise ValueError(str(error)) from error

    return decode


class Pace:
    """The time in which something that has begun to come has to be there.

    Args:
        now: seconds.
    """

    def __init__(self, now: float) -> None:
        self._ends = now + SLOW_PATIENCE

    def left(self, size: int, now: float) -> float:
        """Seconds that are left when so many bytes have come."""
        return self._ends + size / SLOWEST - now


class EventReader:
    """Parses server-sent events (WHATWG HTML, "Server-sent events") of bounded size into the data of each.

    Lines are split here, because those of httpx-sse may grow without end; their fields are read by its
    decoder. An event without data, or with empty data, is left out.

    Attributes:
        size: bytes of the event that has begun and not ended.
    """

    def __init__(self) -> None:
        self.size = 0
        self._line = bytearray()
        self._decoder = SSEDecoder()

    def receive(self, chunk: bytes) -> list[bytes]:
        """Return the data of the events that end with this chunk.

        Raises:
            ValueError: one is too long.
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
            if self.size > MOST_EVENT:
                break
        self._line += chunk[begin:]
        self.size += len(chunk) - begin
        if self.size > MOST_EVENT:
            raise ValueError("an event without end")
        return events


def _held(value: Any) -> Any:
    return value.values() if isinstance(value, Mapping) else value if isinstance(value, list) else ()
