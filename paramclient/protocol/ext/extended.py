"""ExtendedParams: the extended parameters of one component as one machine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Protocol

from paramclient.errors import ExtAckResult
from paramclient.model.ext_params import ExtParam, ExtValue
from paramclient.model.values import is_portable_name
from paramclient.protocol.ext.change import ExtChange
from paramclient.protocol.ext.fetch import ExtFetch, ExtFetches
from paramclient.protocol.ext.reads import ExtRead, ExtReads
from paramclient.protocol.ext.table import ExtTable
from paramclient.protocol.ext.writes import ExtWrite, ExtWrites
from paramclient.protocol.params.change_origin import Authors
from paramclient.protocol.params.reads import Key
from paramclient.protocol.params.table import NameQuota
from paramclient.protocol.params.value_check import READS_PAUSE, REREADS_MAX, ValueChecks
from paramclient.protocol.params.write_batch import WriteBatches
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.machine import Machine
from paramclient.protocol.requests.pacing import LinkBandwidth
from paramclient.protocol.wire import NO_INDEX, ParamExtAck, ParamExtValue

__all__ = ["ExtHost", "ExtendedParams"]


class ExtHost(Protocol):
    """What the extended parameters need of their component."""

    @property
    def is_recipient_certain(self) -> bool:
        """Whether no other vehicle may have the address by now."""

    def ext_changed(self, change: ExtChange) -> None:
        """Report a change."""


class ExtendedParams(Machine):
    """The extended parameters of one component: table, reads, writes and lists, apart from the plain ones.

    Nothing is requested before a caller asks. What other stations request is taken, as for plain parameters.

    Args:
        context: the component's.
        host: the component.
        share: the bandwidth that all reads of the link may use together; None for a link with one component.
        name_quota: the name count shared by the tables of the link.

    Attributes:
        table: the parameters.
        reads, writes, batches, fetches: the exchanges.
        may_read: whether values may be read again without a request of the user.
    """

    def __init__(
        self,
        context: Context,
        host: ExtHost,
        *,
        share: LinkBandwidth | None = None,
        name_quota: NameQuota | None = None,
        may_read: bool = True,
    ) -> None:
        self._context = context
        self._host = host
        self.may_read = may_read and context.may_send
        self.table = ExtTable(name_quota)
        self.reads = ExtReads(context, self.table, share)
        self.writes = ExtWrites(context, self.reads, self.table, host, self._store)
        self.batches = WriteBatches(context.target, "PARAM_EXT_SET")
        self.fetches = ExtFetches(context, self.reads, self.table, self.report)
        self._authors = Authors()
        self._checks = ValueChecks()
        self.writes.left_open = self._authors.foreign_set

    @property
    def is_spoken(self) -> bool:
        """Whether the component has sent an extended parameter."""
        return self.fetches.is_spoken

    @property
    def is_busy(self) -> bool:
        """Whether anything is in progress."""
        return len(self.reads) > 0 or len(self.writes) > 0 or self.fetches.current is not None

    def receive_value(self, message: ParamExtValue, now: float, moment: float | None = None) -> None:
        """Process a PARAM_EXT_VALUE.

        Args:
            message: the message.
            now: the time.
            moment: when it arrived from the link, if earlier; None for `now`.
        """
        name = message.param_id
        if not is_portable_name(name):
            return
        param = ExtParam.of(name, message.raw, message.param_type)
        message = message._replace(raw=param.raw)
        if self.table.use_count(message.param_count):
            self.fetches.count_changed(now)
        until = self._checks.ambiguous_until(message, now, is_requested=False)
        if until > now:
            self._checks.ask(name, until)
            self.reads.defer(message, until, now)
            return
        by = self.writes.author(name) or self._authors.of(name, now)
        self._store(param, by, now if moment is None else moment, now, message.param_index)
        if name not in self.table.params:
            return  # more names than the table may hold
        self.fetches.receive(message, now)
        self.reads.receive(message, now)

    def receive_ack(self, message: ParamExtAck, now: float, moment: float | None = None) -> None:
        """Process a PARAM_EXT_ACK, also one for another station.

        The value of one that no write of ours awaits is not stored, as it may be a late copy: the parameter
        is read. Without requests, as in a log, it is stored.
        """
        name = message.param_id
        if not is_portable_name(name):
            return
        self.fetches.is_spoken = True
        if self.writes.acknowledged(message, now) or message.param_result != ExtAckResult.ACCEPTED:
            return
        param = ExtParam.of(name, message.raw, message.param_type)
        known = self.table.params.get(name)
        if known is not None and known.same_value(param):
            return
        if not self._context.may_send:
            self._store(param, self._authors.of(name, now), now if moment is None else moment, now)
        elif known is not None:
            self._checks.ask(name, now)

    def foreign_set(self, name: str, station: str, now: float) -> None:
        """Record another station's PARAM_EXT_SET to this component."""
        if is_portable_name(name):
            self._authors.foreign_set(name, station, now)

    def read(self, key: Key, now: float) -> ExtRead:
        """Read one parameter; give it back with `reads.release`."""
        read = self.reads.ask(key, now)
        read.is_of_caller = True
        return read

    def write(self, name: str, value: ExtValue, now: float, author: str | None = None) -> ExtWrite:
        """Write one parameter; end it with `writes.cancel`."""
        return self.writes.set(name, value, now, author)

    def begin_fetch(self, now: float) -> ExtFetch:
        """Begin a fetch, or join the one in progress; give it back with `fetches.end`."""
        return self.fetches.begin(now)

    def report(self, changes: list[ExtChange]) -> None:
        """Report changes."""
        for change in changes:
            self._host.ext_changed(change)

    def use_cached(self, params: Mapping[str, ExtParam], moments: Mapping[str, float]) -> None:
        """Load the cached table.

        Args:
            params: the cached parameters.
            moments: when each value was observed last, in seconds of the core's clock.
        """
        self.report(self.table.restore(params, moments))

    def doubt(self) -> None:
        """Doubt all values: another vehicle may have the address, or this one has restarted."""
        self.table.doubt()

    def restart(self, now: float) -> None:
        """Process a restart of the component."""
        self._checks.clear()
        self._authors.clear()
        self.fetches.restart(now)

    def forget(self, now: float) -> None:
        """Forget everything: another vehicle has the address."""
        self.report(self.table.forget())
        self.fetches.is_spoken = False
        self.fetches.last = None
        self.restart(now)

    def tick(self, now: float) -> None:
        """Do what is due."""
        if self.reads.next_deadline() <= now:
            self.reads.tick(now)
        self.writes.tick(now)
        self.fetches.tick(now)
        if self._checks.next_deadline() <= now:
            self._read_due(now)

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity."""
        if not self.is_busy:
            return self._checks.next_deadline()
        first = min(self.reads.next_deadline(), self.writes.next_deadline())
        return min(first, self.fetches.next_deadline(), self._checks.next_deadline())

    def resume(self, now: float) -> None:
        """Repeat the requests in flight: the link is back."""
        self.reads.resume(now)
        self.writes.resume(now)
        self.fetches.resume(now)

    def lose(self, now: float) -> None:
        """End everything with NoReply: the component is lost."""
        self.batches.lose(now)
        self.fetches.lose(now)
        self.writes.lose(now)
        self.reads.lose(now)
        self._checks.clear()

    def fail_all(self, error: Exception, now: float) -> None:
        """End every operation with the error."""
        self.fetches.fail_all(error, now)
        self.fail_writes(error, now)
        self.reads.fail_all(error, now)
        self._checks.clear()

    def fail_writes(self, error: Exception, now: float) -> None:
        """End the writes with the error."""
        self.batches.fail_all(error, now)
        self.writes.fail_all(error, now)

    def _store(
        self, param: ExtParam, by: str, moment: float, now: float | None = None, index: int = NO_INDEX
    ) -> None:
        """Store an observed value with its index, and report its change."""
        now = moment if now is None else now
        change = self.table.store(param, by, moment)
        if index != NO_INDEX and param.name in self.table.params:
            self.table.use_index(param.name, index)
        if change is None:
            return
        is_added = change.old is None and self.fetches.last is not None
        change = replace(change, new=self.table.params[param.name], is_added=is_added)
        old = change.old
        if old is not None:
            value = ParamExtValue(param.name, param.raw, param.type, 0, NO_INDEX)
            self._checks.replaced(param.name, old.type, old.raw, value, now, self.reads.sent_at)
            self._checks.forget(now)
        self.report([change])

    def _read_due(self, now: float) -> None:
        """Read the values again that may be older than a change; without reads, they are no longer live."""
        for name in self._checks.due(now):
            if not self.may_read:
                self.table.doubt_value(name)
            elif len(self.reads) < REREADS_MAX:
                self.reads.ask(name, now, urgent=False)
            else:
                self._checks.ask(name, now + READS_PAUSE)
