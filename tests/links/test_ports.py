"""The list of serial ports: detection of autopilots, and the output of the command line."""

from __future__ import annotations

from typing import Any

import pytest
import serialx

from paramclient.links import SerialPort, create_link, list_ports

BY_ID = "/dev/serial/by-id/usb-Hex_ProfiCNC_CubeOrange_2E0045-if00"
CUBE = {"manufacturer": "Hex/ProfiCNC", "product": "CubeOrange", "serial_number": "2E0045"}


def info(device: str, **known: Any) -> serialx.SerialPortInfo:
    """Return a port as serialx describes it."""
    texts = ("serial_number", "manufacturer", "product", "interface_description")
    fields: dict[str, Any] = dict.fromkeys(("vid", "pid", "bcd_device", "interface_num", *texts))
    fields |= {"device": device, "resolved_device": device}
    return serialx.SerialPortInfo(**fields | known)


def a_few() -> list[serialx.SerialPortInfo]:
    return [
        info("/dev/ttyS0"),
        info("/dev/ttyUSB10", vid=0x0403, pid=0x6001, manufacturer="FTDI", product="FT232R USB UART"),
        info("/dev/ttyUSB9", vid=0x10C4, pid=0xEA60, product="CP2102\x1b[31m", serial_number="0001"),
        info(BY_ID, resolved_device="/dev/ttyACM1", vid=0x2DAE, pid=0x1016, interface_num=0, **CUBE),
    ]


def test_autopilots_are_first_then_usb_devices(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serialx, "list_serial_ports", a_few)
    found = list_ports()
    assert [port.device for port in found] == ["/dev/ttyACM1", "/dev/ttyUSB9", "/dev/ttyUSB10", "/dev/ttyS0"]
    assert found[0] == SerialPort("/dev/ttyACM1", BY_ID, 0x2DAE, 0x1016, interface=0, **CUBE)
    assert [port.autopilot for port in found] == ["CubePilot", None, None, None]
    assert found[-1] == SerialPort("/dev/ttyS0")
    assert [port.link for port in found[:2]] == [f"serial:{BY_ID}:57600", "serial:/dev/ttyUSB9:57600"]
    assert all(create_link(port.link).name == port.link for port in found)


@pytest.mark.parametrize(
    ("vendor", "product", "manufacturer", "autopilot"),
    [
        (0x26AC, 0x0011, "3D Robotics", "Pixhawk"),
        (0x26AC, 0x0015, "3D Robotics", None),
        (0x2DAE, 0x1058, "CubePilot", "CubePilot"),
        (0x1209, 0x5740, "ArduPilot", "ArduPilot"),
        (0x1209, 0x0001, "Example Robotics", None),
        (0x10C4, 0xEA60, "Silicon Labs", None),
        (0x0483, 0x5740, "mRo", "mRo"),
        (0x0483, 0x5740, "STMicroelectronics", None),
    ],
)
def test_detection_of_autopilots(vendor: int, product: int, manufacturer: str, autopilot: str | None) -> None:
    port = SerialPort("COM5", vendor_id=vendor, product_id=product, manufacturer=manufacturer)
    assert port.autopilot == autopilot
