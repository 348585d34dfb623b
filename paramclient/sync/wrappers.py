"""Base classes of the blocking client: wrappers of asynchronous objects, streams, mappings."""

from __future__ import annotations

import weakref
from collections import deque
from collections.abc import AsyncIterator, Callable, ItemsView, Iterable, Iterator, Mapping, ValuesView
from contextlib import closing, suppress
from types import TracebackType
from typing import Any, Generic, Self, TypeVar

import anyio

from paramclient.client.client import ParamClient
from paramclient.model.params import ParamMap, copy_params
from paramclient.sync.client_thread import ClientThread

__all__ = [
    "BlockingClient",
    "BlockingStream",
    "LiveMapping",
    "Wrapper",
    "live_mapping",
    "live_params",
    "own_values",
    "thread_of",
    "wrapped_by",
]

Wrapped = TypeVar("Wrapped")
Item = TypeVar("Item")
Key = TypeVar("Key")
Value = TypeVar("Value")


class Wrapper(Generic[Wrapped]):
    """An object of a client, with calls that block.

    Args:
        thread: the thread of the client.
        wrapped: the asynchronous object.
    """

    def __init__(self, thread: ClientThread, wrapped: Wrapped) -> None:
        self._thread = thread
        self._wrapped = wrapped

    def __repr__(self) -> str:
        return self._thread.read(lambda: repr(self._wrapped))

    @classmethod
    def of(cls, thread: ClientThread, wrapped: Wrapped) -> Self:
        """Return the wrapper of an object: the same one as long as a reference to it remains."""
        return thread.shared(wrapped, lambda: cls(thread, wrapped))


def wrapped_by(wrapper: Wrapper[Wrapped]) -> Wrapped:
    """Return the asynchronous object of a wrapper."""
    return wrapper._wrapped


def thread_of(wrapper: Wrapper[Any]) -> ClientThread:
    """Return the thread of the client to which the object of a wrapper belongs."""
    return wrapper._thread


class BlockingClient(Wrapper[ParamClient]):
    """Opening and closing of a blocking client.

    Args:
        make: makes the asynchronous client.
    """

    def __init__(self, make: Callable[[], ParamClient]) -> None:
        thread = ClientThread(make)
        super().__init__(thread, thread.client)

    def __enter__(self) -> Self:
        self._thread.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._thread.close(failed=kind is not None)

    def open(self) -> Self:
        """Open the client without a `with`, until `close`. Return the client.

        For a REPL, a notebook, and programs that open and close in different functions. An unexpected error
        of the client ends it: it is logged, waiting calls and new ones raise ClientClosed with the error as
        the cause, and `close` raises it.

        Ctrl-C closes the client again.

        Raises:
            UsageError: the client was opened before, or the telemetry log exists or cannot be created.
            LinkError: the link, or the link to the other program, cannot be opened.
            ClientClosed: `close` was called meanwhile.
        """
        self._thread.open()
        return self

    def close(self) -> None:
        """Close the client, as on exit from a `with`.

        Any thread may call it, also while `open`, another `close` or any other call is running: calls that
        wait in other threads raise ClientClosed. It has no effect on a client that is not open, or closed
        already. Ctrl-C skips no step except waiting for a hash.
        """
        self._thread.close()


class BlockingStream(Iterator[Item]):
    """Items as they arrive: a `for` loop waits for each. Ctrl-C loses none.

    Args:
        thread: the thread of the client.
        make: makes the asynchronous stream.
    """

    def __init__(self, thread: ClientThread, make: Callable[[], AsyncIterator[Any]]) -> None:
        self._thread = thread
        self._stream = [thread.make(make)]  # the only reference, which the event loop drops
        self._taken: deque[Any] = deque()
        weakref.finalize(self, thread.release, self._stream).atexit = False

    def __next__(self) -> Item:
        return self.next()

    def next(self, timeout: float | None = None) -> Item:
        """Return the next item.

        Args:
            timeout: seconds; None waits without limit.

        Raises:
            TimeoutError: no item arrived in time. None is lost: it remains for the next call.
            StopIteration: the stream has ended, as at the end of a log.
            ParamClientError: the stream has ended with this error.
        """
        while not self._taken:
            try:
                self._take_one(timeout)
            except StopAsyncIteration:
                raise StopIteration from None
        return self._made(self._taken.popleft())

    def _made(self, item: Any) -> Item:
        """Return an item as the caller is to see it."""
        made: Item = item
        return made

    def _take_one(self, timeout: float | None) -> None:
        """Move an item from the asynchronous stream, from which an interrupted call cannot return it."""

        async def take() -> None:
            self._taken.append(await anext(self._stream[0]))

        async def take_in_time() -> None:
            with anyio.fail_after(timeout):
                await take()

        if not self._thread.is_closed:
            self._thread.call(take_in_time)
            return
        with closing(take()) as taking, suppress(StopIteration):
            taking.send(None)  # it does not wait: the end of the stream is known


class LiveMapping(Mapping[Key, Value]):
    """A read-only mapping whose items are read from the client on each access.

    Args:
        find: returns the value of a key, or None.
        copy: returns a copy of the mapping; an iteration is one over a copy.
    """

    def __init__(self, find: Callable[[Key], Value | None], copy: Callable[[], Mapping[Key, Value]]) -> None:
        self._find = find
        self._copy = copy

    def __getitem__(self, key: Key) -> Value:
        found = self._find(key)
        if found is None:
            raise KeyError(key)
        return found

    def __iter__(self) -> Iterator[Key]:
        return iter(self._copy())

    def __len__(self) -> int:
        return len(self._copy())

    def items(self) -> ItemsView[Key, Value]:
        """Return the items of a copy."""
        return self._copy().items()

    def values(self) -> ValuesView[Value]:
        """Return the values of a copy."""
        return self._copy().values()

    def __repr__(self) -> str:
        return repr(self._copy())


def live_params(thread: ClientThread, params: ParamMap) -> ParamMap:
    """Return a view of a table that the event loop may change at any moment."""
    return ParamMap(LiveMapping(params.get, lambda: thread.read(lambda: copy_params(params))))


def live_mapping(thread: ClientThread, mapping: Mapping[Key, Value]) -> Mapping[Key, Value]:
    """Return a view of a mapping that the event loop may change at any moment."""
    return LiveMapping(mapping.get, lambda: thread.read(lambda: dict(mapping)))


def own_values(
    values: Mapping[str, Value] | Iterable[tuple[str, Value]],
) -> Mapping[str, Value] | Iterable[tuple[str, Value]]:
    """Return a copy of values: the caller's iterator may itself make blocking calls."""
    return dict(values) if isinstance(values, Mapping) else list(values)
