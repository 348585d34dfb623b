"""The extended parameters of one component on one link: their events and their JSON."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from typing import Any, Final

import anyio

from paramclient.client.component import Component
from paramclient.client.streams import Changes
from paramclient.documents.component import ProgressDoc
from paramclient.documents.extended_param import ExtParamDoc
from paramclient.model.ext_params import ExtParam
from paramclient.protocol.events import Change
from paramclient.service.event_feed import change_members

__all__ = ["FollowedExtended", "ext_param_json"]

SINGLE_EXT_CHANGES_MAX: Final = 32
"""Maximum number of extended parameters that get an event each if only their trust or index has changed. More
parameters cause one event together."""


class FollowedExtended:
    """The extended parameters of a followed component.

    Args:
        component: the component.
        publish: publishes an event of the component: type and members.

    Attributes:
        ext: the extended parameters of the library.
    """

    def __init__(
        self,
        component: Component,
        publish: Callable[[str, dict[str, Any] | Callable[[], str]], None],
    ) -> None:
        self.ext = component.ext
        self._machine = component.core.machine.ext
        self._publish = publish
        self._published = dict(component.ext.params)
        self._published_revision = self._machine.table.revision
        self._received_at: dict[str, tuple[float, float]] = {}
        self._is_fetching = False
        self._forwarder = _ExtChangeForwarder(self)
        self._streams = component.core.ext_changes
        self._streams.add(self._forwarder)

    def received_at(self, name: str) -> float | None:
        """Return when the component last sent or confirmed a value, in unix seconds, or None."""
        moment = self._machine.table.moments.get(name, math.inf)
        if not math.isfinite(moment):
            self._received_at.pop(name, None)
            return None
        known = self._received_at.get(name)
        if known is None or known[0] != moment:
            at = round(time.time() - anyio.current_time() + moment, 3)
            known = self._received_at[name] = (moment, at)
        return known[1]

    def json_of(self, param: ExtParam) -> str:
        """Return a parameter as JSON."""
        return ext_param_json(param, self.received_at(param.name))

    def member_of(self, param: ExtParam) -> str:
        """Return a parameter as a member of a JSON object, by its name."""
        return f"{json.dumps(param.name)}:{self.json_of(param)}"

    def publish_changes(self) -> None:
        """Publish parameters whose trust or index differs from the published one."""
        revision = self._machine.table.revision
        if revision == self._published_revision:  # many requests may end at once
            return
        self._published_revision = revision
        params, published = self.ext.params, self._published
        differing = []
        for name, param in params.items():
            before = published.get(name)
            if before is param:
                continue
            if before == param:
                published[name] = param  # a list brings equal ones, which need no second comparison
            else:
                differing.append(param)
        if len(differing) <= SINGLE_EXT_CHANGES_MAX:
            for param in differing:
                before, published[param.name] = published.get(param.name), param
                self._publish_change(before, param, "vehicle", "changed")
        else:
            published.update((param.name, param) for param in differing)
            self._publish("extended_params", {"count": len(params)})

    def publish_progress(self) -> None:
        """Publish the progress of a fetch, or its end."""
        fetches = self._machine.fetches
        fetch = fetches.current
        if fetch is not None:
            self._is_fetching = True
            progress = ProgressDoc.of(fetches.progress(fetch, anyio.current_time()))
            self._publish("extended_progress", progress.as_json())
        elif self._is_fetching:
            self._is_fetching = False
            known, count = len(self.ext.params), self.ext.count
            ended = ProgressDoc(received=known, total=count, rate=0.0, seconds_left=0.0)
            self._publish("extended_progress", {**ended.as_json(), "done": True})

    def close(self) -> None:
        """Stop following."""
        self._streams.discard(self._forwarder)

    def handle_change(self, change: Change) -> None:
        """Handle a change of a value."""
        if change.new is None:
            self._published.pop(change.name, None)
            self._received_at.pop(change.name, None)
            kind = "removed"
        else:
            self._published[change.name] = change.new
            kind = "added" if change.is_added else "changed"
        self._publish_change(change.old, change.new, change.by, kind)

    def _publish_change(self, old: ExtParam | None, new: ExtParam | None, by: str, kind: str) -> None:
        known = new or old
        assert known is not None, "a change has an old or a new value"
        name = known.name
        received_at = None if new is None else self.received_at(name)

        def write() -> str:
            before = None if old is None else ext_param_json(old, None)
            after = None if new is None else ext_param_json(new, received_at)
            return change_members(name, before, after, by, kind)

        self._publish("extended_change", write)


class _ExtChangeForwarder(Changes):
    """Forwards changes immediately and in order, in place of queueing them for a task."""

    def __init__(self, owner: FollowedExtended) -> None:
        super().__init__()
        self._owner = owner

    def push(self, item: Change) -> None:
        self._owner.handle_change(item)


def ext_param_json(param: ExtParam, received_at: float | None) -> str:
    """Return an extended parameter as JSON."""
    return ExtParamDoc.kept(param, heard_at=received_at).model_dump_json()
