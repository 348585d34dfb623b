"""ExtParams: the extended parameters of one component, and their calls, over a link."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from typing import Final

from paramclient.cache import SnapshotSummary
from paramclient.client.subscription import Subscription
from paramclient.model.ext_params import ExtParam, ExtSettable
from paramclient.model.ext_paramset import ExtParamSet
from paramclient.protocol.ext.change import ExtChange
from paramclient.protocol.ext.fetch import ExtFetchResult
from paramclient.protocol.ext.write_batch import ExtSetManyResult, ExtSetOutcome
from paramclient.protocol.ext.writes import ExtSetResult
from paramclient.protocol.params.fetch_result import Progress

__all__ = ["ExtChanges", "ExtParams"]

QUEUED_EXT_CHANGES_MAX: Final = 10_000
"""Maximum number of changes queued for a consumer, one for each name. Above it, the oldest are dropped."""


class ExtChanges(Subscription[ExtChange]):
    """Stream of the changes of one component's extended parameters since its creation.

    A slow consumer receives several changes of one parameter as one.
    """

    def __init__(self) -> None:
        super().__init__()
        self._waiting: dict[str, ExtChange] = {}

    def push(self, item: ExtChange) -> None:
        """Add a change, or merge it with the queued change of the same parameter."""
        earlier = self._waiting.pop(item.name, None)
        if earlier is not None:
            item = ExtChange(item.name, earlier.old, item.new, item.by, earlier.is_added)
            old, new = item.old, item.new
            if (old is None and new is None) or (old is not None and new is not None and old.same_value(new)):
                return
        self._waiting[item.name] = item
        if len(self._waiting) > QUEUED_EXT_CHANGES_MAX:
            del self._waiting[next(iter(self._waiting))]
        self._arrived.set()

    def _take(self) -> ExtChange | None:
        return self._waiting.pop(next(iter(self._waiting))) if self._waiting else None


class ExtParams(ABC):
    """The extended parameters of a component (PARAM_EXT_*); see `Component.ext`.

    Cameras, gimbals and companion computers have them: values of up to 128 bytes, with text and 64-bit types.
    A component may have plain parameters as well; the two tables are separate, and one name may be in both.

    Cancellation, lost components and reconnection are handled as in `Component`.

    Attributes:
        params: the known parameters by name. The mapping is read-only and follows the received messages.
    """

    params: Mapping[str, ExtParam]

    @property
    @abstractmethod
    def count(self) -> int | None:
        """The `param_count` of the component; None before its first PARAM_EXT_VALUE."""

    @property
    @abstractmethod
    def is_spoken(self) -> bool:
        """Whether the component has sent an extended parameter."""

    @property
    @abstractmethod
    def is_expected(self) -> bool:
        """Whether the component has sent an extended parameter, or is of a kind that usually has them.

        Cameras, gimbals, winches, illuminators and grippers, by MAV_TYPE or component id.
        """

    @property
    @abstractmethod
    def is_complete(self) -> bool:
        """Whether `params` has a parameter for every index below `count`."""

    @abstractmethod
    async def get(self, name: str | int, *, timeout: float | None = None) -> ExtParam:
        """Read one parameter with PARAM_EXT_REQUEST_READ.

        Args:
            name: param_id, or an index from 0.
            timeout: seconds; None: the number of attempts limits the time.

        Returns:
            The parameter as the component has reported it.

        Raises:
            UsageError: the name or index is not valid, or the client only listens.
            UnknownParameter: the component has no such parameter.
            NoReply: the component did not respond in time, or it is lost.
            ContestedAddress: several vehicles use its address.
            LinkError: the link failed, or the client was closed.
        """

    @abstractmethod
    async def set(
        self,
        name: str,
        value: ExtSettable,
        *,
        timeout: float | None = None,
        durable: bool = False,
        author: str | None = None,
    ) -> ExtSetResult:
        """Write one parameter with PARAM_EXT_SET, and return when the component has acknowledged the value.

        An unknown type is read from the component first. While the component reports progress, the call
        continues to wait. Writes to one name run in the order of the calls, writes to different names in
        parallel. After cancellation it is unknown whether the component has the value.

        Args:
            name: param_id.
            value: a number for a numeric type; text, or bytes, of up to 128 bytes for CUSTOM.
            timeout: seconds; None: no limit besides the number of unanswered attempts.
            durable, author: as in `Component.set`.

        Returns:
            Accepted, or adjusted: the component stored another value.

        Raises:
            UsageError: the name or the value is not valid, or the client only listens. Nothing was written.
            UnknownParameter: the component has no such parameter.
            ValueUnsupported: the component does not support the value.
            SetFailed: the component could not set the value.
            ExtSetRefused: the component refused with a result that MAVLink does not define.
            ValueNotApplied: the component keeps its previous value and does not acknowledge the write.
            NoReply: the component did not respond. It is unknown whether it has the value.
            ContestedAddress: several vehicles use its address.
            LinkError: the link failed, or the client was closed.
            CacheError: with `durable`, the cache cannot store the value. Nothing was written.
            NotDurable: with `durable`, the component has accepted the value, but it could not be written to
                the disk.
        """

    @abstractmethod
    async def set_many(
        self,
        values: Mapping[str, ExtSettable] | Iterable[tuple[str, ExtSettable]],
        *,
        progress: Callable[[ExtSetOutcome], None] | None = None,
        timeout: float | None = None,
        durable: bool = False,
        author: str | None = None,
    ) -> ExtSetManyResult:
        """Write many parameters in one call, each as `set` does.

        Several writes are in flight at a time. A value that is refused does not stop the others. If the
        component is lost, the link fails, three writes in a row get no response or the timeout expires, the
        call returns the outcomes so far, and `error` of the result is the cause.

        Args:
            values: values by name, or pairs of name and value; a name may occur in several pairs.
            progress: called with each outcome in the order of their arrival, from this task.
            timeout: seconds for the whole call; None: no limit besides the number of attempts.
            durable, author: as in `Component.set_many`.

        Returns:
            One outcome for each value, in the order given: accepted, adjusted, refused, unknown or not tried.

        Raises:
            UsageError: a name, a value or another argument is not valid, or the client only listens. Nothing
                was written.
            NoReply: the component is lost already. Nothing was written.
            ContestedAddress: several vehicles use its address. Nothing was written.
            LinkError: the link had failed already, or the client was closed.
            CacheError: with `durable`, the cache cannot store values. Nothing was written.
        """

    @abstractmethod
    async def fetch_all(
        self,
        *,
        timeout: float | None = None,
        progress: Callable[[Progress], None] | None = None,
    ) -> ExtFetchResult:
        """Download all parameters with PARAM_EXT_REQUEST_LIST, and read the values that the list lacks.

        The protocol has no hash, so a cached table cannot be confirmed without a download. A client whose
        policy allows no download returns the known table.

        Concurrent calls share one fetch. Cancellation keeps the received values in the table.

        Args:
            timeout: seconds after which the partial table is returned with `missing`; None: no limit.
            progress: called about ten times a second, from this task.

        Returns:
            The parameters, and the missing indices.

        Raises:
            UsageError: the client only listens.
            CacheError: nothing is known, and the policy allows no download.
            NoReply: no response arrived: most components have no extended parameters. Or the component is
                lost.
            ContestedAddress: several vehicles use its address.
            LinkError: the link failed, or the client was closed.
        """

    @abstractmethod
    async def store_snapshot(self, *, reason: str) -> int | None:
        """Store a snapshot of the known parameters in the cache, as a restore point.

        All values received before the call are written to the cache and its history first.

        Args:
            reason: the reason, as text.

        Returns:
            The number of the snapshot; None if there is no cache.

        Raises:
            UsageError: no parameter is known.
            CacheError: the cache cannot store it.
            LinkError: the client was closed.
        """

    @abstractmethod
    async def snapshots(self) -> list[SnapshotSummary]:
        """Return the snapshots of the component's extended parameters, the newest last.

        Raises:
            UsageError: there is no cache.
            CacheError: the cache cannot be read.
            LinkError: the client was closed.
        """

    @abstractmethod
    async def load_state(self, when: float) -> ExtParamSet:
        """Return an earlier state of the parameters, from the cache.

        Args:
            when: a float is a time, in unix seconds; an int is the number of a snapshot. See
                `ParamCache.ext_state_at`.

        Raises:
            UsageError: there is no cache, or the time is not in unix seconds.
            CacheError: there is no such state, or the cache cannot be read.
            LinkError: the client was closed.
        """

    @abstractmethod
    def changes(self) -> ExtChanges:
        """Return a stream of changes from now on, like `Component.changes`.

        Raises:
            LinkError: while iterating, after the queued changes: the link failed permanently, or the client
                was closed.
            NoReply: while iterating: the component was lost and is no longer followed.
        """
