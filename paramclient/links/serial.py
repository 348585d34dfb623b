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
import re
import sys
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import Any, Final, NamedTuple

import anyio
import anyio.lowlevel
import anyio.to_thread

from paramclient.errors import UsageError
from paramclient.links.link import OPEN_TIMEOUT, READ_SIZE, StreamLink, read_some, reason, write_all
from paramclient.links.names import DEFAULT_BAUD, LinkKind, LinkSpec

if sys.platform != "win32":
    import fcntl
    import termios

STALL_TIMEOUT: Final = 5.0
"""Seconds without progress, in addition to those that a full buffer takes at the port's rate, after which a
device counts as lost."""

SYSTEM_BUFFER: Final = 4096
"""Bytes that may wait in the operating system for a UART (Linux, UART_XMIT_SIZE)."""

BITS_PER_BYTE: Final = 10
"""Bits on the wire per byte, with start and stop bit."""

CLOSE_TIMEOUT: Final = 2.0
"""Seconds that closing waits for a driver. Unsent bytes are dropped before, so it rarely has to wait."""


class SerialLink(StreamLink):
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

    def __init__(self, spec: LinkSpec) -> None:
        need_serialx(spec.name)
        super().__init__(spec.name)
        self.device = spec.host
        self.baud = spec.port
        self._port: Port | None = None

    async def _read(self) -> bytes:
        assert self._port is not None
        return await self._port.read()

    async def _write(self, data: bytes) -> None:
        assert self._port is not None
        timeout = STALL_TIMEOUT + SYSTEM_BUFFER * BITS_PER_BYTE / self.baud
        with anyio.move_on_after(timeout):
            await self._port.write(data)
            return
        raise OSError(errno.ETIMEDOUT, f"{self.device} has accepted no data for {timeout:.0f} s")

    def _loss(self, error: OSError | None) -> str:
        if isinstance(error, TimeoutError):
            return reason(error)
        how = "hung up" if error is None else f"reset ({reason(error)})"
        return f"lost {self.device}: unplugged, or {how}"

    async def _open(self, opening: int) -> None:
        import serialx  # imported here: needs the extra, and takes long to load

        try:
            port = await open_port(self.device, self.baud)
        except serialx.UnsupportedSetting as error:
            raise UsageError(f"{self.device}: this system does not support {self.baud} baud") from error
        except RuntimeError as error:  # of drivers that do not report the rate that they set
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL)) from error
        if opening != self._openings:
            await port.close()
        self._check(opening)
        self._port = port

    async def _release(self) -> None:
        port, self._port = self._port, None
        if port is not None:
            await port.close()

    def _refusal(self, error: OSError) -> str:
        if isinstance(error, TimeoutError):
            return f"{self.device} did not open within {OPEN_TIMEOUT:g} s"
        ports = "'paramclient ports' lists the serial ports"
        if error.errno in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
            return f"{self.device} does not exist. {ports}"
        if error.errno == errno.EBUSY or (sys.platform == "win32" and error.errno == errno.EACCES):
            other = "another link or program, such as a ground station or ModemManager"
            return f"{self.device} is in use by {other}"
        if error.errno in (errno.EACCES, errno.EPERM):
            user = "Is the user in the group of the port (dialout or uucp)?"
            return f"no permission to open {self.device}. {user}"
        if error.errno in (errno.ENOTTY, errno.EISDIR):
            return f"{self.device} is not a serial port. {ports}"
        if error.errno == errno.EINVAL:
            return f"{self.device} cannot be set to {self.baud} baud"
        return super()._refusal(error)


class Port(NamedTuple):
    """An open port.

    Attributes:
        read: waits for bytes; b"" if the port has hung up.
        write: waits until the operating system has accepted all bytes.
        close: wakes waiting tasks, drops unsent bytes, closes. Takes at most `CLOSE_TIMEOUT`.
    """

    read: Callable[[], Awaitable[bytes]]
    write: Callable[[bytes], Awaitable[None]]
    close: Callable[[], Awaitable[None]]


async def open_port(device: str, baud: int) -> Port:
    """Open a port, as this system does."""
    if sys.platform == "win32":
        return await open_asyncio(device, baud)
    else:  # noqa: RET505 - with else, the type checker of each system skips the other branch
        # A driver may hang. A port that opens after the timeout is closed when its object is dropped.
        return await anyio.to_thread.run_sync(_open_descriptor, device, baud, abandon_on_cancel=True)


async def open_asyncio(device: str, baud: int) -> Port:
    """Open a port with serialx's asyncio interface, for Windows."""
    import serialx

    options: Any = {"baudrate": baud}
    port = serialx.async_serial_for_url(device, **options)
    await port.open()
    port.transport.set_write_buffer_limits(high=0)

    async def close() -> None:
        port.abort()
        with anyio.move_on_after(CLOSE_TIMEOUT, shield=True):
            await port.wait_closed()

    return Port(partial(port.read, READ_SIZE), port.write, close)


if sys.platform != "win32":

    def _open_descriptor(device: str, baud: int) -> Port:
        """Open a port as a non-blocking file descriptor. Opening and closing may block."""
        import serialx

        port = serialx.serial_for_url(device, baud)
        port.open()
        file = port.fileno()
        try:
            # serialx's lock is advisory; TIOCEXCL makes open fail for every other program.
            fcntl.ioctl(file, termios.TIOCEXCL)
        except OSError:
            port.close()
            raise

        async def close() -> None:
            anyio.notify_closing(file)
            with anyio.move_on_after(CLOSE_TIMEOUT, shield=True):
                await anyio.to_thread.run_sync(release, abandon_on_cancel=True)

        def release() -> None:
            with suppress(OSError, termios.error):  # the device may be unplugged
                termios.tcflush(file, termios.TCOFLUSH)  # otherwise close waits for it, 30 s on Linux
                fcntl.ioctl(file, termios.TIOCNXCL)  # a pseudo-terminal would stay exclusive
            with suppress(OSError):
                port.close()

        read = partial(read_some, file, partial(os.read, file))
        return Port(read, partial(write_all, file, partial(os.write, file)), close)


AUTOPILOT_VENDORS: Final = {
    0x26AC: "Pixhawk",  # 3D Robotics, and after it PX4's own boards
    0x27AC: "VRBrain",  # Laser Navigation
    0x2DAE: "CubePilot",
    0x3162: "Holybro",
    0x3185: "Pixhawk",  # Auterion: FMU v5X and later, ARK
}
"""USB vendors with only autopilots.

Sources: QGroundControl's list of boards (USBBoardInfo.json), and ArduPilot's USB_VENDOR (hwdef.dat).
"""

AUTOPILOT_DEVICES: Final = {
    (0x0483, 0x0037): "SmartAP AIRLink",
    (0x0483, 0xA32F): "ModalAI",
    (0x0483, 0xA330): "ModalAI",
    (0x1008, 0x0001): "UVify Core",
    (0x1209, 0x5740): "ArduPilot",  # with two ports on one USB: the second may be for CAN
    (0x1209, 0x5741): "ArduPilot",
    (0x1B8C, 0x0036): "Pixhawk",  # FMU v6U
    (0x1FC9, 0x001C): "NXP FMUK66",
    (0x3163, 0x004C): "CUAV",
    (0x35A7, 0x0001): "ThePeach",
    (0x35A7, 0x0002): "ThePeach",
    (0x3643, 0x001D): "Pixhawk",  # FMU v6X-RT
    (0x26AC, 0x0015): None,  # PX4 Flow, a sensor
}
"""Devices of vendors with other products too, or with shared ids; None is no autopilot. Sources: as for
`AUTOPILOT_VENDORS`, and ArduPilot's chibios_hwdef.py for its own ids."""

AUTOPILOT_MANUFACTURERS: Final = {
    "ArduPilot": "ArduPilot",
    "Hex/ProfiCNC": "CubePilot",
    "Holybro": "Holybro",
    "mRo": "mRo",
}
"""Manufacturer texts of autopilots with the default ids of a chip, such as ST's 0483:5740. Source:
QGroundControl's list of boards."""


@dataclass(frozen=True, slots=True)
class SerialPort:
    """A serial port of this computer. Unknown attributes are None; texts are those of the device.

    Attributes:
        device: the path or name, such as `/dev/ttyACM0` or `COM5`.
        by_id: a path that is the same on every USB socket (Linux).
        vendor_id, product_id: the USB ids.
        manufacturer, product, serial_number: the texts of the USB descriptor.
        interface: the number of the port on a device with several ports.
    """

    device: str
    by_id: str | None = None
    vendor_id: int | None = None
    product_id: int | None = None
    manufacturer: str | None = None
    product: str | None = None
    serial_number: str | None = None
    interface: int | None = None

    @property
    def link(self) -> str:
        """The link name of the port, with the default baud rate."""
        return LinkSpec(LinkKind.SERIAL, self.by_id or self.device, DEFAULT_BAUD).name

    @property
    def autopilot(self) -> str | None:
        """The make, if the USB ids or the manufacturer are those of an autopilot; else None."""
        if self.vendor_id is None or self.product_id is None:
            return None
        ids = (self.vendor_id, self.product_id)
        make = AUTOPILOT_VENDORS.get(self.vendor_id) or AUTOPILOT_MANUFACTURERS.get(self.manufacturer or "")
        return AUTOPILOT_DEVICES.get(ids, make)


def list_ports() -> list[SerialPort]:
    """Return the serial ports of this computer: autopilots first, then other USB devices, sorted by name.

    Queries the operating system, which takes some milliseconds.

    Raises:
        UsageError: the extra `serial` is not installed.
    """
    need_serialx("a list of serial ports")
    import serialx  # imported here because it needs the extra

    found = [
        SerialPort(
            each.resolved_device,
            None if each.device == each.resolved_device else each.device,
            *(each.vid, each.pid, each.manufacturer, each.product, each.serial_number, each.interface_num),
        )
        for each in serialx.list_serial_ports()
    ]
    return sorted(found, key=_order)


def need_serialx(what: str) -> None:
    """Raise UsageError with the command that installs the extra, if serialx is missing."""
    if find_spec("serialx") is None:
        raise UsageError(f"{what} needs serialx: pip install 'paramclient[serial]'")


def _order(port: SerialPort) -> tuple[bool, bool, list[tuple[str, int]]]:
    parts = re.findall(r"(\D*)(\d*)", port.device)  # sorts ttyUSB10 after ttyUSB9
    return (
        port.autopilot is None,
        port.vendor_id is None,
        [(text, int(number or 0)) for text, number in parts],
    )
