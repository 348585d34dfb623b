"""The interface of links, and their base classes.

The sockets are non-blocking and used with `anyio.wait_readable`, because anyio's own UDP socket keeps 100
datagrams and drops all others silently. `close` takes effect immediately: it wakes waiting tasks and frees
the port before it returns, and no transport, task or thread outlives it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable
from contextlib import suppress
from typing import Any, Final, NoReturn, Protocol, TypeAlias, runtime_checkable

import anyio
import anyio.lowlevel

from paramclient.errors import LinkError

Peer: TypeAlias = Hashable
"""The sender of data: an address on UDP, a connection on TCP, a constant on links with one remote end."""

READ_SIZE: Final = 65536
"""Bytes that are read at once, at most: of one connection before the next one is read. Of a serial port,
Linux holds 4,095 for a reader, and bytes that arrive meanwhile in the driver."""
OPEN_TIMEOUT: Final = 5.0
"""Seconds for resolving a name and connecting. A TCP connection on a slow radio takes about 1 s."""


@runtime_checkable
class Link(Protocol):
    """A link: receives and sends bytes.

    One task may wait in `receive` and one in `send` at a time; a third may call `open` and `close`. Every
    call may be cancelled: data that had arrived by then stays for the next `receive`.
    """

    @property
    def name(self) -> str:
        """The canonical name; equal for all spellings of the same link."""

    @property
    def is_stream(self) -> bool:
        """Whether the link is a byte stream; otherwise it delivers datagrams, which are never joined."""

    @property
    def reconnects(self) -> bool:
        """Whether `open` may restore the link after a LinkError of `receive` or `send`."""

    async def open(self) -> None:
        """Open the link. LinkError if that fails; its cause is the operating system's error."""

    async def receive(self) -> list[tuple[Peer, bytes]]:
        """Wait for data; return all received data with its peers, in order of arrival.

        Empty bytes mean that the peer has disconnected (streams only). An empty list means that there will be
        no more data, as at the end of a log: the next call waits for `close`. LinkError: the link dropped,
        was closed, or is not open.
        """

    async def send(self, data: bytes, peer: Peer | None) -> None:
        """Send to a peer, or with None to all known peers.

        Does nothing if there is no known peer, or the peer has disconnected. LinkError: the link dropped or
        is not open.
        """

    async def close(self) -> None:
        """Close the link and release its resources. A waiting `receive` raises LinkError. Idempotent."""


class BaseLink(ABC):
    """Base class of all links here: name, opening and closing, and errors.

    Attributes:
        name: the canonical name.
        is_stream: see `Link.is_stream`.
        reconnects: see `Link.reconnects`.
    """

    is_stream = False
    reconnects = True

    def __init__(self, name: str) -> None:
        self.name = name
        self._is_open = False
        self._openings = 0
        self._close_reason: tuple[str, OSError | None] = ("closed", None)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name} {'open' if self._is_open else 'closed'}>"

    async def open(self) -> None:
        """See `Link.open`; an open link is closed first."""
        await self._end("closed")
        opening = self._openings
        try:
            with anyio.fail_after(OPEN_TIMEOUT):
                await self._open(opening)
        except BaseException as error:
            if opening == self._openings:
                await self._end("closed")
            elif isinstance(error, OSError | anyio.ClosedResourceError):
                self._check(opening)
            if isinstance(error, OSError) and not isinstance(error, LinkError):
                raise self._error(self._refusal(error)) from error
            raise
        self._is_open = True

    async def close(self) -> None:
        """See `Link.close`."""
        await self._end("closed")

    @abstractmethod
    async def _open(self, opening: int) -> None:
        """Open the link; an OSError becomes a LinkError with the text of `_refusal`.

        `_check` of `opening` fails once the link has been closed meanwhile.
        """

    @abstractmethod
    async def _release(self) -> None:
        """Release what `_open` has opened, and wake waiting tasks. Idempotent."""

    def _refusal(self, error: OSError) -> str:
        return f"cannot open: {reason(error)}"

    async def _end(self, problem: str, cause: OSError | None = None) -> None:
        """Close the link. An `open` in progress fails from now on."""
        self._openings += 1
        self._close_reason = (problem, cause)
        self._is_open = False
        await self._release()

    async def _fail(self, opening: int, problem: str, cause: OSError | None = None) -> NoReturn:
        """Close the link because of an error, unless already closed; waiting tasks get the same LinkError."""
        self._check(opening)
        await self._end(problem, cause)
        raise self._error(problem) from cause

    def _opened(self) -> int:
        """Return the number of this opening; LinkError if the link is not open."""
        if not self._is_open:
            raise self._error("not open")
        return self._openings

    def _check(self, opening: int) -> None:
        """Raise LinkError if the link has been closed since it was opened as `opening`."""
        if opening != self._openings:
            problem, cause = self._close_reason
            raise self._error(problem) from cause

    def _error(self, problem: str) -> LinkError:
        return LinkError(f"{self.name}: {problem}", link=self.name)


class StreamLink(BaseLink):
    """Base class of byte streams with one remote end.

    Each opening has another peer, so that half a frame received before is not continued with later bytes.
    """

    is_stream = True

    async def receive(self) -> list[tuple[Peer, bytes]]:
        """See `Link.receive`: one chunk."""
        opening = self._opened()
        data = b""
        try:
            with suppress(anyio.ClosedResourceError):
                data = await self._read()
        except OSError as error:
            await self._fail(opening, self._loss(error), error)
        if not data:
            await self._fail(opening, self._loss(None))
        return [((self.name, opening), data)]

    async def send(self, data: bytes, peer: Peer | None) -> None:
        """See `Link.send`. Waits for space until a timeout; then the link counts as dropped.

        After cancellation, a part may have been sent.
        """
        await anyio.lowlevel.checkpoint()
        opening = self._opened()
        if peer in (None, (self.name, opening)):
            try:
                with suppress(anyio.ClosedResourceError):
                    await self._write(data)
            except OSError as error:
                await self._fail(opening, self._loss(error), error)
            self._check(opening)

    @abstractmethod
    async def _read(self) -> bytes:
        """Wait for bytes; return b"" if the remote end has closed the link.

        OSError: the link dropped. ClosedResourceError: it was closed meanwhile.
        """

    @abstractmethod
    async def _write(self, data: bytes) -> None:
        """Send all bytes; errors as in `_read`, also if there is no space until a timeout."""

    @abstractmethod
    def _loss(self, error: OSError | None) -> str:
        """Return why the link has dropped: an error, or None where the remote end has closed it."""


async def read_some(source: Any, read: Callable[[int], bytes]) -> bytes:
    """Wait for bytes of a socket or a file descriptor, and read them without blocking."""
    while True:
        await anyio.wait_readable(source)
        with suppress(BlockingIOError):
            return read(READ_SIZE)


async def write_all(target: Any, write: Callable[[memoryview], int], data: bytes) -> None:
    """Write all bytes to a socket or a file descriptor without blocking; wait for space."""
    view = memoryview(data)
    while view:
        try:
            view = view[write(view) :]
        except BlockingIOError:
            await anyio.wait_writable(target)


def reason(error: OSError) -> str:
    """Return the operating system's text for an error, without its number."""
    return error.strerror or str(error)
