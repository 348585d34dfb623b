"""LocalClient, LocalComponent, LocalExtParams, ServiceComponent: internal interfaces of both clients.

Those of the client over a link of this process begin with `Local`.

`local` returns it for a component, `paramclient.client.client.local_client` for a client. The service,
provision, metadata, diagnosis, MAVFTP and the fetch of several components use only these names. They are not
part of `Component` and `ParamClient`. A component over a service has none of them; `ServiceComponent` is what
the command needs of it.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Final, Protocol, TypeVar

import anyio

from paramclient.cache import ParamCache
from paramclient.client.cache_writer import CacheWriter
from paramclient.client.component import Component
from paramclient.client.events import Events
from paramclient.client.extended_params import ExtChanges, ExtParams
from paramclient.client.link_task import LinkTask
from paramclient.client.subscription import Changes
from paramclient.links import Link
from paramclient.model.identity import Identity
from paramclient.protocol.addresses import Address
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.params.fetch import Fetch
from paramclient.protocol.params.fetch_result import FetchResult, Progress
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.station import Station

__all__ = [
    "LocalClient",
    "LocalComponent",
    "LocalExtParams",
    "local",
    "wait_until_identified",
]

IDENTITY_POLL_INTERVAL: Final = 0.05
"""Seconds between two checks of the identity of a vehicle: no event reports it."""

Result = TypeVar("Result")


class LocalClient(Protocol):
    """A client over a link of this process.

    Attributes:
        cache: the cache of its tables, or None.
        station: the protocol core of the link.
        link_task: the tasks that read and send; `activity` is set when anything was received.
        cache_writer: writes tables to the cache, in a thread of its own.
        opened_at: when the client was opened, by the clock of the event loop.
    """

    cache: ParamCache | None
    station: Station
    link_task: LinkTask
    cache_writer: CacheWriter
    opened_at: float

    @property
    def link(self) -> Link:
        """See `ParamClient.link`."""

    @property
    def components(self) -> Mapping[Address, Component]:
        """See `ParamClient.components`."""

    @property
    def is_over(self) -> bool:
        """Whether no further event can happen: the log has ended, or the client or its link for good."""

    async def successor(self, component: Component, system: int, *, timeout: float | None) -> Component:
        """See `ParamClient.successor`."""

    def check_open(self) -> None:
        """Check that requests can be sent.

        Raises:
            LinkError: the link failed, or the client is not open.
        """

    def wake(self) -> None:
        """Run the sender: something is to be sent, or a deadline has changed."""

    async def wait_until_files_closed(self, machine: ComponentMachine) -> None:
        """Wait at most one round trip until the file session that a component closes is closed on board."""

    def subscribe(self, events: Events) -> None:
        """Push all further events to this stream while it is referenced. Ends it if none can follow."""


class LocalExtParams(ExtParams):
    """The extended parameters of a component on a link of this process."""

    @abstractmethod
    def listen(self, changes: ExtChanges) -> None:
        """Push all further changes to this stream while it is referenced. Ends it if none can follow."""

    @abstractmethod
    def ignore(self, changes: ExtChanges) -> None:
        """Push no further changes to this stream."""


class LocalComponent(Component):
    """A component on a link of this process.

    Attributes:
        machine: its protocol state: table, reads, writes, fetches, presence, identification.
        client: the client that follows it.
    """

    machine: ComponentMachine
    client: LocalClient

    @property
    @abstractmethod
    def ext(self) -> LocalExtParams:
        """See `Component.ext`."""

    @property
    @abstractmethod
    def settled_identity(self) -> Identity | None:
        """The identity of the vehicle, under which its table is cached; None before it is settled."""

    @abstractmethod
    def wake(self) -> None:
        """Run the sender: something is to be sent, or a deadline has changed."""

    @abstractmethod
    def is_cache_due(self, now: float) -> bool:
        """Return whether the cached table is in `params`, or the timeout for it has expired."""

    @abstractmethod
    async def wait_for_cache(self) -> None:
        """Wait until the cached table, if there is one, is in `params`; a few seconds at most.

        Raises:
            LinkError: the link failed, or the client was closed.
        """

    @abstractmethod
    async def wait_until_kept(self) -> None:
        """Wait until the values of the component are written to the cache, for at most 6.5 s.

        Raises:
            UsageError: the client has no cache.
            CacheError: the values cannot be written, or the timeout expired.
        """

    @abstractmethod
    async def write_durably(self, names: Sequence[str]) -> None:
        """Sync the values of the component, plain and extended, to the disk.

        Args:
            names: names of the parameters whose values the vehicle has accepted, for NotDurable.

        Raises:
            NotDurable: the disk cannot be written.
        """

    @abstractmethod
    async def wait(
        self,
        operation: Operation[Result],
        timeout: float | None,
        describe: Callable[[], tuple[str, int]],
        progress: Callable[[], None] | None = None,
    ) -> Result:
        """Wait until an operation of `machine` ends. The caller releases the operation afterwards.

        Args:
            operation: begun by a call of `machine`.
            timeout: seconds; None waits until the operation ends.
            describe: returns a description of the operation and the number of attempts, for NoReply.
            progress: called about ten times a second, from this task.

        Raises:
            NoReply: the timeout expired.
            ParamClientError: the error with which the operation has ended.
        """

    @abstractmethod
    async def wait_for_fetch(
        self, fetch: Fetch, deadline: float | None, progress: Callable[[Progress], None] | None
    ) -> FetchResult:
        """Wait until a fetch of `machine` ends, or return its partial result at the deadline.

        The caller ends the fetch afterwards.

        Raises:
            ParamClientError: the error with which the fetch has ended.
        """

    @abstractmethod
    async def wait_until_files_closed(self) -> None:
        """Wait at most one round trip until a file session that is being closed is closed on board."""

    @abstractmethod
    def listen(self, changes: Changes) -> None:
        """Push all further changes to this stream while it is referenced. Ends it if none can follow."""

    @abstractmethod
    def ignore(self, changes: Changes) -> None:
        """Push no further changes to this stream."""


def local(component: Component) -> LocalComponent:
    """Return a component with its internal interface."""
    assert isinstance(component, LocalComponent)
    return component


async def wait_until_identified(component: LocalComponent, timeout: float) -> None:
    """Wait until the vehicle is identified, at most `timeout` seconds, as its key in the cache requires."""
    with anyio.move_on_after(timeout):
        while component.settled_identity is None:  # noqa: ASYNC110 - no event
            await anyio.sleep(IDENTITY_POLL_INTERVAL)
