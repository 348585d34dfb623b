"""The serial ports of this computer, and detection of autopilots by their USB ids."""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Final

from paramclient.errors import UsageError
from paramclient.links.names import DEFAULT_BAUD, LinkKind, LinkSpec

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
}
"""Autopilots of vendors with other products too, or with shared ids. Sources: as for `AUTOPILOT_VENDORS`, and
ArduPilot's chibios_hwdef.py for its own ids."""

AUTOPILOT_MANUFACTURERS: Final = {
    "ArduPilot": "ArduPilot",
    "Hex/ProfiCNC": "CubePilot",
    "Holybro": "Holybro",
    "mRo": "mRo",
}
"""Manufacturer texts of autopilots with the default ids of a chip, such as ST's 0483:5740. Source:
QGroundControl's list of boards."""

OTHER_DEVICES: Final = {(0x26AC, 0x0015)}
"""Devices of autopilot vendors that are not autopilots: the PX4 Flow, a sensor."""


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
        if ids in OTHER_DEVICES:
            return None
        return (
            AUTOPILOT_DEVICES.get(ids)
            or AUTOPILOT_VENDORS.get(self.vendor_id)
            or AUTOPILOT_MANUFACTURERS.get(self.manufacturer or "")
        )


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
            device=each.resolved_device,
            by_id=None if each.device == each.resolved_device else each.device,
            vendor_id=each.vid,
            product_id=each.pid,
            manufacturer=each.manufacturer,
            product=each.product,
            serial_number=each.serial_number,
            interface=each.interface_num,
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
