"""RemoteExtParams: the implementation of `ExtParams` over a service."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Final

import anyio

from paramclient.cache import SnapshotSummary
from paramclient.client.arguments import check_portable_name, check_requested_name
from paramclient.client.extended_params import ExtChanges, ExtParams
from paramclient.errors import NoReply, ParamClientError
from paramclient.model.ext_params import ExtParam, ExtSettable, ExtValue, check_ext_value
from paramclient.model.ext_paramset import ExtParamSet
from paramclient.protocol.ext.fetch import ExtFetchResult
from paramclient.protocol.ext.write_batch import ExtSetManyResult, ExtSetOutcome
from paramclient.protocol.ext.writes import ExtSetResult
from paramclient.protocol.params.change_origin import check_author
from paramclient.protocol.params.fetch_result import Progress
from paramclient.protocol.params.write_batch import SetStatus
from paramclient.remote.connection import run_with_progress
from paramclient.remote.decoding import (
    decode_errors,
    ext_fetch_result_of,
    ext_param_of,
    ext_set_outcome_of,
    ext_snapshot_of,
    ext_state_of,
    ext_value_as_sent,
)
from paramclient.remote.http import ServiceResponse
from paramclient.remote.mirrored_component import MirroredComponent
from paramclient.remote.problems import error_of
from paramclient.remote.service import Service
from paramclient.remote.write_parts import requests_of, write_in_parts

__all__ = ["RemoteExtParams"]

EXT_VALUES_PER_REQUEST_MAX: Final = 400
"""Extended values in one request: a service accepts 60,000 separators, and a text may have 128 commas."""


class RemoteExtParams(ExtParams):
    """The extended parameters of a component over a service. See `ExtParams` for the calls.

    Args:
        service: the service.
        mirrored: the component.
    """

    def __init__(self, service: Service, mirrored: MirroredComponent) -> None:
        self._service = service
        self._mirrored = mirrored
        self.params = MappingProxyType(mirrored.ext_mirror.params)

    def __repr__(self) -> str:
        of = "" if self.count is None or self.is_complete else f" of {self.count}"
        return f"<ExtParams {self._whose} {len(self.params)}{of} extended params>"

    @property
    def count(self) -> int | None:
        """See `ExtParams.count`."""
        count: int | None = self._mirrored.document["extended"]["count"]
        return count

    @property
    def is_spoken(self) -> bool:
        """See `ExtParams.is_spoken`."""
        return bool(self._mirrored.document["extended"]["is_spoken"])

    @property
    def is_expected(self) -> bool:
        """See `ExtParams.is_expected`."""
        return bool(self._mirrored.document["extended"]["is_expected"])

    @property
    def is_complete(self) -> bool:
        """See `ExtParams.is_complete`."""
        count = self.count
        known = {param.index for param in self.params.values()} - {None}
        return count is not None and len(known) >= count

    async def get(self, name: str | int, *, timeout: float | None = None) -> ExtParam:
        """See `ExtParams.get`."""
        check_requested_name(name)
        body = {"name": name} if isinstance(name, str) else {"index": name}
        what = name if isinstance(name, str) else f"extended parameter {name}"
        answer = await self._service.ask(
            self._mirrored, "extended/read", body, timeout, f"{what} of {self._whose}"
        )
        with decode_errors(self._service.name):
            param = ext_param_of(answer.document)
        self._mirrored.ext_mirror.confirm(param)
        return param

    async def set(
        self,
        name: str,
        value: ExtSettable,
        *,
        timeout: float | None = None,
        durable: bool = False,
        author: str | None = None,
    ) -> ExtSetResult:
        """See `ExtParams.set`. As in `Component.set`, a write whose response is lost is not sent again."""
        pair = (check_portable_name(name), check_ext_value(value))
        check_author(author)
        awaited = f"PARAM_EXT_SET {name} to {self._whose}"
        ((outcome,), _) = await self._write([pair], timeout, awaited, durable=durable)
        if outcome.error is not None:
            raise outcome.error
        assert outcome.result is not None
        return outcome.result

    async def set_many(
        self,
        values: Mapping[str, ExtSettable] | Iterable[tuple[str, ExtSettable]],
        *,
        progress: Callable[[ExtSetOutcome], None] | None = None,
        timeout: float | None = None,
        durable: bool = False,
        author: str | None = None,
    ) -> ExtSetManyResult:
        """See `ExtParams.set_many`.

        A request has each name once, and at most `EXT_VALUES_PER_REQUEST_MAX` values; more are sent in
        several requests, one after the other. If a response is lost, its writes are not sent again, and
        their outcome is unknown.
        """
        given = values.items() if isinstance(values, Mapping) else values
        pairs = [(check_portable_name(name), check_ext_value(value)) for name, value in given]
        check_author(author)
        mirrored = self._mirrored
        self._service.connection.check_open()
        if mirrored.component.state == "lost":
            what = f"PARAM_EXT_SET to {self._whose} (lost)"
            raise NoReply(what, attempts=0, waited=mirrored.silence)
        began = anyio.current_time()

        async def write(
            part: Sequence[tuple[str, ExtValue]], left: float | None
        ) -> tuple[list[ExtSetOutcome], ParamClientError | None]:
            return await self._write(part, left, f"PARAM_EXT_SET to {self._whose}", durable=durable)

        def not_written(
            name: str, value: ExtValue, status: SetStatus, error: ParamClientError
        ) -> ExtSetOutcome:
            return ExtSetOutcome(name, value, status, error=error)

        outcomes, failure = await write_in_parts(
            requests_of(pairs, EXT_VALUES_PER_REQUEST_MAX),
            write,
            not_written,
            timeout=timeout,
            progress=progress,
        )
        _, system, component = mirrored.key
        return ExtSetManyResult(system, component, outcomes, failure, anyio.current_time() - began)

    async def _write(
        self,
        pairs: Sequence[tuple[str, ExtValue]],
        timeout: float | None,
        awaited: str,
        *,
        durable: bool,
    ) -> tuple[list[ExtSetOutcome], ParamClientError | None]:
        """Write values with different names in one request."""
        values = {name: ext_value_as_sent(value) for name, value in pairs}
        answer = await self._service.ask(
            self._mirrored,
            "extended/params",
            {"values": values, "durable": True} if durable else {"values": values},
            timeout,
            awaited,
            method="PATCH",
            is_write=True,
        )
        with decode_errors(self._service.name):
            results = answer.document["results"]
            link = self._service.name
            outcomes = [ext_set_outcome_of(results[name], name, value, link) for name, value in pairs]
            problem = answer.document.get("problem")
            failure = None if problem is None else error_of(problem, status=problem["status"], link=link)
        for outcome in outcomes:
            if outcome.result is not None:
                self._mirrored.ext_mirror.confirm(outcome.result.param)
        return outcomes, failure

    async def fetch_all(
        self,
        *,
        timeout: float | None = None,
        progress: Callable[[Progress], None] | None = None,
    ) -> ExtFetchResult:
        """See `ExtParams.fetch_all`. Concurrent fetches of several programs share one download."""
        began = anyio.current_time()
        download = self._mirrored.ext_progress
        before = download.count

        def report() -> None:
            assert progress is not None
            progress(download.since(before))

        async def fetch() -> ServiceResponse:
            awaited = f"extended parameters of {self._whose}"
            answer = await self._service.ask(self._mirrored, "extended/fetch", {}, timeout, awaited)
            with decode_errors(self._service.name):
                download.end(answer.document["received"], answer.document["count"])
            return answer

        answer = await run_with_progress(fetch, None if progress is None else report)
        with decode_errors(self._service.name):
            return ext_fetch_result_of(answer.document, self.params, anyio.current_time() - began)

    async def store_snapshot(self, *, reason: str) -> int | None:
        """See `ExtParams.store_snapshot`. The cache is that of the service."""
        answer = await self._service.ask(
            self._mirrored,
            "extended/snapshots",
            {"reason": reason},
            None,
            f"snapshot of {self._whose}",
            is_write=True,
        )
        with decode_errors(self._service.name):
            number = answer.document["snapshot"]
            return None if number is None else int(number)

    async def snapshots(self) -> list[SnapshotSummary]:
        """See `ExtParams.snapshots`. The cache is that of the service."""
        awaited = f"snapshots of {self._whose}"
        answer = await self._service.ask(
            self._mirrored, "extended/snapshots", None, None, awaited, method="GET"
        )
        key = self._mirrored.identity.key
        with decode_errors(self._service.name):
            return [ext_snapshot_of(each, key) for each in answer.document["snapshots"]]

    async def load_state(self, when: float) -> ExtParamSet:
        """See `ExtParams.load_state`. The cache is that of the service."""
        body = {"snapshot": when} if isinstance(when, int) else {"at": when}
        awaited = f"earlier state of {self._whose}"
        answer = await self._service.ask(self._mirrored, "extended/state", body, None, awaited)
        with decode_errors(self._service.name):
            return ext_state_of(answer.document, self._mirrored.identity)

    def changes(self) -> ExtChanges:
        """See `ExtParams.changes`, and `RemoteComponent.changes` for the authors."""
        changes = ExtChanges()
        self._mirrored.listen_ext(changes)
        if (ended := self._service.connection.ended) is not None:
            changes.end(ended)
        return changes

    @property
    def _whose(self) -> str:
        _, system, component = self._mirrored.key
        return f"{system}/{component}"
