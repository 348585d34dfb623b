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
from typing import Any, Final

import anyio
from fastapi.sse import ServerSentEvent

__all__ = ["EventFeed"]

EVENTS_KEPT: Final = 4_096
"""Number of kept events, 0.5 kB each: more than two whole tables."""


class EventFeed:
    """The events of one run of the service.

    Args:
        kept: number of kept events.

    Attributes:
        run: id of the run; numbers of other runs are not comparable.
        seq: number of the newest event.
    """

    def __init__(self, *, kept: int = EVENTS_KEPT) -> None:
        self.run = secrets.token_hex(8)
        self.seq = 0
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

    async def follow(self, last_id: str | None = None) -> AsyncIterator[ServerSentEvent]:
        """Yield `hello`, then all events after the one with this id, or after now.

        Ends with the feed, or when the listener was too slow and its next event is lost.
        """
        run, _, seq = (last_id or "").partition("-")
        resumed = run == self.run and seq.isascii() and seq.isdecimal() and self._has_after(int(seq))
        position = int(seq) if resumed else self.seq
        hello = {"run": self.run, "seq": position, "type": "hello", "resumed": resumed}
        yield ServerSentEvent(raw_data=json.dumps(hello), id=f"{self.run}-{position}")
        while self._has_after(position):
            if position < self.seq:
                text = self._texts[position - self.seq]
                position += 1
                yield ServerSentEvent(raw_data=text, id=f"{self.run}-{position}")
            elif self._is_ended:
                return
            else:
                await self._arrived.wait()

    def _has_after(self, position: int) -> bool:
        """Return whether the event after this position, if there is one, is still kept."""
        return self.seq - len(self._texts) <= position <= self.seq

    def _wake(self) -> None:
        arrived, self._arrived = self._arrived, anyio.Event()
        arrived.set()
