"""RemoteComponent: the implementation of `Component` over a service."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final, Literal

import anyio

from paramclient.client.arguments import (
    check_accepted,
    check_portable_name,
    check_requested_name,
    check_settle,
    check_writes,
)
from paramclient.client.component import Component
from paramclient.client.extended_params import ExtParams
from paramclient.client.local import ServiceComponent, not_given
from paramclient.client.subscription import Changes
from paramclient.errors import NoReply, ParamClientError
from paramclient.model.identity import Identity
from paramclient.model.params import ParamMap
from paramclient.model.paramset import ParamSet, RestorePoint
from paramclient.model.values import Encoding, Param, Settable, WireValue, check_value
from paramclient.protocol.addresses import Address
from paramclient.protocol.params.fetch_result import FetchResult, Progress
from paramclient.protocol.params.sampling import SAMPLE_SIZE
from paramclient.protocol.params.sync import ComponentState, SyncState
from paramclient.protocol.params.write_batch import SetManyResult, SetOutcome, SetStatus
from paramclient.protocol.params.writes import SetResult
from paramclient.protocol.vehicle.address_contest import Contest
from paramclient.protocol.wire import PARAMETERS_MAX, SigningKey
from paramclient.remote.connection import run_with_progress
from paramclient.remote.decoding import (
    Document,
    check_kind,
    decode_errors,
    fetch_result_of,
    hash_of,
    param_of,
    restore_point_of,
    set_outcome_of,
    set_result_of,
    state_of,
    value_as_sent,
)
from paramclient.remote.http import ServiceResponse
from paramclient.remote.mirrored_component import MirroredComponent
from paramclient.remote.problems import NotDescribed, error_of
from paramclient.remote.remote_extended_params import RemoteExtParams
from paramclient.remote.service import Service
from paramclient.remote.write_parts import requests_of, write_in_parts

__all__ = ["RemoteComponent", "mirrored_of"]

VALUES_PER_REQUEST_MAX: Final = 1000
"""Values in one request: a service accepts 10,000, and a lost response leaves the outcome of all of them
unknown."""


class RemoteComponent(ServiceComponent):
    """A `Component` over a service; see `RemoteClient` for the differences.

    Attributes:
        link_name: name of its link on the service.
    """

    def __init__(self, service: Service, mirrored: MirroredComponent) -> None:
        self.link_name, self.system, self.component = mirrored.key
        self.params = ParamMap(mirrored.mirror.params)
        self._service = service
        self._mirrored = mirrored
        self._ext = RemoteExtParams(service, mirrored)

    # state

    @property
    def autopilot(self) -> str:
        """See `Component.autopilot`."""
        return str(self._mirrored.document["autopilot"])

    @property
    def is_autopilot(self) -> bool:
        """Whether its heartbeat names an autopilot."""
        return self._mirrored.is_autopilot

    @property
    def identity(self) -> Identity:
        """See `Component.identity`. Its `link` is the service's."""
        return self._mirrored.identity

    @property
    def encoding(self) -> Encoding:
        """See `Component.encoding`."""
        return Encoding(self._mirrored.document["encoding"])

    @property
    def encoding_reason(self) -> str:
        """See `Component.encoding_reason`."""
        return str(self._mirrored.document["encoding_reason"])

    @property
    def ext(self) -> ExtParams:
        """See `Component.ext`.

        Raises:
            UsageError: the service is of an earlier version without extended parameters.
        """
        if not self._mirrored.has_extended:
            raise not_given("extended parameters, as its version is too old")
        return self._ext

    @property
    def count(self) -> int | None:
        """See `Component.count`."""
        count: int | None = self._mirrored.document["count"]
        return count

    @property
    def hash(self) -> int | None:
        """See `Component.hash`."""
        return hash_of(self._mirrored.document["hash"])

    @property
    def state(self) -> ComponentState:
        """See `Component.state`. While the service cannot be reached, the state is *cached*."""
        state = self._mirrored.state
        if not self._service.connection.is_offline or state in (ComponentState.LOST, ComponentState.NEW):
            return state
        return ComponentState.CACHED

    @property
    def sync_state(self) -> SyncState:
        """See `Component.sync_state`. While the service cannot be reached, a table is *unsynced*."""
        state = SyncState.LOST if self._mirrored.is_gone else SyncState(self._mirrored.document["sync_state"])
        return (
            SyncState.UNSYNCED
            if self._service.connection.is_offline and state is not SyncState.LOST
            else state
        )

    @property
    def address(self) -> Address:
        """See `Component.address`."""
        return self.system, self.component

    @property
    def peer(self) -> str:
        """See `Component.peer`."""
        return str(self._mirrored.document["peer"])

    @property
    def contest(self) -> Contest | None:
        """See `Component.contest`."""
        contest: Document | None = self._mirrored.document["contest"]
        if contest is None:
            return None
        return Contest(self.system, self.component, tuple(contest["claimants"]), str(contest["difference"]))

    @property
    def is_armed(self) -> bool | None:
        """See `Component.is_armed`. None also while the service cannot be reached."""
        is_armed: bool | None = self._mirrored.document["is_armed"]
        return None if self._service.connection.is_offline or self._mirrored.is_gone else is_armed

    @property
    def silence(self) -> float:
        """See `Component.silence`; by the last report of the service."""
        return self._mirrored.silence

    @property
    def round_trip(self) -> float | None:
        """See `Component.round_trip`: between the service and the vehicle."""
        seconds: float | None = self._mirrored.document["round_trip_s"]
        return seconds

    def __repr__(self) -> str:
        last = self._mirrored.document["last_fetch"]
        origin = "" if last is None else f" from {last['source']} in {last['elapsed_s']:.2f} s"
        known = len(self.params)
        of = f" of {self.count}" if self.count is not None and self.state in ("partial", "fetching") else ""
        return (
            f"<RemoteComponent {self.system}/{self.component} {self.autopilot} {self.state} {known}{of} "
            f"params{origin}>"
        )

    # calls

    async def get(self, name: str | int, *, timeout: float | None = None) -> Param:
        """See `Component.get`."""
        check_requested_name(name)
        body = {"name": name} if isinstance(name, str) else {"index": name}
        what = name if isinstance(name, str) else f"parameter {name}"
        answer = await self._service.ask(
            self._mirrored, "read", body, timeout, f"{what} of {self.system}/{self.component}"
        )
        with decode_errors(self._service.name):
            param = param_of(answer.document)
        self._mirrored.mirror.confirm(param)
        return param

    async def set(
        self,
        name: str,
        value: Settable,
        *,
        timeout: float | None = None,
        settle: float = 0.0,
        force: bool = False,
        durable: bool = False,
        author: str | None = None,
    ) -> SetResult:
        """See `Component.set`.

        The service executes writes to one name in order, also those of different clients. If its response is
        lost, the write is not sent again: LinkError reports that it is unknown whether the write was done.
        """
        requested = check_value(value)
        body: dict[str, Any] = {"values": {check_portable_name(name): value_as_sent(requested)}}
        if check_settle(settle):
            body["settle_s"] = settle
        if force:
            body["force"] = True
        if durable:
            body["durable"] = True
        answer = await self._service.ask(
            self._mirrored,
            "params",
            body,
            timeout,
            f"PARAM_SET {name} to {self.system}/{self.component}",
            method="PATCH",
            is_write=True,
        )
        with decode_errors(self._service.name):
            (result,) = answer.document["results"].values()
            if (problem := result.get("problem")) is not None:
                raise error_of(problem, status=problem["status"], link=self._service.name)
            done = set_result_of(result, requested)
        self._mirrored.mirror.confirm(done.param)
        return done

    async def set_many(
        self,
        values: Mapping[str, Settable] | Iterable[tuple[str, Settable]],
        *,
        progress: Callable[[SetOutcome], None] | None = None,
        timeout: float | None = None,
        settle: float = 0.0,
        force: bool = False,
        durable: bool = False,
        author: str | None = None,
    ) -> SetManyResult:
        """See `Component.set_many`.

        A request has each name once, and at most `VALUES_PER_REQUEST_MAX` values; more are sent in several
        requests, one after the other. If a response is lost, its writes are not sent again, and their
        outcome is unknown.
        """
        pairs = check_writes(values)
        options: dict[str, Any] = {}
        if check_settle(settle):
            options["settle_s"] = settle
        if force:
            options["force"] = True
        if durable:
            options["durable"] = True
        self._service.connection.check_open()
        if self.state == "lost":
            what = f"PARAM_SET to {self.system}/{self.component} (lost)"
            raise NoReply(what, attempts=0, waited=self.silence)
        began = anyio.current_time()

        async def write(
            part: Sequence[tuple[str, WireValue]], left: float | None
        ) -> tuple[list[SetOutcome], ParamClientError | None]:
            return await self._set_part(part, options, left)

        def not_written(
            name: str, value: WireValue, status: SetStatus, error: ParamClientError
        ) -> SetOutcome:
            return SetOutcome(name, value, status, error=error)

        outcomes, failure = await write_in_parts(
            requests_of(pairs, VALUES_PER_REQUEST_MAX),
            write,
            not_written,
            timeout=timeout,
            progress=progress,
        )
        elapsed = anyio.current_time() - began
        return SetManyResult(self.system, self.component, outcomes, failure, elapsed)

    async def _set_part(
        self, pairs: Sequence[tuple[str, WireValue]], options: Mapping[str, Any], timeout: float | None
    ) -> tuple[list[SetOutcome], ParamClientError | None]:
        """Write values with different names in one request."""
        answer = await self._service.ask(
            self._mirrored,
            "params",
            {"values": {name: value_as_sent(value) for name, value in pairs}, **options},
            timeout,
            f"PARAM_SET to {self.system}/{self.component}",
            method="PATCH",
            is_write=True,
        )
        with decode_errors(self._service.name):
            results = answer.document["results"]
            link = self._service.name
            outcomes = [set_outcome_of(results[name], name, value, link) for name, value in pairs]
            problem = answer.document.get("problem")
            failure = None if problem is None else error_of(problem, status=problem["status"], link=link)
        for outcome in outcomes:
            if outcome.result is not None:
                self._mirrored.mirror.confirm(outcome.result.param)
        return outcomes, failure

    async def fetch_all(
        self,
        *,
        refresh: bool = False,
        accept: Literal["verified", "sampled"] = "verified",
        sample: int = SAMPLE_SIZE,
        seed: int | None = None,
        timeout: float | None = None,
        progress: Callable[[Progress], None] | None = None,
    ) -> FetchResult:
        """See `Component.fetch_all`. Concurrent fetches of several programs share one download."""
        began = anyio.current_time()
        download = self._mirrored.progress
        before = download.count
        check_accepted(accept, sample)
        body: dict[str, Any] = {"refresh": refresh, "accept": accept, "sample": min(sample, PARAMETERS_MAX)}
        if seed is not None:
            body["seed"] = seed

        def report() -> None:
            assert progress is not None
            progress(download.since(before))

        async def fetch() -> ServiceResponse:
            awaited = f"the parameters of {self.system}/{self.component}"
            answer = await self._service.ask(self._mirrored, "fetch", body, timeout, awaited)
            with decode_errors(self._service.name):
                download.end(answer.document["received"], answer.document["count"])
            return answer

        answer = await run_with_progress(fetch, None if progress is None else report)
        with decode_errors(self._service.name):
            return fetch_result_of(answer.document, self.params, anyio.current_time() - began)

    async def refreshed(self, *, timeout: float | None = None) -> None:
        """See `Component.refreshed`."""
        await self._service.ask(self._mirrored, "refreshed", {}, timeout, "the values outside the hash")

    async def read_descriptions(
        self, *, loads: bool = False, timeout: float | None = None
    ) -> Mapping[str, Any] | None:
        """See `ServiceComponent.read_descriptions`."""
        service, mirrored = self._service, self._mirrored
        awaited = f"the metadata of {self.system}/{self.component}"
        try:
            if loads:
                await service.ask(mirrored, "metadata", {}, timeout, awaited)
            answer = await service.connection.ask(
                "GET", f"{mirrored.path}/metadata", awaited=awaited, link=mirrored.link_name
            )
        except NotDescribed:
            return None
        with decode_errors(service.name):
            check_kind(answer.document, dict)
        document: Document = answer.document
        return document

    @property
    def service(self) -> str:
        """See `ServiceComponent.service`."""
        return self._service.name

    async def load_restore_point(self) -> RestorePoint:
        """See `ServiceComponent.load_restore_point`."""
        document = await self._ask("POST", f"{self._mirrored.path}/state", {}, "the state to restore")
        with decode_errors(self._service.name):
            return restore_point_of(document)

    async def load_state(self, when: float) -> ParamSet:
        """See `ServiceComponent.load_state`."""
        body = {"snapshot": when} if isinstance(when, int) else {"at": when}
        document = await self._ask("POST", f"{self._mirrored.path}/state", body, "the state to restore")
        with decode_errors(self._service.name):
            return state_of(document)

    async def plan_set_up(
        self, kind: Literal["apply", "restore"], body: Mapping[str, Any], *, timeout: float | None = None
    ) -> Mapping[str, Any]:
        """See `ServiceComponent.plan_set_up`."""
        path = "plan" if kind == "apply" else f"{kind}/plan"
        return await self._ask("POST", f"{self._mirrored.path}/{path}", body, "the plan of a set-up", timeout)

    async def compare(self, body: Mapping[str, Any], *, timeout: float | None = None) -> Mapping[str, Any]:
        """See `ServiceComponent.compare`."""
        return await self._ask("POST", f"{self._mirrored.path}/verify", body, "a comparison", timeout)

    async def begin_set_up(
        self, kind: Literal["apply", "restore"], body: Mapping[str, Any], *, timeout: float | None = None
    ) -> Mapping[str, Any]:
        """See `ServiceComponent.begin_set_up`."""
        return await self._ask(
            "POST",
            f"{self._mirrored.path}/{kind}",
            {**body, "wait": False},
            f"the set-up of {self.system}/{self.component}",
            timeout,
            is_write=True,
        )

    async def read_job(self, job: str) -> Mapping[str, Any]:
        """See `ServiceComponent.read_job`."""
        document = await self._ask("GET", f"/jobs/{job}", None, f"the state of job {job}")
        with decode_errors(self._service.name):
            problem = document["problem"] if document["state"] == "failed" else None
        if problem is not None:
            raise self.error_of_problem(problem)
        return document

    def error_of_problem(self, problem: Mapping[str, Any]) -> ParamClientError:
        """See `ServiceComponent.error_of_problem`."""
        with decode_errors(self._service.name):
            return error_of(problem, status=problem["status"], link=self._service.name)

    async def cancel_job(self, job: str) -> None:
        """See `ServiceComponent.cancel_job`."""
        await self._service.connection.ask("DELETE", f"/jobs/{job}", awaited=f"the end of job {job}")

    async def _ask(
        self,
        method: str,
        path: str,
        body: Mapping[str, Any] | None,
        awaited: str,
        timeout: float | None = None,
        *,
        is_write: bool = False,
    ) -> Mapping[str, Any]:
        """Send a request, and return the document of the response."""
        service, link = self._service, self._mirrored.link_name
        answer = await service.connection.ask(
            method, path, body, awaited=awaited, timeout=timeout, link=link, is_write=is_write
        )
        with decode_errors(service.name):
            check_kind(answer.document, dict)
        document: Document = answer.document
        return document

    async def setup_signing(self, key: SigningKey | None, *, link_is_safe: bool = False) -> None:
        """Raise UsageError: SETUP_SIGNING needs the link itself, as it sends the key unencrypted."""
        raise not_given("the set-up of signing")

    async def reboot(self, *, system: int | None = None, timeout: float | None = None) -> Component:
        """See `Component.reboot`."""
        body = {} if system is None else {"system": system}
        awaited = f"the restart of {self.system}/{self.component}"
        return await self._service.component_of_response(
            await self._service.ask(self._mirrored, "reboot", body, timeout, awaited, is_write=True)
        )

    def changes(self) -> Changes:
        """See `Component.changes`.

        `by` is "us" for writes of this program, and "us for NAME" for writes of the service for other users.
        Changes during a lost connection are delivered after the reconnection, with the vehicle as author.
        """
        changes = Changes()
        self._mirrored.listen(changes)
        if (ended := self._service.connection.ended) is not None:
            changes.end(ended)
        return changes


def mirrored_of(component: Component) -> MirroredComponent:
    """Return the mirrored state of a component. For the modules of this package only."""
    assert isinstance(component, RemoteComponent)
    return component._mirrored
