"""The event feed: numbered events, kept in one ring for all listeners.

A listener is a position in the ring. A slow listener therefore delays no other and needs no memory of its
own, and a listener that reconnects continues at its position. When the ring has overwritten the next event of
a listener, its stream ends: after it has reconnected, it loads everything again.
"""

from __future__ import annotations

import json
import secrets
import time
from collections import deque
from collections.abc import AsyncIterator
from itertools import islice
from typing import Any, Final

import anyio

__all__ = ["EventFeed"]

EVENTS_KEPT: Final = 4_096
"""Number of kept events, 0.5 kB each: more than two whole tables."""
BATCH_EVENTS_MAX: Final = 64
"""Maximum number of events that a listener gets at once; the event loop runs other tasks between two."""
KEEP_ALIVE_INTERVAL: Final = 15.0
"""Seconds without an event after which a comment is sent, so that both sides notice a lost connection."""


class EventFeed:
    """The events of one run of the service.

    Args:
        kept: number of kept events.

    Attributes:
        run: id of the run; numbers of other runs are not comparable.
        seq: number of the newest event.
        listeners: number of open streams.
    """

    def __init__(self, *, kept: int = EVENTS_KEPT) -> None:
        self.run = secrets.token_hex(8)
        self.seq = 0
        self.listeners = 0
        self._is_ended = False
        self._texts: deque[str] = deque(maxlen=kept)
        self._arrived = anyio.Event()

    @property
    def position(self) -> dict[str, Any]:
        """The members of a document that includes the effects of all events so far."""
        return {"run": self.run, "seq": self.seq}

    def publish(self, kind: str, /, **members: Any) -> None:
        """Add an event.

        Args:
            kind: its `type`.
            members: further members, as JSON.
        """
        self.seq += 1
        event = {**self.position, "at": round(time.time(), 3), "type": kind, **members}
        self._texts.append(json.dumps(event, allow_nan=False, separators=(",", ":")))
        self._wake()

    def end(self) -> None:
        """End all streams after the events so far."""
        self._is_ended = True
        self._wake()

    def can_resume(self, last_id: str | None) -> bool:
        """Return whether the event after the one with this id is still kept."""
        run, _, seq = (last_id or "").partition("-")
        return run == self.run and seq.isascii() and seq.isdecimal() and self._oldest <= int(seq) <= self.seq

    async def follow(self, last_id: str | None = None) -> AsyncIterator[str]:
        """Yield server-sent events: `hello`, then all events after the one with this id, or after now.

        Ends with the feed, or when the listener was too slow and its next event is lost.
        """
        resumed = self.can_resume(last_id)
        position = int((last_id or "").partition("-")[2]) if resumed else self.seq
        hello = {"run": self.run, "seq": position, "type": "hello", "resumed": resumed}
        self.listeners += 1
        try:
            yield f"id: {self.run}-{position}\ndata: {json.dumps(hello)}\n\n"
            while position >= self._oldest:
                start = position - self._oldest
                batch = list(islice(self._texts, start, start + BATCH_EVENTS_MAX))
                if batch:
                    numbered = enumerate(batch, position + 1)
                    position += len(batch)
                    yield "".join([f"id: {self.run}-{seq}\ndata: {text}\n\n" for seq, text in numbered])
                elif self._is_ended:
                    return
                else:
                    arrived = False
                    with anyio.move_on_after(KEEP_ALIVE_INTERVAL):
                        await self._arrived.wait()
                        arrived = True
                    if not arrived:
                        yield ": nothing new\n\n"
        finally:
            self.listeners -= 1

    @property
    def _oldest(self) -> int:
        """The number of the event before the oldest kept one."""
        return self.seq - len(self._texts)

    def _wake(self) -> None:
        arrived, self._arrived = self._arrived, anyio.Event()
        arrived.set()
