"""The event feed: numbered events of the service, kept in one list for all listeners.

A listener is only a position in the list, so that 1,000 listeners need almost no memory, and a slow listener
delays no other listener. A listener whose position was overwritten receives the number of missed events.
Listeners with the same position and filter share one encoded batch. The members of the events are built by
`followed_component`, `followed_extended`, `link` and `jobs`.
"""

from __future__ import annotations

import json
import re
import secrets
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import Any, Final, NamedTuple, TypeAlias

import anyio
import anyio.lowlevel

__all__ = [
    "COMPACT_SEPARATORS",
    "Batch",
    "EventFeed",
    "EventFilter",
    "EventPosition",
    "Listener",
    "change_members",
]

COMPACT_SEPARATORS: Final = (",", ":")
"""JSON separators without spaces."""
EVENTS_KEPT_MAX: Final = 16_384
"""Number of kept events for slow and reconnecting listeners: ten whole tables. An event takes about
0.6 kB, that of a value 1 kB until it is encoded."""
BATCH_INTERVAL_MAX: Final = 0.1
"""Maximum delay in seconds before listeners are woken again. A download causes hundreds of events per second;
waking 200 listeners for each would take longer than the download."""
BATCH_INTERVAL_PER_LISTENER: Final = 0.0005
"""Delay in seconds per listener before listeners are woken again."""
BATCH_EVENTS_MAX: Final = 64
"""Maximum number of events in a batch. Encoding them takes 9 ms, and the event loop runs other tasks between
batches. Events after the batch can still be lost."""
SHARED_BATCHES_MAX: Final = 32
"""Number of encoded batches kept for listeners with the same position and filter."""

_encode: Final = json.JSONEncoder(allow_nan=False, separators=COMPACT_SEPARATORS).encode
_POSITION: Final = re.compile(r"([0-9a-f]{16})-([0-9]{1,18})")


EventLabel: TypeAlias = tuple[str, str | None, int | None, int | None]
"""Type of an event, name of its link, its system id and component id. Garbage collections do not visit plain
tuples of such values, nor strings."""


class EventPosition(NamedTuple):
    """Position in the events of one run of the service.

    Attributes:
        run: id of the run, new with each start of the service.
        seq: number of the last received event.
    """

    run: str
    seq: int

    def __str__(self) -> str:
        return f"{self.run}-{self.seq}"

    @classmethod
    def read(cls, text: str) -> EventPosition | None:
        """Parse `RUN-SEQ`; None for any other text."""
        found = _POSITION.fullmatch(text.strip())
        return None if found is None else cls(found[1], int(found[2]))


class EventFilter(NamedTuple):
    """Filter of a listener; None matches everything.

    Attributes:
        types: types of events.
        link: name of the link.
        system: system id.
        component: component id. Events without a link or component match every filter for these.
    """

    types: frozenset[str] | None = None
    link: str | None = None
    system: int | None = None
    component: int | None = None

    def matches(self, label: EventLabel) -> bool:
        """Return whether an event with this label matches."""
        kind, link, system, component = label
        return (
            (self.types is None or kind in self.types)
            and (self.link is None or link in (None, self.link))
            and (self.system is None or system in (None, self.system))
            and (self.component is None or component in (None, self.component))
        )


@dataclass(frozen=True, slots=True)
class Batch:
    """Events that a listener receives at once.

    Attributes:
        position: position of the listener after them.
        missed: number of lost events, including those that do not match its filter.
        texts: numbers and JSON of the events.
    """

    position: EventPosition
    missed: int
    texts: tuple[tuple[int, str], ...]

    @property
    def as_event_stream(self) -> bytes:
        """Return the batch as server-sent events (WHATWG HTML, "Server-sent events")."""
        run = self.position.run
        return "".join([f"id: {run}-{seq}\ndata: {text}\n\n" for seq, text in self.texts]).encode()


def change_members(name: str, old: str | None, new: str | None, by: str, kind: str) -> str:
    """Return the members of a change as JSON without the braces.

    Args:
        name: name of the parameter.
        old, new: the values before and after as JSON, or None.
        by: author of the change.
        kind: added, changed or removed.
    """
    members = f'"name":{json.dumps(name)},"old":{old or "null"},"new":{new or "null"},"by":{json.dumps(by)}'
    return f'{members},"kind":"{kind}"'


class EventFeed:
    """The events of one run of the service.

    Args:
        clock: returns unix seconds.
        kept: number of kept events.

    Attributes:
        run: id of the run; numbers of other runs are not comparable.
        seq: number of the newest event.
        listeners: number of listeners.
        is_ended: whether the feed has ended.
    """

    def __init__(self, *, clock: Callable[[], float] = time.time, kept: int = EVENTS_KEPT_MAX) -> None:
        self.run = secrets.token_hex(8)
        self.seq = 0
        self.listeners = 0
        self.is_ended = False
        self._clock = clock
        self._released_seq = 0  # number of the last event that listeners have been woken for
        self._labels: deque[EventLabel] = deque(maxlen=kept)
        self._texts: deque[str | Callable[[], str]] = deque(maxlen=kept)  # JSON, or what encodes it
        self._woken = anyio.Event()
        self._has_new = anyio.Event()
        self._shared: dict[tuple[int, EventFilter], tuple[Batch, bytes]] = {}

    @property
    def position(self) -> EventPosition:
        """Return the position of the newest event."""
        return EventPosition(self.run, self.seq)

    def publish(
        self,
        kind: str,
        members: dict[str, Any] | Callable[[], str],
        *,
        link: str | None = None,
        system: int | None = None,
        component: int | None = None,
    ) -> int:
        """Add an event and return its number.

        Args:
            kind: type of the event.
            members: further members, as a dict for `json.dumps`, encoded now: garbage collections would visit
                the dicts of all kept events. Or a function that returns them as JSON without the braces,
                called on first use.
            link: name of the link, or None.
            system: system id, or None.
            component: component id, or None.
        """
        label = (kind, link, system, component)
        encode = partial(self._event_json, self.seq + 1, self._clock(), label, members)
        text = encode if callable(members) else encode()
        self.seq += 1
        self._labels.append(label)
        self._texts.append(text)
        self._has_new.set()
        return self.seq

    def listen(self, after: EventPosition | None = None, event_filter: EventFilter | None = None) -> Listener:
        """Return a listener at a position, or at the end if there is no position or its next event is
        lost."""
        oldest = self.seq - len(self._labels)
        can_resume = after is not None and after.run == self.run and oldest <= after.seq <= self.seq
        seq = after.seq if can_resume and after is not None else self.seq
        return Listener(
            self, seq, EventFilter() if event_filter is None else event_filter, is_resumed=can_resume
        )

    def end(self) -> None:
        """End the feed. Listeners receive the remaining events, then end."""
        self.is_ended = True
        self._has_new.set()
        self._wake()

    async def wake_listeners(self) -> None:
        """Wake listeners after new events, with a minimum interval, until cancelled."""
        while True:
            await self._has_new.wait()
            self._has_new = anyio.Event()
            self._wake()
            await anyio.sleep(min(BATCH_INTERVAL_MAX, BATCH_INTERVAL_PER_LISTENER * self.listeners))

    def _event_json(
        self, seq: int, at: float, label: EventLabel, members: dict[str, Any] | Callable[[], str]
    ) -> str:
        """Return an event as JSON."""
        kind, link, system, component = label
        places = {"link": link, "system": system, "component": component}
        known = {name: place for name, place in places.items() if place is not None}
        head = _encode({"run": self.run, "seq": seq, "at": round(at, 3), "type": kind, **known})
        more = members() if callable(members) else _encode(members)[1:-1]
        return f"{head[:-1]},{more}}}" if more else head

    def _text_at(self, index: int) -> str:
        """Return a kept event as JSON."""
        text = self._texts[index]
        if not isinstance(text, str):
            text = self._texts[index] = text()
        return text

    def _batch_after(self, seq: int, event_filter: EventFilter) -> tuple[Batch, bytes]:
        """Return the batch after a number for this filter, also as server-sent events."""
        key = (seq, event_filter)
        found = self._shared.get(key)
        if found is not None:
            return found
        oldest = self.seq - len(self._labels)
        if seq < oldest:  # the kept events are useless without the lost ones
            batch = Batch(EventPosition(self.run, self._released_seq), self._released_seq - seq, ())
        else:
            end = min(self._released_seq, seq + BATCH_EVENTS_MAX)
            labels = islice(self._labels, seq - oldest, end - oldest)
            chosen = (
                index for index, label in enumerate(labels, seq - oldest) if event_filter.matches(label)
            )
            texts = tuple((oldest + index + 1, self._text_at(index)) for index in chosen)
            batch = Batch(EventPosition(self.run, end), 0, texts)
        if len(self._shared) >= SHARED_BATCHES_MAX:
            del self._shared[next(iter(self._shared))]
        made = self._shared[key] = (batch, batch.as_event_stream)
        return made

    def _wake(self) -> None:
        self._released_seq = self.seq
        self._shared.clear()
        woken, self._woken = self._woken, anyio.Event()
        woken.set()


class Listener:
    """A position in the feed, for one task; a context manager.

    Attributes:
        position: its position.
        is_resumed: whether it continues at the requested position.
    """

    def __init__(self, feed: EventFeed, seq: int, event_filter: EventFilter, *, is_resumed: bool) -> None:
        self.position = EventPosition(feed.run, seq)
        self.is_resumed = is_resumed
        self._feed = feed
        self._event_filter = event_filter

    def __enter__(self) -> Listener:
        self._feed.listeners += 1
        return self

    def __exit__(self, *_: object) -> None:
        self._feed.listeners -= 1

    def hello(self) -> str:
        """Return the first event of every connection as JSON."""
        return self._event_for_self("hello", resumed=self.is_resumed)

    def gap(self, missed: int) -> str:
        """Return the event that reports lost events as JSON."""
        return self._event_for_self("gap", missed=missed)

    async def next(self, within: float) -> tuple[Batch, bytes] | None:
        """Return the next batch, also as server-sent events; None after a timeout without events.

        A batch without matching events only moves the position.

        Args:
            within: timeout in seconds.

        Raises:
            EOFError: the feed has ended.
        """
        feed = self._feed
        if feed._released_seq <= self.position.seq and not feed.is_ended:
            with anyio.move_on_after(within):
                await feed._woken.wait()
        if feed._released_seq <= self.position.seq:
            if feed.is_ended:
                raise EOFError
            return None
        await anyio.lowlevel.checkpoint()  # a reconnected listener may have thousands of events left
        batch, stream = feed._batch_after(self.position.seq, self._event_filter)
        self.position = batch.position
        return batch, stream

    def _event_for_self(self, kind: str, **members: Any) -> str:
        """Return an event for this listener only, with the number of its position."""
        at = round(self._feed._clock(), 3)
        event = {"run": self.position.run, "seq": self.position.seq, "at": at, "type": kind, **members}
        return _encode(event)
