"""The serial ports of this computer, and which of them are autopilots by their USB ids."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from paramclient.links.names import DEFAULT_BAUD, LinkKind, LinkSpec
from paramclient.links.serial import need_serialx

__all__ = ["SerialPort", "list_ports"]

AUTOPILOT_VENDORS: Final = {
    0x26AC: "Pixhawk",  # 3D Robotics, and after it PX4's own boards
    0x27AC: "VRBrain",  # Laser Navigation
    0x2DAE: "CubePilot",
    0x3162: "Holybro",
    0x3185: "Pixhawk",  # Auterion: FMU v5X and later, ARK
}
"""Vendors of whom every serial port is an autopilot's.

From QGroundControl's list of boards (USBBoardInfo.json), and the USB_VENDOR of ArduPilot's (hwdef.dat).
"""

AUTOPILOTS: Final = {
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
"""Autopilots of vendors who make other things, or whose ids are shared. The sources are the same, and for
ArduPilot's own ids its chibios_hwdef.py."""

AUTOPILOT_MANUFACTURERS: Final = {
    "ArduPilot": "ArduPilot",
    "Hex/ProfiCNC": "CubePilot",
    "Holybro": "Holybro",
    "mRo": "mRo",
}
"""What autopilots call their manufacturer, where the ids are those that a chip has by default, as ST's
0483:5740. The source is QGroundControl's list of boards."""

OTHERS: Final = {(0x26AC, 0x0015)}
"""What is no autopilot although its vendor is one of those: the PX4 Flow, a sensor."""


@dataclass(frozen=True, slots=True)
class SerialPort:
    """A serial port of this computer. What it does not tell is None; its texts are the device's own.

    Attributes:
        device: its path or name, as `/dev/ttyACM0` or `COM5`.
        by_id: a path that stays the same wherever it is plugged in (Linux).
        vendor_id, product_id: its USB ids.
        manufacturer, product, serial_number: what it says of itself on USB.
        interface: which of several ports of one device this is.
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
        """The name of the link over it, with the default baud rate."""
        return LinkSpec(LinkKind.SERIAL, self.by_id or self.device, DEFAULT_BAUD).name

    @property
    def autopilot(self) -> str | None:
        """The make, if its USB ids, or its manufacturer, are those of an autopilot."""
        if self.vendor_id is None or self.product_id is None:
            return None
        ids = (self.vendor_id, self.product_id)
        if ids in OTHERS:
            return None
        return (
            AUTOPILOTS.get(ids)
            or AUTOPILOT_VENDORS.get(self.vendor_id)
            or AUTOPILOT_MANUFACTURERS.get(self.manufacturer or "")
        )


def list_ports() -> list[SerialPort]:
    """The serial ports of this computer: autopilots first, then other USB devices, each in order of names.

    It asks the system, which takes some milliseconds.

    Raises:
        UsageError: the extra `serial` is not installed.
    """
    need_serialx("a list of serial ports")
    import serialx  # only here: most programs need none

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


def _order(port: SerialPort) -> tuple[bool, bool, list[tuple[str, int]]]:
    parts = re.findall(r"(\D*)(\d*)", port.device)  # ttyUSB10 comes after ttyUSB9
    return (
        port.autopilot is None,
        port.vendor_id is None,
        [(text, int(number or 0)) for text, number in parts],
    )
