"""MirroredComponent: state, table and subscriptions of one component of a service."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterable
from dataclasses import replace
from types import NoneType
from typing import Final, TypeAlias

import anyio

from paramclient.client.component import Component
from paramclient.client.events import Discovered, Event, Found, Lost
from paramclient.client.extended_params import ExtChanges
from paramclient.client.subscription import Changes
from paramclient.errors import NoReply, ParamClientError
from paramclient.model.values import Encoding
from paramclient.protocol.ext.change import ExtChange
from paramclient.protocol.params.change import Change
from paramclient.protocol.params.fetch_result import Progress
from paramclient.protocol.params.sync import ComponentState, SyncState
from paramclient.protocol.wire import MAV_TYPE_GCS
from paramclient.remote.decoding import (
    Document,
    check_kind,
    ext_param_of,
    hash_of,
    identity_of,
    param_of,
    progress_of,
)
from paramclient.remote.mirror import ExtMirror, Mirror

__all__ = ["Key", "MirroredComponent", "key_of"]

Key: TypeAlias = tuple[str, int, int]
"""Name of a link of the service, system id and component id."""
NOT_AUTOPILOTS: Final = ("unknown", "no autopilot")
"""Names for `Component.autopilot` that are not autopilots."""


class MirroredComponent:
    """State and table of one component of a service, updated by its events.

    Args:
        document: its state.
        seq: number of the last event included in the document.
        make: creates its public component.
        publish: pushes an event to the event streams of the client.

    Attributes:
        key: name of its link on the service, system id and component id.
        component: its public component.
        document: its last received state.
        reported_at: time of the last received state, by the clock of the event loop.
        identity: the identity in the document.
        mirror: its table.
        ext_mirror: the table of its extended parameters.
        is_gone: whether the service does not know the component now.
        seq: number of the last event included in the document; -1 before any.
        progress, ext_progress: the progress of its fetches, plain and extended.
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
        self.ext_mirror = ExtMirror()
        self.is_gone = False
        self.progress = FetchProgress()
        self.ext_progress = FetchProgress()
        self.seq = seq
        self._publish_event = publish
        self._subscriptions: weakref.WeakSet[Changes] = weakref.WeakSet()
        self._ext_subscriptions: weakref.WeakSet[ExtChanges] = weakref.WeakSet()
        self._queued: list[Event] = []
        self._is_announced = False
        self._read(document)
        self.component = make(self)

    @property
    def link_name(self) -> str:
        """Name of its link on the service."""
        return self.key[0]

    @property
    def path(self) -> str:
        """Path of its resource on the service."""
        return f"/components/{self.key[1]}/{self.key[2]}"

    @property
    def is_autopilot(self) -> bool:
        """Whether its heartbeat names an autopilot."""
        return self.document["autopilot"] not in NOT_AUTOPILOTS and self.identity.vehicle_type != MAV_TYPE_GCS

    @property
    def state(self) -> ComponentState:
        """State of its table, as last reported by the service."""
        return ComponentState.LOST if self.is_gone else ComponentState(self.document["state"])

    @property
    def has_extended(self) -> bool:
        """Whether the service serves extended parameters: one of an earlier version does not."""
        return self.document.get("extended") is not None

    @property
    def is_loaded(self) -> bool:
        """Whether the copies of both tables match the service up to the last received event."""
        return self.mirror.is_loaded and (self.ext_mirror.is_loaded or not self.has_extended)

    @property
    def silence(self) -> float:
        """Seconds since its last message to the service, by the last report of the service."""
        return float(self.document["silence_s"]) + anyio.current_time() - self.reported_at

    def listen(self, changes: Changes) -> None:
        """Push all further changes to this stream while it is referenced."""
        self._subscriptions.add(changes)

    def listen_ext(self, changes: ExtChanges) -> None:
        """Push all further changes of extended parameters to this stream while it is referenced."""
        self._ext_subscriptions.add(changes)

    def take_document(self, document: Document, seq: int) -> None:
        """Process its state after an event, unless a later one is known."""
        if seq >= self.seq:
            self.seq = seq
            self._read(document)

    def take_change(self, event: Document, author: str) -> None:
        """Process a change of a parameter.

        Args:
            event: the event.
            author: name of this client at the service, for changes by its own writes.
        """
        old, new, by = event["old"], event["new"], str(event["by"])
        change = Change.between(
            str(event["name"]),
            None if old is None else param_of(old, event["name"]),
            None if new is None else param_of(new, event["name"]),
            "us" if author and by == f"us for {author}" else by,
            is_added=event.get("kind") == "added",
        )
        if (made := self.mirror.take(event["seq"], change)) is not None:
            self.publish([made])

    def take_ext_change(self, event: Document, author: str) -> None:
        """Process a change of an extended parameter; the arguments are those of `take_change`."""
        old, new, by = event["old"], event["new"], str(event["by"])
        change = ExtChange(
            str(event["name"]),
            None if old is None else ext_param_of(old, event["name"]),
            None if new is None else ext_param_of(new, event["name"]),
            "us" if author and by == f"us for {author}" else by,
            event.get("kind") == "added",
        )
        if (made := self.ext_mirror.take(event["seq"], change)) is not None:
            self.publish_ext([made])

    def announce(self, event: Event) -> None:
        """Publish an event as soon as the table includes its effect."""
        self._queued.append(event)
        if self.is_loaded:
            self.tables_were_loaded()

    def announce_first(self) -> None:
        """Publish the event Discovered, once."""
        if not self._is_announced:
            self._is_announced = True
            self.announce(Discovered(self.component))

    def publish(self, changes: Iterable[Change]) -> None:
        """Push changes to all streams."""
        for change in changes:
            for stream in list(self._subscriptions):
                stream.push(change)

    def publish_ext(self, changes: Iterable[ExtChange]) -> None:
        """Push changes of extended parameters to all streams."""
        for change in changes:
            for stream in list(self._ext_subscriptions):
                stream.push(change)

    def tables_were_loaded(self) -> None:
        """Publish the events that have waited for the tables."""
        queued, self._queued = self._queued, []
        for event in queued:
            self._publish_event(event)

    def doubt(self) -> None:
        """Mark the copies of both tables as stale."""
        self.mirror.doubt()
        self.ext_mirror.doubt()

    def leave(self) -> None:
        """Mark the component as lost: the service no longer knows it."""
        self.doubt()
        if self.state != "lost":
            self._queued.append(Lost(self.component, self.silence))
        self.tables_were_loaded()
        self.is_gone = True

    def mark_found(self, document: Document, seq: int) -> None:
        """Mark the component as present: the service knows it, for the first time or again."""
        if self.is_gone:
            self.is_gone = False
            self.announce(Found(self.component, self.silence))
        self.seq = seq
        self._read(document)

    def forget(self) -> None:
        """End all streams of changes with NoReply: the component is no longer followed."""
        _, system, component = self.key
        awaited = f"{system}/{component} (lost)"
        self.end(NoReply(awaited, attempts=0, waited=self.silence))

    def end(self, error: ParamClientError | None) -> None:
        """End all streams of changes with this error."""
        for changes in list(self._subscriptions):
            changes.end(error)
        for ext_changes in list(self._ext_subscriptions):
            ext_changes.end(error)

    def _read(self, document: Document) -> None:
        _check(document)
        self.identity = identity_of(document["identity"])
        self.document = document
        self.reported_at = anyio.current_time()


def _check(document: Document) -> None:
    """Check the types of the members that are decoded later.

    Raises:
        KeyError, TypeError, ValueError: a member is missing or has a wrong type.
    """
    for name in ("autopilot", "encoding_reason"):
        check_kind(document[name], str)
    ComponentState(document["state"])
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
    extended = document.get("extended")
    if extended is not None:
        check_kind(extended["count"], int, NoneType)
        check_kind(extended["is_spoken"], bool)
        check_kind(extended["is_expected"], bool)


class FetchProgress:
    """The progress of the fetches of one table, as the service reports it.

    Attributes:
        count: number of received reports.
    """

    def __init__(self) -> None:
        self.count = 0
        self._last = NO_PROGRESS

    def since(self, count: int) -> Progress:
        """Return the last progress after this number of reports; no progress if there is none."""
        return self._last if self.count > count else NO_PROGRESS

    def take(self, event: Document) -> None:
        """Process a report."""
        progress = progress_of(event)
        if event.get("done"):  # a completed fetch has no rate
            progress = replace(progress, rate=self._last.rate)
        self._last = progress
        self.count += 1

    def end(self, received: int, count: int | None) -> None:
        """Record the end of a fetch. A short fetch may have had no report."""
        self._last = Progress(received, count, self._last.rate, 0.0)
        self.count += 1


NO_PROGRESS: Final = Progress(0, None, 0.0, None)
"""Progress of a fetch before the first report."""


def key_of(document: Document) -> Key:
    """Return the key of the component in a document."""
    return str(document["link"]), int(document["system"]), int(document["component"])
