"""The subcommand ports: lists serial ports, and marks autopilots."""

from __future__ import annotations

from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.output import show
from paramclient.links import SerialPort, list_ports

__all__ = ["ports"]


def ports(*, json: bool = False) -> ExitCode:
    """List the serial ports of this computer, autopilots first.

    Needs the extra `serial`: pip install 'paramclient[serial]'.

    Args:
        json: Print JSON.
    """
    found = list_ports()
    show(
        {"ports": [_port_json(port) for port in found]},
        ["device", "autopilot", "product", "manufacturer", "usb id", "link"],
        map(_port_cells, found),
        json=json,
        empty="this computer has no serial ports",
    )
    return ExitCode.DONE


def _port_json(port: SerialPort) -> dict[str, object]:
    return {
        "device": port.device,
        "by_id": port.by_id,
        "link": port.link,
        "autopilot": port.autopilot,
        "vendor_id": _hex(port.vendor_id),
        "product_id": _hex(port.product_id),
        "manufacturer": port.manufacturer,
        "product": port.product,
        "serial_number": port.serial_number,
        "interface": port.interface,
    }


def _port_cells(port: SerialPort) -> tuple[object, ...]:
    usb_id = None if port.vendor_id is None else f"{_hex(port.vendor_id)}:{_hex(port.product_id)}"
    return port.device, port.autopilot, port.product, port.manufacturer, usb_id, port.link


def _hex(number: int | None) -> str | None:
    return None if number is None else f"{number:04x}"
