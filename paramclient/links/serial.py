"""Links over serial ports: an autopilot on USB, a telemetry radio, a UART.

The library serialx, which the extra `serial` installs, opens and configures the port: 8 data bits, no parity,
one stop bit, no flow control. The default and the limits of the baud rate are in `names`. On POSIX systems,
bytes then go through the port's non-blocking file descriptor, like through the sockets of other links, on
every event loop that anyio supports. Windows has no such descriptors: there serialx's asyncio interface moves
the bytes.

An open port is exclusive: two programs on one port would each receive a part of the bytes. DTR and RTS are
raised on opening, and lowered when the last program closes the port. Linux and pyserial do the same, and with
pyserial also pymavlink and MAVProxy, so a board is not reset more often than by those programs.

A port that fails or is unplugged raises LinkError here. `paramclient.client.link_task` opens it again.
"""

from __future__ import annotations

import errno
import os
import sys
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol

import anyio
import anyio.lowlevel
import anyio.to_thread

from paramclient.errors import UsageError
from paramclient.links.link import OPEN_TIMEOUT, BaseLink, Peer
from paramclient.links.names import LinkSpec
from paramclient.links.ports import need_serialx
from paramclient.links.refusals import device_refusal, reason

if sys.platform != "win32":
    import fcntl
    import termios

if TYPE_CHECKING:
    import serialx

READ_SIZE: Final = 65536
"""Bytes per read. Linux holds 4,095 for a reader, and bytes that arrive meanwhile in the driver."""

STALL_TIMEOUT: Final = 5.0
"""Seconds without progress, in addition to those that a full buffer takes at the port's rate, after which a
device counts as lost."""

SYSTEM_BUFFER: Final = 4096
"""Bytes that may wait in the operating system for a UART (Linux, UART_XMIT_SIZE)."""

BITS_PER_BYTE: Final = 10
"""Bits on the wire per byte, with start and stop bit."""

CLOSE_TIMEOUT: Final = 2.0
"""Seconds that closing waits for a driver. Unsent bytes are dropped before, so it rarely has to wait."""


class SerialDevice(NamedTuple):
    """A serial port as a peer. The number changes with each opening, so that half a frame received before
    unplugging is not continued with later bytes."""

    number: int
    path: str


class SerialLink(BaseLink):
    """`serial`: one serial port. `open` restores the link after the device was unplugged.

    The link has no queue. If the operating system's buffer is full, a frame waits for space, so a slow port
    limits the send rate. A port that accepts no bytes for `STALL_TIMEOUT` counts as lost: waiting calls end,
    the user gets an error, and opening the port again empties the buffer.

    Attributes:
        device: the path, or the name on Windows.
        baud: bits per second; ignored by devices that are themselves USB.

    Raises:
        UsageError: the extra `serial` is not installed.
    """

    is_stream = True

    def __init__(self, spec: LinkSpec) -> None:
        need_serialx(spec.name)
        super().__init__(spec.name)
        self.device = spec.host
        self.baud = spec.port
        self._port: _Port | None = None
        self._peer = SerialDevice(0, spec.host)

    async def receive(self) -> list[tuple[Peer, bytes]]:
        """See `Link.receive`: one chunk of up to `READ_SIZE` bytes."""
        opening = self._opened()
        assert self._port is not None
        try:
            data = await self._port.read()
        except OSError as error:
            await self._fail(opening, f"lost {self.device}: unplugged, or reset ({reason(error)})", error)
        if not data:
            await self._fail(opening, f"lost {self.device}: unplugged, or hung up")
        return [(self._peer, data)]

    async def send(self, data: bytes, peer: Peer | None) -> None:
        """See `Link.send`. Waits for space until `STALL_TIMEOUT`; then the port counts as lost.

        After cancellation, a part may have been sent.
        """
        await anyio.lowlevel.checkpoint()
        opening = self._opened()
        assert self._port is not None
        if peer not in (None, self._peer):
            return
        timeout = STALL_TIMEOUT + SYSTEM_BUFFER * BITS_PER_BYTE / self.baud
        with anyio.move_on_after(timeout) as wait:
            try:
                await self._port.write(data)
            except OSError as error:
                await self._fail(opening, f"lost {self.device}: unplugged, or reset ({reason(error)})", error)
        if wait.cancelled_caught:
            await self._fail(opening, f"{self.device} has accepted no data for {timeout:.0f} s")
        self._check(opening)

    async def _open(self, opening: int) -> None:
        port = await open_port(self.device, self.baud)
        if opening != self._openings:
            await port.close()
        self._check(opening)
        self._port = port
        self._peer = self._peer._replace(number=self._peer.number + 1)

    async def _release(self) -> None:
        port, self._port = self._port, None
        if port is not None:
            await port.close()

    def _refusal(self, error: OSError) -> str:
        if isinstance(error, TimeoutError):
            return f"{self.device} did not open within {OPEN_TIMEOUT:g} s"
        return device_refusal(self.device, self.baud, error)


class _Port(Protocol):
    """An open port."""

    async def read(self) -> bytes:
        """Wait for bytes; return b"" if the port has hung up, or is closed meanwhile."""

    async def write(self, data: bytes) -> None:
        """Wait until the operating system has accepted all bytes, or the port is closed."""

    async def close(self) -> None:
        """Wake waiting tasks, drop unsent bytes, close. Not cancellable; takes at most `CLOSE_TIMEOUT`."""


async def open_port(device: str, baud: int) -> _Port:
    """Open a port.

    Raises:
        OSError, UsageError: it cannot be opened.
    """
    import serialx  # imported here: needs the extra, and takes long to load

    try:
        return await open_here(device, baud)
    except serialx.UnsupportedSetting as error:
        raise UsageError(f"{device}: this system does not support {baud} baud") from error
    except RuntimeError as error:  # of drivers that do not report the rate that they set
        raise OSError(errno.EINVAL, os.strerror(errno.EINVAL)) from error


async def open_here(device: str, baud: int) -> _Port:
    """Open a port, as this system does."""
    if sys.platform == "win32":
        return await AsyncioPort.opened(device, baud)
    else:  # noqa: RET505 - with else, the type checker of each system skips the other branch
        # A driver may hang. A port that opens after the timeout is closed when its object is dropped.
        return await anyio.to_thread.run_sync(_Descriptor, device, baud, abandon_on_cancel=True)


class AsyncioPort:
    """A port of serialx's asyncio interface, for Windows."""

    def __init__(self, port: serialx.AsyncSerial) -> None:
        self._port = port

    @classmethod
    async def opened(cls, device: str, baud: int) -> AsyncioPort:
        """Open a port. OSError if that fails."""
        import serialx

        options: Any = {"baudrate": baud}
        port = serialx.async_serial_for_url(device, **options)
        await port.open()
        port.transport.set_write_buffer_limits(high=0)
        return cls(port)

    async def read(self) -> bytes:
        """See `_Port`."""
        return await self._port.read(READ_SIZE)

    async def write(self, data: bytes) -> None:
        """See `_Port`."""
        await self._port.write(data)

    async def close(self) -> None:
        """See `_Port`."""
        self._port.abort()
        with anyio.move_on_after(CLOSE_TIMEOUT, shield=True):
            await self._port.wait_closed()


if sys.platform != "win32":

    class _Descriptor:
        """A port as a non-blocking file descriptor. Opening and closing may block."""

        def __init__(self, device: str, baud: int) -> None:
            import serialx

            self._serial = serialx.serial_for_url(device, baud)
            self._serial.open()
            self._file = self._serial.fileno()
            try:
                # serialx's lock is advisory; TIOCEXCL makes open fail for every other program.
                fcntl.ioctl(self._file, termios.TIOCEXCL)
            except OSError:
                self._serial.close()
                raise

        async def read(self) -> bytes:
            with suppress(anyio.ClosedResourceError):
                while True:
                    await anyio.wait_readable(self._file)
                    with suppress(BlockingIOError):
                        return os.read(self._file, READ_SIZE)
            return b""

        async def write(self, data: bytes) -> None:
            view = memoryview(data)
            with suppress(anyio.ClosedResourceError):
                while view:
                    try:
                        view = view[os.write(self._file, view) :]
                    except BlockingIOError:
                        await anyio.wait_writable(self._file)

        async def close(self) -> None:
            anyio.notify_closing(self._file)
            with anyio.move_on_after(CLOSE_TIMEOUT, shield=True):
                await anyio.to_thread.run_sync(self._release, abandon_on_cancel=True)

        def _release(self) -> None:
            with suppress(OSError, termios.error):  # the device may be unplugged
                termios.tcflush(self._file, termios.TCOFLUSH)  # otherwise close waits for it, 30 s on Linux
                fcntl.ioctl(self._file, termios.TIOCNXCL)  # a pseudo-terminal would stay exclusive
            with suppress(OSError):
                self._serial.close()
