"""FetchIterator: a fetch as an iterator of its progress."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from paramclient.protocol.fetch import FetchResult, Progress
from paramclient.sync.blocking import Component
from paramclient.sync.client_thread import ReportingCall
from paramclient.sync.wrappers import thread_of, wrapped_by

__all__ = ["FetchIterator"]


class FetchIterator(Iterator[Progress]):
    """`Component.fetch_all` as an iterator of its progress, for a progress bar or a widget.

    The fetch starts immediately. The iterator yields about ten items a second and ends with the fetch; an
    error of the fetch is raised by the iterator. Ctrl-C while an item is awaited cancels the fetch, and so
    does dropping the last reference to this object. Received values stay in the table.

    Args:
        component: the component.
        refresh, timeout: as in `Component.fetch_all`.

    Raises:
        ClientClosed: the client is not open.
    """

    def __init__(
        self,
        component: Component,
        *,
        refresh: bool = False,
        timeout: float | None = None,
    ) -> None:
        fetch = partial(
            wrapped_by(component).fetch_all,
            refresh=refresh,
            timeout=timeout,
        )
        self._call: ReportingCall[Progress, FetchResult] = thread_of(component).begin_reporting(fetch)

    def __next__(self) -> Progress:
        return next(self._call)

    @property
    def result(self) -> FetchResult:
        """The result of the fetch. Before the end of the fetch, waits for it.

        Raises:
            ParamClientError: as from `Component.fetch_all`.
        """
        return self._call.result
