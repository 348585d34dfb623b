"""A component whose link is that of a service."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from types import NoneType
from typing import TYPE_CHECKING, Any, Final, NoReturn, SupportsFloat, SupportsIndex, TypeAlias

import anyio

from paramclient.client.arguments import check_accepted, check_asked, check_asked_name, check_settle
from paramclient.client.component import Component
from paramclient.client.events import Changes, Event, Found, Heard, Lost
from paramclient.errors import NoReply, ParamClientError
from paramclient.model.identity import Identity
from paramclient.model.params import ParamMap
from paramclient.model.values import Encoding, Param, check_value
from paramclient.protocol.addresses import Address
from paramclient.protocol.params.change import Change
from paramclient.protocol.params.fetch_result import FetchResult, Progress
from paramclient.protocol.params.sampling import SAMPLE_SIZE
from paramclient.protocol.params.sync import SyncState
from paramclient.protocol.params.writes import SetResult
from paramclient.protocol.vehicle.peers import Contest
from paramclient.protocol.wire import MAV_TYPE_GCS, MOST_PARAMETERS, SigningKey
from paramclient.remote.connection import telling
from paramclient.remote.decoding import (
    Document,
    check_kind,
    fetch_result_of,
    hash_of,
    identity_of,
    param_of,
    progress_of,
    set_result_of,
    understood,
    value_as_sent,
)
from paramclient.remote.http import Answer
from paramclient.remote.link import not_given
from paramclient.remote.mirror import Mirror
from paramclient.remote.problems import NotHeard, error_of

if TYPE_CHECKING:
    from paramclient.remote.client import RemoteClient

__all__ = ["Key", "RemoteComponent"]

Key: TypeAlias = tuple[str, int, int]
"""The name of a link of the service, and an address on it."""

OF_A_LINK: Final = frozenset({"_machine", "_wait", "_wait_for_cache", "_cache_is_due", "_heard_at"})
"""What other rooms of the package reach for that only a component on an own link has."""
HEARING_PATIENCE: Final = 2.5
"""Seconds for a component to be heard by a service that has started again: it sends a heartbeat a second."""
NO_AUTOPILOT: Final = ("unknown", "no autopilot")


class RemoteComponent(Component):
    """The same as `Component` over a service; see `RemoteClient` for what is different.

    Attributes:
        link_name: the name of its link on the service.
    """

    def __init__(self, client: RemoteClient, document: Document, seq: int) -> None:
        self._client: RemoteClient = client
        self.system = int(document["system"])
        self.component = int(document["component"])
        self.link_name = str(document["link"])
        self._key: Key = (self.link_name, self.system, self.component)
        self._path = f"/components/{self.system}/{self.component}"
        self._mirror = Mirror()
        self.params = ParamMap(self._mirror.params)
        self._progress_count = 0
        self._progress = NOTHING_YET
        self._subscriptions: weakref.WeakSet[Changes] = weakref.WeakSet()
        self._held: list[Event] = []
        self._is_announced = False
        self._is_gone = False
        self._seq = seq
        self._read(document)

    # how it stands

    @property
    def autopilot(self) -> str:
        """See `Component.autopilot`."""
        return str(self._document["autopilot"])

    @property
    def is_autopilot(self) -> bool:
        """Whether its heartbeat names an autopilot."""
        return self.autopilot not in NO_AUTOPILOT and self.identity.vehicle_type != MAV_TYPE_GCS

    @property
    def identity(self) -> Identity:
        """See `Component.identity`. Its `link` is the service's."""
        return self._identity

    @property
    def encoding(self) -> Encoding:
        """See `Component.encoding`."""
        return Encoding(self._document["encoding"])

    @property
    def encoding_reason(self) -> str:
        """See `Component.encoding_reason`."""
        return str(self._document["encoding_reason"])

    @property
    def count(self) -> int | None:
        """See `Component.count`."""
        count: int | None = self._document["count"]
        return count

    @property
    def hash(self) -> int | None:
        """See `Component.hash`."""
        return hash_of(self._document["hash"])

    @property
    def state(self) -> str:
        """See `Component.state`. While the service cannot be reached, what is known is *cached*."""
        state = "lost" if self._is_gone else str(self._document["state"])
        if not self._client._connection.is_away or state in ("lost", "new"):
            return state
        return "cached"

    @property
    def sync_state(self) -> SyncState:
        """See `Component.sync_state`. While the service cannot be reached, a table is *unsynced*."""
        state = SyncState.LOST if self._is_gone else SyncState(self._document["sync_state"])
        return (
            SyncState.UNSYNCED if self._client._connection.is_away and state is not SyncState.LOST else state
        )

    @property
    def address(self) -> Address:
        """See `Component.address`."""
        return self.system, self.component

    @property
    def peer(self) -> str:
        """See `Component.peer`."""
        return str(self._document["peer"])

    @property
    def contest(self) -> Contest | None:
        """See `Component.contest`."""
        told: Document | None = self._document["contest"]
        if told is None:
            return None
        return Contest(self.system, self.component, tuple(told["claimants"]), str(told["difference"]))

    @property
    def is_armed(self) -> bool | None:
        """See `Component.is_armed`. None also while the service cannot be reached."""
        is_armed: bool | None = self._document["is_armed"]
        return None if self._client._connection.is_away or self._is_gone else is_armed

    @property
    def silence(self) -> float:
        """See `Component.silence`; as far as the service has said."""
        return float(self._document["silence_s"]) + anyio.current_time() - self._told_at

    @property
    def round_trip(self) -> float | None:
        """See `Component.round_trip`: between the service and the vehicle."""
        seconds: float | None = self._document["round_trip_s"]
        return seconds

    def __repr__(self) -> str:
        last = self._document["last_fetch"]
        origin = "" if last is None else f" from {last['source']} in {last['elapsed_s']:.2f} s"
        known = len(self.params)
        of = f" of {self.count}" if self.count is not None and self.state in ("partial", "fetching") else ""
        return (
            f"<RemoteComponent {self.system}/{self.component} {self.autopilot} {self.state} {known}{of} "
            f"params{origin}>"
        )

    def __getattr__(self, name: str) -> NoReturn:
        if name in OF_A_LINK:
            raise not_given("what this needs")
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    # calls

    async def get(self, name: str | int, *, timeout: float | None = None) -> Param:
        """See `Component.get`."""
        check_asked(name)
        body = {"name": name} if isinstance(name, str) else {"index": name}
        what = name if isinstance(name, str) else f"parameter {name}"
        answer = await self._ask("read", body, timeout, f"{what} of {self.system}/{self.component}")
        with understood(self._client.link.name):
            param = param_of(answer.document)
        self._mirror.confirm(param)
        return param

    async def set(
        self,
        name: str,
        value: SupportsIndex | SupportsFloat | bytes,
        *,
        timeout: float | None = None,
        settle: float = 0.0,
        force: bool = False,
        durable: bool = False,
        asker: str | None = None,
    ) -> SetResult:
        """See `Component.set`.

        The service puts writes to one name in order, whoever asks for them. Where its answer is lost, the
        write is not sent again: LinkError then says that it is not known whether it was done.
        """
        requested = check_value(value)
        body: dict[str, Any] = {"values": {check_asked_name(name): value_as_sent(requested)}}
        if check_settle(settle):
            body["settle_s"] = settle
        if force:
            body["force"] = True
        if durable:
            body["durable"] = True
        answer = await self._ask(
            "params",
            body,
            timeout,
            f"PARAM_SET {name} to {self.system}/{self.component}",
            method="PATCH",
            is_write=True,
        )
        with understood(self._client.link.name):
            (result,) = answer.document["results"].values()
            if (problem := result.get("problem")) is not None:
                raise error_of(problem, status=problem["status"], link=self._client.link.name)
            done = set_result_of(result, requested)
        self._mirror.confirm(done.param)
        return done

    async def fetch_all(
        self,
        *,
        refresh: bool = False,
        accept: str = "verified",
        sample: int = SAMPLE_SIZE,
        seed: int | None = None,
        timeout: float | None = None,
        progress: Callable[[Progress], None] | None = None,
    ) -> FetchResult:
        """See `Component.fetch_all`. Programs that fetch at the same time share one download."""
        began = anyio.current_time()
        before = self._progress_count
        check_accepted(accept, sample)
        body: dict[str, Any] = {"refresh": refresh, "accept": accept, "sample": min(sample, MOST_PARAMETERS)}
        if seed is not None:
            body["seed"] = seed

        def tell() -> None:
            assert progress is not None
            progress(self._progress_since(before))

        async def fetch() -> Answer:
            awaited = f"the parameters of {self.system}/{self.component}"
            answer = await self._ask("fetch", body, timeout, awaited)
            with understood(self._client.link.name):
                self._end_progress(answer.document["received"], answer.document["count"])
            return answer

        answer = await telling(fetch, None if progress is None else tell)
        with understood(self._client.link.name):
            return fetch_result_of(answer.document, self.params, anyio.current_time() - began)

    async def refreshed(self, *, timeout: float | None = None) -> None:
        """See `Component.refreshed`."""
        await self._ask("refreshed", {}, timeout, "the values that no hash covers")

    async def setup_signing(self, key: SigningKey | None, *, link_is_safe: bool = False) -> None:
        """Refused: a key goes over a link on which nobody else can listen."""
        raise not_given("the set-up of signing")

    async def reboot(self, *, system: int | None = None, timeout: float | None = None) -> Component:
        """See `Component.reboot`."""
        body = {} if system is None else {"system": system}
        awaited = f"the restart of {self.system}/{self.component}"
        return await self._client._roster.given(
            await self._ask("reboot", body, timeout, awaited, is_write=True)
        )

    def changes(self) -> Changes:
        """See `Component.changes`.

        `by` is "us" for what this program has set, and "us for NAME" for what the service has set for others.
        What has changed while the service could not be reached comes as changes too, and counts as the
        vehicle's.
        """
        changes = Changes()
        self._subscriptions.add(changes)
        if (ended := self._client._connection.ended) is not None:
            changes.end(ended)
        return changes

    # what the service tells

    async def _ask(
        self,
        what: str,
        body: Mapping[str, Any],
        timeout: float | None,
        awaited: str,
        *,
        method: str = "POST",
        is_write: bool = False,
        waits_for_ever: bool = False,
    ) -> Answer:
        """Ask the service for something about it; see `Connection.ask`. What it did is in the mirror then."""
        began = anyio.current_time()
        request = partial(
            self._client._connection.ask,
            method,
            f"{self._path}/{what}",
            body,
            awaited=awaited,
            waits_for_ever=waits_for_ever,
            link=self.link_name,
            is_write=is_write,
        )
        try:
            answer = await request(timeout=timeout)
        except NotHeard:
            left = None if timeout is None else began + timeout - anyio.current_time()
            await self._until_heard(min(HEARING_PATIENCE, HEARING_PATIENCE if left is None else left))
            left = None if timeout is None else began + timeout - anyio.current_time()
            answer = await request(timeout=left)
        await self._client._roster.until_current(self, answer.place)
        return answer

    async def _until_heard(self, patience: float) -> None:
        """Wait until the service knows it again."""
        body = {"system": self.system, "component": self.component}
        awaited = f"{self.system}/{self.component} (lost)"
        ask = self._client._connection.ask
        await ask("POST", "/find", body, awaited=awaited, timeout=patience, link=self.link_name)

    def _progress_since(self, count: int) -> Progress:
        """How far the fetch is that was told of after so many times."""
        return self._progress if self._progress_count > count else NOTHING_YET

    def _take_document(self, document: Document, seq: int) -> None:
        """How it stood when this event had happened."""
        if seq >= self._seq:
            self._seq = seq
            self._read(document)

    def _take_change(self, event: Document, asker: str) -> None:
        """A change of a parameter; `asker` is who we are for the service."""
        old, new, by = event["old"], event["new"], str(event["by"])
        change = Change(
            str(event["name"]),
            None if old is None else param_of(old, event["name"]),
            None if new is None else param_of(new, event["name"]),
            "us" if asker and by == f"us for {asker}" else by,
        )
        if (made := self._mirror.take(event["seq"], change)) is not None:
            self._publish(made)

    def _take_progress(self, event: Document) -> None:
        """How far a fetch is."""
        told = progress_of(event)
        if event.get("done"):  # it has no pace any more
            told = replace(told, rate=self._progress.rate)
        self._progress = told
        self._progress_count += 1

    def _end_progress(self, received: int, count: int) -> None:
        """A fetch has ended, of which nobody may have told: it was a short one."""
        self._progress = Progress(received, count, self._progress.rate, 0.0)
        self._progress_count += 1

    def _announce(self, event: Event) -> None:
        """Tell those who listen, as soon as the table is what the event says."""
        self._held.append(event)
        if self._mirror.is_loaded:
            self._loaded([])

    def _announce_first(self) -> None:
        """Tell those who listen that it is there; once."""
        if not self._is_announced:
            self._is_announced = True
            self._announce(Heard(self))

    def _loaded(self, changes: list[Change]) -> None:
        """Its table is the service's now, with these differences."""
        for change in changes:
            self._publish(change)
        held, self._held = self._held, []
        for event in held:
            self._client._roster.publish(event)

    def _leave(self) -> None:
        """The service does not know it."""
        self._mirror.doubt()
        if self.state != "lost":
            self._held.append(Lost(self, self.silence))
        self._loaded([])
        self._is_gone = True

    def _return(self, document: Document, seq: int) -> None:
        """The service knows it, for the first time or again."""
        if self._is_gone:
            self._is_gone = False
            self._announce(Found(self, self.silence))
        self._seq = seq
        self._read(document)

    def _part(self) -> None:
        """It is not waited for any more."""
        awaited = f"{self.system}/{self.component} (lost)"
        self._end(NoReply(awaited, attempts=0, waited=self.silence))

    def _end(self, error: ParamClientError | None) -> None:
        for changes in list(self._subscriptions):
            changes.end(error)

    def _read(self, document: Document) -> None:
        _check(document)
        self._identity = identity_of(document["identity"])
        self._document = document
        self._told_at = anyio.current_time()


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
