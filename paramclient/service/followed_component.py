"""One component on one link: what of it has been told, and its parameters written out."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, Final, Protocol

import anyio

from paramclient.client.component import Component
from paramclient.client.local import local
from paramclient.client.subscription import Changes
from paramclient.documents.component import ComponentDoc, ProgressDoc
from paramclient.documents.param import ParamDoc
from paramclient.errors import NoReply, ParamClientError
from paramclient.model.params import as_params, held_of
from paramclient.model.values import Param, Trust
from paramclient.protocol.params.change import Change

if TYPE_CHECKING:
    from paramclient.metadata import Metadata
    from paramclient.service.event_feed import Feed

__all__ = ["Followed", "FollowedLink"]

MOST_TOLD_SINGLY: Final = 32
"""Parameters whose trust alone has moved, of which each is told; of more it is told that they have."""


class FollowedLink(Protocol):
    """What a component needs of the link that it is on.

    Attributes:
        name: the name of the link on the service.
        state: the state of the link, in a word.
        followed: the components on the link, by system and component id.
    """

    name: str
    state: str
    followed: dict[tuple[int, int], Followed]

    def forget(self, followed: Followed) -> None:
        """Follow a component no longer."""


class Followed:
    """A component, from when it is heard until its client is closed or has forgotten it.

    Attributes:
        component: the library's.
        line: the link that it is on.
        metadata: what its firmware says of its parameters, as far as that is here.
    """

    def __init__(self, component: Component, line: FollowedLink, feed: Feed) -> None:
        self.component = local(component)
        self.line = line
        self.metadata: Metadata | None = None
        self._feed = feed
        self._shown = as_params(component.params).copy()
        self._heard_at: dict[str, float] = {}
        self._texts: dict[str, str] = {}
        self._told: tuple[object, ...] | None = None
        self._is_fetching = False
        self._last_fetch: object = None
        self._sink = _Sink(self)
        self.component.listen(self._sink)

    def __repr__(self) -> str:
        return f"<Followed {self.component!r} on {self.line.name}>"

    @property
    def address(self) -> tuple[int, int]:
        """System and component id."""
        return self.component.system, self.component.component

    @property
    def key(self) -> str | None:
        """The key under which its table is kept; None while it is open who the vehicle is."""
        identity = self.component.settled_identity
        return None if identity is None else identity.key

    @property
    def document(self) -> ComponentDoc:
        """How it stands now."""
        machine = self.component.machine
        fetch = machine.fetch
        return ComponentDoc.of(
            self.component,
            link=self.line.name,
            link_state=self.line.state,
            key=self.key,
            progress=None if fetch is None else fetch.progress(anyio.current_time()),
            last=machine.fetches.last,
        )

    def text_of(self, param: Param) -> str:
        """A parameter as JSON; that of a value of its table that has not moved is made once."""
        name = param.name
        if not self._is_shown(param):
            self._look_at_values()
            if not self._is_shown(param):  # an answer that is overtaken: the table has another value by now
                return _text(param, self._heard_at.get(name))
        text = self._texts.get(name)
        if text is None:
            text = self._texts[name] = _text(param, self._heard_at.get(name))
        return text

    def _is_shown(self, param: Param) -> bool:
        shown, name = self._shown, param.name
        return shown.held.get(name) == held_of(param) and shown.defaults.get(name) == param.default

    def texts(self, params: Iterable[Param]) -> str:
        """Parameters as one JSON object, by name."""
        return "{" + ",".join([f"{json.dumps(each.name)}:{self.text_of(each)}" for each in params]) + "}"

    def heard_at(self, name: str) -> float | None:
        """When the vehicle last gave or confirmed a value, in unix seconds, as far as is known."""
        return self._heard_at.get(name)

    def was_heard(self, name: str) -> None:
        """The vehicle has given this value at this moment."""
        self._heard_at[name] = _now()
        self._texts.pop(name, None)

    def know_ages(self, heard_at: Iterable[tuple[str, float]]) -> None:
        """Take from the cache when values were heard that have not been heard since."""
        for name, at in heard_at:
            if self._heard_at.setdefault(name, at) == at:
                self._texts.pop(name, None)

    def tell(self, kind: str, members: dict[str, Any] | Callable[[], str]) -> None:
        """Publish an event of this component."""
        system, component = self.address
        self._feed.publish(kind, members, link=self.line.name, system=system, component=component)

    def tell_of_it(self, why: str, **more: Any) -> None:
        """Publish how it stands now, and why that is told."""
        self._told = self._standing()
        self.tell("component", {"component_doc": self.document.as_json(), "why": why, **more})

    def look(self) -> None:
        """Publish what has moved without anybody telling: everything that a call has done is told then."""
        self._look_at_values()
        self.look_at_state()

    def look_at_state(self) -> None:
        """The same of its state, and of a fetch under way."""
        machine = self.component.machine
        fetch = machine.fetch
        if fetch is not None:
            self._is_fetching = True
            progress = ProgressDoc.of(fetch.progress(anyio.current_time()))
            self.tell("progress", progress.as_json())
        elif self._is_fetching:
            self._is_fetching = False
            known, count = len(self.component.params), self.component.count
            ended = ProgressDoc(received=known, total=count, rate=0.0, seconds_left=0.0)
            self.tell("progress", {**ended.as_json(), "done": True})
        standing = self._standing()
        if standing != self._told:
            why = "state" if self._told is None or self._told[0] == standing[0] else "identified"
            self.tell_of_it(why)

    def close(self) -> None:
        """Hear no more of it."""
        self.component.ignore(self._sink)

    def changed(self, change: Change) -> None:
        """A value has changed."""
        name, old, new, by = change.name, change.old, change.new, change.by
        if new is None:
            self._shown.pop(name, None)
            self._heard_at.pop(name, None)
        else:
            self._shown[name] = new
            if new.trust is not Trust.CACHED:
                self._heard_at[name] = _now()
        self._texts.pop(name, None)
        self._tell_change(old, new, by)

    def ended(self, error: ParamClientError | None) -> None:
        """Nothing more will come of it: it was forgotten, or its client has ended."""
        if isinstance(error, NoReply):
            self.line.forget(self)

    def _look_at_values(self) -> None:
        """See which parameters are others than were told: their trust, default or index has moved."""
        params, shown = as_params(self.component.params), self._shown
        last = self.component.machine.fetches.last
        if last is not self._last_fetch:
            self._last_fetch = last
            self._was_fetched()
        names = [name for name, held in params.held.items() if shown.held.get(name) != held]
        if params.defaults != shown.defaults:
            given, told = params.defaults, shown.defaults
            names += [name for name in given.keys() | told.keys() if given.get(name) != told.get(name)]
        moved = [params[name] for name in dict.fromkeys(names) if name in params]
        if not moved:
            return
        now = _now()
        for param in moved:
            self._texts.pop(param.name, None)
            before = shown.get(param.name)
            if param.trust is not Trust.CACHED and (before is None or before.trust is not param.trust):
                self._heard_at[param.name] = now
        if len(moved) <= MOST_TOLD_SINGLY:
            for param in moved:
                before, shown[param.name] = shown.get(param.name), param
                self._tell_change(before, param, "vehicle")
        else:
            shown.update((param.name, param) for param in moved)
            self.tell("params", {"count": len(params)})

    def _was_fetched(self) -> None:
        """Everything that is trusted was given or confirmed just now, changed or not."""
        now = _now()
        for name, param in self.component.params.items():
            if param.trust is not Trust.CACHED:
                self._heard_at[name] = now
        self._texts.clear()

    def _tell_change(self, old: Param | None, new: Param | None, by: str) -> None:
        heard_at = None if new is None else self._heard_at.get(new.name)

        def write() -> str:
            before = "null" if old is None else _text(old, None)
            after = "null" if new is None else _text(new, heard_at)
            return f'"name":{json.dumps(name)},"old":{before},"new":{after},"by":{json.dumps(by)}'

        known = new or old
        assert known is not None, "something has changed"
        name = known.name
        self.tell("change", write)

    def _standing(self) -> tuple[object, ...]:
        """What of its state is worth an event when it moves; who it is comes first."""
        component = self.component
        return (
            (self.key, component.identity),
            component.autopilot,
            component.encoding,
            component.count,
            component.hash,
            component.state,
            component.sync_state,
            component.is_armed,
            component.machine.fetches.last,
            self.line.state,
        )


class _Sink(Changes):
    """Hands changes on at once, in the order in which they happen, in place of keeping them for a task."""

    def __init__(self, owner: Followed) -> None:
        super().__init__()
        self._owner = owner

    def push(self, item: Change) -> None:
        self._owner.changed(item)

    def end(self, error: ParamClientError | None) -> None:
        self._owner.ended(error)


def _text(param: Param, heard_at: float | None) -> str:
    return ParamDoc.kept(param, heard_at=heard_at).model_dump_json()


def _now() -> float:
    return round(time.time(), 3)
