"""One component on one link: its published state and the JSON of its parameters."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Protocol

import anyio

from paramclient.client.component import Component
from paramclient.client.streams import Changes
from paramclient.documents.component import ComponentDoc, ProgressDoc
from paramclient.documents.param import ParamDoc
from paramclient.errors import NoReply, ParamClientError
from paramclient.model.params import CACHED, as_params, compact_param, trust_of
from paramclient.model.values import Param, Trust
from paramclient.protocol.events import Change
from paramclient.service.event_feed import change_members
from paramclient.service.followed_extended import FollowedExtended

if TYPE_CHECKING:
    from paramclient.metadata import Metadata
    from paramclient.model.identity import Identity
    from paramclient.service.event_feed import EventFeed

__all__ = ["FollowedComponent", "FollowedLink", "param_json"]

SINGLE_CHANGES_MAX: Final = 32
"""Maximum number of parameters that get an event each if only their trust has changed. More parameters cause
one event together."""


class FollowedLink(Protocol):
    """The link of a component, as the component uses it.

    Attributes:
        name: name of the link.
        state: state of the link.
        followed: components on the link, by system and component id.
    """

    name: str
    state: str
    followed: dict[tuple[int, int], FollowedComponent]

    def forget(self, followed: FollowedComponent) -> None:
        """Remove a component."""


class FollowedComponent:
    """A component, from its first message until its client is closed or has removed it.

    Attributes:
        component: the component of the library.
        link: its link.
        metadata: descriptions of its parameters, or None; see `describe`.
        extended: its extended parameters.
    """

    def __init__(self, component: Component, link: FollowedLink, feed: EventFeed) -> None:
        self.component = component
        self.link = link
        self.metadata: Metadata | None = None
        self._described_firmware: tuple[object, ...] | None = None
        self._feed = feed
        self._published = as_params(component.params).copy()
        self._received_at: dict[str, float] = {}
        self._texts: dict[str, str] = {}
        self._published_state: tuple[object, ...] | None = None
        self._is_fetching = False
        self._last_fetch: object = None
        self._forwarder = _ChangeForwarder(self)
        self.component.core.listen(self._forwarder)
        self.extended = FollowedExtended(self.component, self.publish)

    def __repr__(self) -> str:
        return f"<FollowedComponent {self.component!r} on {self.link.name}>"

    @property
    def address(self) -> tuple[int, int]:
        """Return system and component id."""
        return self.component.system, self.component.component

    @property
    def key(self) -> str | None:
        """Return the key of its table in the cache; None before the vehicle is identified."""
        identity = self.component.core.settled_identity
        return None if identity is None else identity.key

    @property
    def document(self) -> ComponentDoc:
        """Return its current state."""
        machine = self.component.core.machine
        fetch = machine.fetch
        return ComponentDoc.of(
            self.component,
            link=self.link.name,
            link_state=self.link.state,
            key=self.key,
            progress=None if fetch is None else fetch.progress(anyio.current_time()),
            last=machine.fetches.last,
        )

    def describe(self, metadata: Metadata, identity: Identity | None = None) -> None:
        """Take descriptions of the parameters, and publish that the parameters have them.

        Args:
            metadata: the descriptions. They are removed when the firmware is another one.
            identity: the identity whose firmware they belong to; None for the present one.
        """
        self._described_firmware = _firmware_of(self.component.identity if identity is None else identity)
        if self.metadata is None or metadata.params != self.metadata.params:
            self._set_metadata(metadata)

    def _forget_other_firmware(self) -> None:
        """Remove descriptions of the firmware that the vehicle had before."""
        if self.metadata is None:
            return
        firmware, described = _firmware_of(self.component.identity), self._described_firmware
        if described is None:
            self._described_firmware = firmware
        elif firmware not in (None, described):
            self._set_metadata(None)

    def _set_metadata(self, metadata: Metadata | None) -> None:
        self.metadata = metadata
        self._texts.clear()
        self.publish("params", {"count": len(self.component.params)})

    def described_default(self, name: str) -> int | float | None:
        """Return the default of a parameter in the descriptions, or None; see `default_of`."""
        info = None if self.metadata is None else self.metadata.get(name)
        return None if info is None else info.default

    def json_of(self, param: Param) -> str:
        """Return a parameter as JSON. The JSON of an unchanged value of the table is encoded once."""
        name = param.name
        if not self._is_published(param):
            self._publish_value_changes()
            if not self._is_published(param):  # the table has a newer value than this response
                return self._encode(param, self._received_at.get(name))
        text = self._texts.get(name)
        if text is None:
            text = self._texts[name] = self._encode(param, self._received_at.get(name))
        return text

    def _encode(self, param: Param, received_at: float | None) -> str:
        return param_json(param, received_at, self.described_default(param.name))

    def _is_published(self, param: Param) -> bool:
        published, name = self._published, param.name
        return (
            published.compact.get(name) == compact_param(param)
            and published.defaults.get(name) == param.default
        )

    def object_of(self, params: Iterable[Param]) -> str:
        """Return parameters as one JSON object, by name."""
        return "{" + ",".join([f"{json.dumps(each.name)}:{self.json_of(each)}" for each in params]) + "}"

    def received_at(self, name: str) -> float | None:
        """Return when the vehicle last sent or confirmed a value, in unix seconds, or None."""
        return self._received_at.get(name)

    def record_received(self, name: str) -> None:
        """Record that the vehicle has sent this value now."""
        self._received_at[name] = _now()
        self._texts.pop(name, None)

    def add_cached_times(self, received_at: Iterable[tuple[str, float]]) -> None:
        """Add cached times of values that the vehicle has not sent since."""
        for name, at in received_at:
            if self._received_at.setdefault(name, at) == at:
                self._texts.pop(name, None)

    def publish(self, kind: str, members: dict[str, Any] | Callable[[], str]) -> None:
        """Publish an event of this component."""
        system, component = self.address
        self._feed.publish(kind, members, link=self.link.name, system=system, component=component)

    def publish_state(self, why: str, **more: Any) -> None:
        """Publish its state, with the reason of the event."""
        self._published_state = self._state_key()
        self.publish("component", {"component_doc": self.document.as_json(), "why": why, **more})

    def publish_changes(self) -> None:
        """Publish changes that caused no event yet, so that a response follows the events of its changes."""
        self._publish_value_changes()
        self.extended.publish_changes()
        self.publish_state_changes()

    def publish_state_changes(self) -> None:
        """Publish changes of its state, and the progress of a fetch."""
        self._forget_other_firmware()
        machine = self.component.core.machine
        fetch = machine.fetch
        if fetch is not None:
            self._is_fetching = True
            progress = ProgressDoc.of(fetch.progress(anyio.current_time()))
            self.publish("progress", progress.as_json())
        elif self._is_fetching:
            self._is_fetching = False
            known, count = len(self.component.params), self.component.count
            ended = ProgressDoc(received=known, total=count, rate=0.0, seconds_left=0.0)
            self.publish("progress", {**ended.as_json(), "done": True})
        self.extended.publish_progress()
        state_key = self._state_key()
        if state_key != self._published_state:
            why = (
                "state"
                if self._published_state is None or self._published_state[0] == state_key[0]
                else "identified"
            )
            self.publish_state(why)

    def close(self) -> None:
        """Stop following the component."""
        self.component.core.changes.discard(self._forwarder)
        self.extended.close()

    def handle_change(self, change: Change) -> None:
        """Handle a change of a value."""
        name, old, new, by = change.name, change.old, change.new, change.by
        if new is None:
            self._published.pop(name, None)
            self._received_at.pop(name, None)
        else:
            self._published[name] = new
            if new.trust is not Trust.CACHED:
                self._received_at[name] = _now()
        self._texts.pop(name, None)
        self._publish_change(old, new, by, is_added=isinstance(change, Added))

    def handle_end(self, error: ParamClientError | None) -> None:
        """Handle the end of its events: it was removed, or its client is closed."""
        if isinstance(error, NoReply):
            self.link.forget(self)

    def _publish_value_changes(self) -> None:
        """Publish parameters whose trust, default or index differs from the published one."""
        params, published = as_params(self.component.params), self._published
        last = self.component.core.machine.fetches.last
        if last is not self._last_fetch:
            self._last_fetch = last
            self._record_all_received()
        names = [name for name, compact in params.compact.items() if published.compact.get(name) != compact]
        if params.defaults != published.defaults:
            current, known = params.defaults, published.defaults
            names += [name for name in current.keys() | known.keys() if current.get(name) != known.get(name)]
        differing = [params[name] for name in dict.fromkeys(names) if name in params]
        if not differing:
            return
        now = _now()
        for param in differing:
            self._texts.pop(param.name, None)
            before = published.get(param.name)
            if param.trust is not Trust.CACHED and (before is None or before.trust is not param.trust):
                self._received_at[param.name] = now
        if len(differing) <= SINGLE_CHANGES_MAX:
            for param in differing:
                before, published[param.name] = published.get(param.name), param
                self._publish_change(before, param, "vehicle")
        else:
            published.update((param.name, param) for param in differing)
            self.publish("params", {"count": len(params)})

    def _record_all_received(self) -> None:
        """Record that the vehicle has sent or confirmed all trusted values now."""
        compact = as_params(self.component.params).compact
        trusted = (name for name, each in compact.items() if trust_of(each) != CACHED)
        self._received_at.update(dict.fromkeys(trusted, _now()))
        self._texts.clear()

    def _publish_change(
        self, old: Param | None, new: Param | None, by: str, *, is_added: bool = False
    ) -> None:
        kind = "removed" if new is None else "added" if is_added else "changed"
        known = new or old
        assert known is not None, "a change has an old or a new value"
        received_at = None if new is None else self._received_at.get(known.name)
        self.publish("change", partial(self._change_json, known.name, old, new, received_at, by, kind))

    def _change_json(
        self, name: str, old: Param | None, new: Param | None, received_at: float | None, by: str, kind: str
    ) -> str:
        """Return the members of a change as JSON without the braces."""
        before = None if old is None else self._encode(old, None)
        after = None if new is None else self._encode(new, received_at)
        return change_members(name, before, after, by, kind)

    def _state_key(self) -> tuple[object, ...]:
        """Return the state whose changes are published; the identity is the first item."""
        component = self.component
        ext = component.ext
        return (
            (self.key, component.identity),
            component.autopilot,
            component.encoding,
            component.count,
            component.hash,
            component.state,
            component.sync_state,
            component.is_armed,
            component.core.machine.fetches.last,
            self.link.state,
            (ext.is_spoken, ext.is_expected, ext.is_complete, ext.count),
        )


class _ChangeForwarder(Changes):
    """Forwards changes immediately and in order, in place of queueing them for a task."""

    def __init__(self, owner: FollowedComponent) -> None:
        super().__init__()
        self._owner = owner

    def push(self, item: Change) -> None:
        self._owner.handle_change(item)

    def end(self, error: ParamClientError | None) -> None:
        self._owner.handle_end(error)


def param_json(param: Param, received_at: float | None, described: int | float | None = None) -> str:
    """Return a parameter as JSON, with its default; see `default_of`."""
    return ParamDoc.kept(param, heard_at=received_at, described=described).model_dump_json()


def _firmware_of(identity: Identity) -> tuple[object, ...] | None:
    """Return the members of an identity that identify the firmware; None while they are unknown."""
    if not identity.firmware and not identity.git_hash:
        return None
    return identity.autopilot, identity.vehicle_type, identity.firmware, identity.git_hash, identity.board


def _now() -> float:
    return round(time.time(), 3)
