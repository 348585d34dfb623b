"""What happens, as an endless list with rising numbers: whoever listens reads on from where they stand.

There is one list for all. A listener is a place in it, so a thousand of them take no memory to speak of, and
one that is slow holds nobody up: when the list has gone on beyond its end, it is told so. What each is sent
is written out once for all who stand at the same place and want the same.
"""

from __future__ import annotations

import json
import re
import secrets
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from typing import Any, Final, NamedTuple

import anyio
import anyio.lowlevel

__all__ = ["COMPACT", "Batch", "Feed", "Listener", "Place", "Wanted"]

COMPACT: Final = (",", ":")
"""How JSON is written that many are sent."""
MOST_KEPT: Final = 16_384
"""Events that are kept for those who are slow, or come back: ten whole tables. About 1 kB each, and 0.6 kB
once it has been sent to a listener."""
GATHERING_TIME: Final = 0.1
GATHERING_SHARE: Final = 0.0005
"""Seconds for which events are gathered before listeners are woken again, at most, and for each that there
is: a download brings hundreds a second, and to wake two hundred for each of them would take more than the
download itself. One alone hardly waits."""
MOST_AT_ONCE: Final = 64
"""Events that one listener is given at a time. To write out as many takes 9 ms; the event loop comes round
before the next ones. What a listener has not been given can still be lost."""
MOST_SHARED: Final = 32
"""Batches that are kept written out, for listeners that stand at the same place and want the same."""

_PLACE: Final = re.compile(r"([0-9a-f]{16})-([0-9]{1,18})")


class Place(NamedTuple):
    """A place in the list of one run of the service; the event with this number is the last that was seen."""

    run: str
    seq: int

    def __str__(self) -> str:
        return f"{self.run}-{self.seq}"

    @classmethod
    def read(cls, text: str) -> Place | None:
        """What `str` makes of it; None for anything else."""
        found = _PLACE.fullmatch(text.strip())
        return None if found is None else cls(found[1], int(found[2]))


class Wanted(NamedTuple):
    """What a listener wants to hear of; None is everything.

    Attributes:
        types: kinds of events.
        link, system, component: whose. Events that are about nobody are for everybody.
    """

    types: frozenset[str] | None = None
    link: str | None = None
    system: int | None = None
    component: int | None = None

    def has(self, event: Happened) -> bool:
        """Whether it is among that."""
        return (
            (self.types is None or event.kind in self.types)
            and (self.link is None or event.link in (None, self.link))
            and (self.system is None or event.system in (None, self.system))
            and (self.component is None or event.component in (None, self.component))
        )


@dataclass(slots=True)
class Happened:
    """One event. It is written out when somebody wants it, and `members` are released then."""

    seq: int
    kind: str
    link: str | None
    system: int | None
    component: int | None
    at: float
    members: dict[str, Any] | Callable[[], str]
    text: str = ""


@dataclass(frozen=True, slots=True)
class Batch:
    """What a listener is given at once.

    Attributes:
        place: where it stands after that.
        missed: events that it was too slow for, and that are lost; those it did not want are among them.
        texts: the events as JSON, with their numbers.
    """

    place: Place
    missed: int
    texts: tuple[tuple[int, str], ...]

    @property
    def as_event_stream(self) -> bytes:
        """The same in the format of server-sent events (WHATWG HTML, "Server-sent events")."""
        run = self.place.run
        return "".join([f"id: {run}-{seq}\ndata: {text}\n\n" for seq, text in self.texts]).encode()


class Feed:
    """The list.

    Attributes:
        run: which run of the service this is: numbers of another one mean nothing here.
        seq: the number of the newest event.
        listeners: how many there are.
        is_over: whether nothing more will come.
    """

    def __init__(self, *, clock: Callable[[], float] = time.time, kept: int = MOST_KEPT) -> None:
        self.run = secrets.token_hex(8)
        self.seq = 0
        self.listeners = 0
        self.is_over = False
        self._clock = clock
        self._told = 0  # up to here listeners have been woken
        self._events: deque[Happened] = deque(maxlen=kept)
        self._woken = anyio.Event()
        self._something = anyio.Event()
        self._shared: dict[tuple[int, Wanted], tuple[Batch, bytes]] = {}

    @property
    def place(self) -> Place:
        """Where the list ends now."""
        return Place(self.run, self.seq)

    def publish(
        self,
        kind: str,
        members: dict[str, Any] | Callable[[], str],
        *,
        link: str | None = None,
        system: int | None = None,
        component: int | None = None,
    ) -> int:
        """Add an event; give its number.

        Args:
            kind: its type.
            members: what else it says, as `json.dumps` takes it; or what writes it, without the braces, when
                somebody wants it.
            link, system, component: whom it is about.
        """
        self.seq += 1
        self._events.append(Happened(self.seq, kind, link, system, component, self._clock(), members))
        self._something.set()
        return self.seq

    def listen(self, after: Place | None = None, wanted: Wanted | None = None) -> Listener:
        """A listener that stands at a place, or at the end where there is none or it is gone."""
        oldest = self.seq - len(self._events)
        can_resume = after is not None and after.run == self.run and oldest <= after.seq <= self.seq
        seq = after.seq if can_resume and after is not None else self.seq
        return Listener(self, seq, Wanted() if wanted is None else wanted, is_resumed=can_resume)

    def end(self) -> None:
        """Nothing more will come: listeners are told what there is, and end."""
        self.is_over = True
        self._something.set()
        self._wake()

    async def run_gathering(self) -> None:
        """Wake the listeners when there is something, not too often; until cancelled."""
        while True:
            await self._something.wait()
            self._something = anyio.Event()
            self._wake()
            await anyio.sleep(min(GATHERING_TIME, GATHERING_SHARE * self.listeners))

    def text_of(self, event: Happened) -> str:
        """An event as JSON."""
        if not event.text:
            head = json.dumps(
                {
                    "run": self.run,
                    "seq": event.seq,
                    "at": round(event.at, 3),
                    "type": event.kind,
                    **({} if event.link is None else {"link": event.link}),
                    **({} if event.system is None else {"system": event.system}),
                    **({} if event.component is None else {"component": event.component}),
                },
                separators=COMPACT,
            )
            members, event.members = event.members, {}
            if callable(members):
                more = members()
            else:
                more = json.dumps(members, allow_nan=False, separators=COMPACT)[1:-1]
            event.text = f"{head[:-1]},{more}}}" if more else head
        return event.text

    def _after(self, seq: int, wanted: Wanted) -> tuple[Batch, bytes]:
        """What comes after a number, for somebody who wants this."""
        key = (seq, wanted)
        found = self._shared.get(key)
        if found is not None:
            return found
        oldest = self.seq - len(self._events)
        if seq < oldest:  # what is left would be no use without what is lost
            batch = Batch(Place(self.run, self._told), self._told - seq, ())
        else:
            end = min(self._told, seq + MOST_AT_ONCE)
            chosen = islice(self._events, seq - oldest, end - oldest)
            texts = tuple((event.seq, self.text_of(event)) for event in chosen if wanted.has(event))
            batch = Batch(Place(self.run, end), 0, texts)
        if len(self._shared) >= MOST_SHARED:
            del self._shared[next(iter(self._shared))]
        made = self._shared[key] = (batch, batch.as_event_stream)
        return made

    def _wake(self) -> None:
        self._told = self.seq
        self._shared.clear()
        woken, self._woken = self._woken, anyio.Event()
        woken.set()


class Listener:
    """A place in the list that moves on; for one task, as a context manager.

    Attributes:
        place: where it stands.
        is_resumed: whether it goes on from where it was asked to.
    """

    def __init__(self, feed: Feed, seq: int, wanted: Wanted, *, is_resumed: bool) -> None:
        self.place = Place(feed.run, seq)
        self.is_resumed = is_resumed
        self._feed = feed
        self._wanted = wanted

    def __enter__(self) -> Listener:
        self._feed.listeners += 1
        return self

    def __exit__(self, *_: object) -> None:
        self._feed.listeners -= 1

    def hello(self) -> str:
        """The first event of every connection, as JSON."""
        return self._own("hello", resumed=self.is_resumed)

    def gap(self, missed: int) -> str:
        """That events were lost, as JSON."""
        return self._own("gap", missed=missed)

    async def next(self, within: float) -> tuple[Batch, bytes] | None:
        """What has come since, also as server-sent events; None for nothing within these seconds.

        There may be nothing in it that is wanted: then the place alone has moved.

        Raises:
            EOFError: nothing more will come.
        """
        feed = self._feed
        if feed._told <= self.place.seq and not feed.is_over:
            with anyio.move_on_after(within):
                await feed._woken.wait()
        if feed._told <= self.place.seq:
            if feed.is_over:
                raise EOFError
            return None
        await anyio.lowlevel.checkpoint()  # a listener that comes back may have thousands of events to take
        batch, stream = feed._after(self.place.seq, self._wanted)
        self.place = batch.place
        return batch, stream

    def _own(self, kind: str, **members: Any) -> str:
        """An event for this listener alone; its number is that of its place."""
        at = round(self._feed._clock(), 3)
        told = {"run": self.place.run, "seq": self.place.seq, "at": at, "type": kind, **members}
        return json.dumps(told, separators=COMPACT)
