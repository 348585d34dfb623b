"""What a service has told of one component: its state, its table, and who listens to it."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import replace
from types import NoneType
from typing import Final, TypeAlias

import anyio

from paramclient.client.component import Component
from paramclient.client.events import Event, Found, Heard, Lost
from paramclient.client.subscription import Changes
from paramclient.errors import NoReply, ParamClientError
from paramclient.model.values import Encoding
from paramclient.protocol.params.change import Change
from paramclient.protocol.params.fetch_result import Progress
from paramclient.protocol.params.sync import SyncState
from paramclient.protocol.wire import MAV_TYPE_GCS
from paramclient.remote.decoding import Document, check_kind, hash_of, identity_of, param_of, progress_of
from paramclient.remote.mirror import Mirror

__all__ = ["Key", "MirroredComponent", "key_of"]

Key: TypeAlias = tuple[str, int, int]
"""The name of a link of the service, and an address on it."""
NO_AUTOPILOT: Final = ("unknown", "no autopilot")


class MirroredComponent:
    """What a service has told of one component, kept in step with its events.

    Args:
        document: how it stood.
        seq: the number of the event after which that was.
        make: makes the component of users for it.
        publish: hands an event to those who listen to the client.

    Attributes:
        key: the name of its link on the service, its system id and its component id.
        component: what users see of it.
        document: how it stood when the service said so last.
        told_at: when that was, by the clock of the event loop.
        identity: the identity in the document.
        mirror: its table.
        is_gone: whether the service does not know it now.
        seq: the number of the event after which the document was; -1 before any.
        progress_count: how often the progress of a fetch was told.
    """

    def __init__(
        self,
        document: Document,
        seq: int,
        make: Callable[[MirroredComponent], Component],
        publish: Callable[[Event], None],
    ) -> None:
        self.key = key_of(document)
        self.mirror = Mirror()
        self.is_gone = False
        self.progress_count = 0
        self.seq = seq
        self._publish_event = publish
        self._progress = NOTHING_YET
        self._subscriptions: weakref.WeakSet[Changes] = weakref.WeakSet()
        self._held: list[Event] = []
        self._is_announced = False
        self._read(document)
        self.component = make(self)

    @property
    def link_name(self) -> str:
        """The name of its link on the service."""
        return self.key[0]

    @property
    def path(self) -> str:
        """The path of its resource on the service."""
        return f"/components/{self.key[1]}/{self.key[2]}"

    @property
    def is_autopilot(self) -> bool:
        """Whether its heartbeat names an autopilot."""
        return self.document["autopilot"] not in NO_AUTOPILOT and self.identity.vehicle_type != MAV_TYPE_GCS

    @property
    def state(self) -> str:
        """The state of its table, as far as the service has said."""
        return "lost" if self.is_gone else str(self.document["state"])

    @property
    def silence(self) -> float:
        """Seconds since the service has heard it last, as far as the service has said."""
        return float(self.document["silence_s"]) + anyio.current_time() - self.told_at

    def listen(self, changes: Changes) -> None:
        """Push all further changes to this stream while it is referenced."""
        self._subscriptions.add(changes)

    def progress_since(self, count: int) -> Progress:
        """How far the fetch is that was told of after so many times."""
        return self._progress if self.progress_count > count else NOTHING_YET

    def take_document(self, document: Document, seq: int) -> None:
        """How it stood when this event had happened."""
        if seq >= self.seq:
            self.seq = seq
            self._read(document)

    def take_change(self, event: Document, asker: str) -> None:
        """A change of a parameter; `asker` is who we are for the service."""
        old, new, by = event["old"], event["new"], str(event["by"])
        change = Change(
            str(event["name"]),
            None if old is None else param_of(old, event["name"]),
            None if new is None else param_of(new, event["name"]),
            "us" if asker and by == f"us for {asker}" else by,
        )
        if (made := self.mirror.take(event["seq"], change)) is not None:
            self._publish(made)

    def take_progress(self, event: Document) -> None:
        """How far a fetch is."""
        told = progress_of(event)
        if event.get("done"):  # it has no pace any more
            told = replace(told, rate=self._progress.rate)
        self._progress = told
        self.progress_count += 1

    def end_progress(self, received: int, count: int) -> None:
        """A fetch has ended, of which nobody may have told: it was a short one."""
        self._progress = Progress(received, count, self._progress.rate, 0.0)
        self.progress_count += 1

    def announce(self, event: Event) -> None:
        """Tell those who listen, as soon as the table is what the event says."""
        self._held.append(event)
        if self.mirror.is_loaded:
            self.table_was_loaded([])

    def announce_first(self) -> None:
        """Tell those who listen that it is there; once."""
        if not self._is_announced:
            self._is_announced = True
            self.announce(Heard(self.component))

    def table_was_loaded(self, changes: list[Change]) -> None:
        """Its table is the service's now, with these differences."""
        for change in changes:
            self._publish(change)
        held, self._held = self._held, []
        for event in held:
            self._publish_event(event)

    def leave(self) -> None:
        """The service does not know it."""
        self.mirror.doubt()
        if self.state != "lost":
            self._held.append(Lost(self.component, self.silence))
        self.table_was_loaded([])
        self.is_gone = True

    def come_back(self, document: Document, seq: int) -> None:
        """The service knows it, for the first time or again."""
        if self.is_gone:
            self.is_gone = False
            self.announce(Found(self.component, self.silence))
        self.seq = seq
        self._read(document)

    def forget(self) -> None:
        """It is not waited for any more."""
        _, system, component = self.key
        awaited = f"{system}/{component} (lost)"
        self.end(NoReply(awaited, attempts=0, waited=self.silence))

    def end(self, error: ParamClientError | None) -> None:
        """Nothing more will come: end all streams of changes with this error."""
        for changes in list(self._subscriptions):
            changes.end(error)

    def _publish(self, change: Change) -> None:
        for changes in list(self._subscriptions):
            changes.push(change)

    def _read(self, document: Document) -> None:
        _check(document)
        self.identity = identity_of(document["identity"])
        self.document = document
        self.told_at = anyio.current_time()


def _check(document: Document) -> None:
    """See that the members have their kinds that are read when somebody asks for them.

    Raises:
        KeyError, TypeError, ValueError: one has not.
    """
    for name in ("autopilot", "encoding_reason", "state"):
        check_kind(document[name], str)
    Encoding(document["encoding"])
    SyncState(document["sync_state"])
    hash_of(document["hash"])
    check_kind(document["count"], int, NoneType)
    check_kind(document["is_armed"], bool, NoneType)
    check_kind(document["silence_s"], int, float)
    check_kind(document["round_trip_s"], int, float, NoneType)
    last = document["last_fetch"]
    if last is not None:
        check_kind(last["source"], str)
        check_kind(last["elapsed_s"], int, float)


NOTHING_YET: Final = Progress(0, None, 0.0, None)


def key_of(document: Document) -> Key:
    """Return which component a document is about."""
    return str(document["link"]), int(document["system"]), int(document["component"])
