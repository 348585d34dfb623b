"""The subcommand ports: lists serial ports, and marks autopilots."""

from __future__ import annotations

from dataclasses import asdict

from paramclient.cli.output import ExitCode, show
from paramclient.links import list_ports


def ports(*, json: bool = False) -> ExitCode:
    """List the serial ports of this computer, autopilots first.

    Needs the extra `serial`: pip install 'paramclient[serial]'.

    Args:
        json: Print JSON.
    """
    found = [
        {
            **asdict(port),
            "link": port.link,
            "autopilot": port.autopilot,
            "vendor_id": None if port.vendor_id is None else f"{port.vendor_id:04x}",
            "product_id": None if port.product_id is None else f"{port.product_id:04x}",
        }
        for port in list_ports()
    ]
    columns = ["device", "autopilot", "product", "manufacturer", "vendor_id", "product_id", "link"]
    show(
        {"ports": found},
        columns,
        ([port[name] for name in columns] for port in found),
        json=json,
        empty="this computer has no serial ports",
    )
    return ExitCode.DONE
