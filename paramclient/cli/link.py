"""The subcommands link, with components, message rates and packet loss of a link, and ports."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict
from typing import Final

import anyio

from paramclient.cli.json_output import JsonObject, taken
from paramclient.cli.options import Seconds, TrafficOptions
from paramclient.cli.output import (
    clear_screen,
    milliseconds,
    print_json,
    print_line,
    print_table,
    show,
)
from paramclient.cli.session import Deadline, listen, received_in_words
from paramclient.client.client import ParamClient
from paramclient.client.component import Component
from paramclient.client.taps import ComponentTraffic, TrafficReport
from paramclient.errors import NoReply, ParamClientError
from paramclient.links import list_ports
from paramclient.model.identity import autopilot_name
from paramclient.model.notation import rounded
from paramclient.protocol.channel import task_group
from paramclient.wire.frames import enum_word, message_name

LINK_LISTENING_TIME: Final = 5.0
"""Seconds to listen without --seconds, if the output is not a terminal."""
REFRESH_INTERVAL: Final = 0.25
"""Seconds between two updates of the table."""
MESSAGES_SHOWN_MAX: Final = 5
"""Kinds of messages that a line names for each component, so that it stays short."""
MEASURE_DELAY: Final = 2.0
"""Seconds until the first read that measures the round trip: by then all components have been heard."""
MEASURE_INTERVAL: Final = 4.0
"""Seconds between two reads that measure the round trip: request and response together take less of the link
than the heartbeats of this client."""
_DEFAULTS: Final = TrafficOptions()


async def link(
    url: str,
    /,
    *,
    seconds: Seconds = None,
    listen_only: bool = False,
    options: TrafficOptions = _DEFAULTS,
) -> None:
    """Print the components on a link, their message rates and the packet loss.

    On a terminal the table is live until Ctrl-C. Otherwise, and with --json, it is printed once, after
    --seconds (default 5). Packet loss is computed from the gaps in the frames' sequence numbers.

    Args:
        url: The link, such as udpin:0.0.0.0:14550, tcp:HOST:PORT or sim:px4.
        seconds: Time to listen in seconds.
        listen_only: Send nothing. The round trip is then not measured.
    """
    is_live = sys.stdout.isatty() and not options.json
    limit = seconds if is_live or seconds is not None else LINK_LISTENING_TIME
    async with listen(url, options, listen_only=listen_only) as client, task_group() as tasks:
        tasks.start_soon(_measure_round_trips, client)
        deadline = Deadline(limit)
        while True:
            report = client.traffic_report()  # raises if the link has failed
            found = _json(client, report)
            if is_live:
                clear_screen()
                _print(found)
            if not (left := deadline.left(REFRESH_INTERVAL)):
                break
            await anyio.sleep(left)
        tasks.cancel_scope.cancel()
        if not found["frames"]:
            what, hint = f"a MAVLink frame on {client.link.name}", received_in_words(client)
            raise NoReply(what, attempts=0, waited=report.seconds, hint=hint)
    if options.json:
        print_json(found)
    elif not is_live:
        _print(found)


async def _measure_round_trips(client: ParamClient) -> None:
    """Read a value of each component with an autopilot every `MEASURE_INTERVAL`, until cancelled."""

    async def read(component: Component) -> None:
        with suppress(ParamClientError):
            await component.get(0, timeout=MEASURE_INTERVAL)

    await anyio.sleep(MEASURE_DELAY)
    async with anyio.create_task_group() as tasks:
        while True:
            for component in client.autopilots:
                tasks.start_soon(read, component)
            await anyio.sleep(MEASURE_INTERVAL)


# JSON


def _json(client: ParamClient, report: TrafficReport) -> JsonObject:
    signing = client.signing_report()
    names = ("fingerprint", "policy", "link_id", "signed", "unsigned", "unproven", "refused")
    return {
        "link": client.link.name,
        "seconds": round(report.seconds, 3),
        "bytes_received": report.totals["received"],
        "bytes_sent": report.totals["sent"],
        "received_per_s": round(report.recent["received"], 1),
        "sent_per_s": round(report.recent["sent"], 1),
        "frames": report.totals["frames"],
        "unknown": report.totals["unknown"],
        **taken(report, "damaged", "other_bytes"),
        "signing": None if signing is None else taken(signing, *names),
        "components": [_component_json(client, report.at, each) for each in report.components],
    }


def _component_json(client: ParamClient, now: float, each: ComponentTraffic) -> JsonObject:
    beat, component = each.heartbeat, client.components.get((each.system, each.component))
    return {
        **taken(each, "system", "component"),
        "mavlink": each.version,
        "autopilot": None if beat is None else autopilot_name(beat.autopilot),
        "type": None if beat is None else enum_word("MAV_TYPE", beat.type),
        "state": None if beat is None else enum_word("MAV_STATE", beat.system_status),
        "heartbeat_age_s": None if each.heartbeat_at is None else rounded(now - each.heartbeat_at),
        "age_s": round(now - each.received_at, 4),
        **{name: each.totals[name] for name in ("frames", "bytes", "lost", "repeated", "late", "signed")},
        "frames_per_s": round(each.recent["frames"], 2),
        "bytes_per_s": round(each.recent["bytes"], 1),
        "loss": rounded(each.loss),
        "round_trip_s": None if component is None else rounded(component.round_trip),
        "messages": {
            message_name(message): {
                "id": message,
                "count": each.totals[message],
                "per_s": round(each.recent[message], 2),
            }
            for message in each.messages
        },
        "radio": each.radio,
    }


# Tables

_COLUMNS: Final = ("from", "what", "v", "frames/s", "bytes/s", "loss", "round trip", "heartbeat")
"""Columns of the table of components."""


def _print(found: JsonObject) -> None:
    print_table(_COLUMNS, map(_row, found["components"]))
    for line in _lines(found):
        print_line(line)


def _row(each: JsonObject) -> tuple[object, ...]:
    names = [each["autopilot"], each["type"]] if each["autopilot"] != "no autopilot" else [each["type"]]
    trip, age = each["round_trip_s"], each["heartbeat_age_s"]
    return (
        f"{each['system']}/{each['component']}",
        " ".join(dict.fromkeys(filter(None, names))) or ("radio" if each["radio"] else ""),
        each["mavlink"],
        f"{each['frames_per_s']:.1f}",
        f"{each['bytes_per_s']:,.0f}",
        None if each["loss"] is None else f"{each['loss']:.1%}",
        None if trip is None else milliseconds(trip),
        None if age is None else f"{age:.1f} s",
    )


def _lines(found: JsonObject) -> Iterator[str]:
    yield ""
    for each in found["components"]:
        rates = {name: count["per_s"] for name, count in each["messages"].items() if count["per_s"]}
        shown = [f"{name} {rate:.1f}/s" for name, rate in [*rates.items()][:MESSAGES_SHOWN_MAX]]
        more = f" and {len(rates) - len(shown)} more" if len(rates) > len(shown) else ""
        state = f" {each['state']}" if each["state"] else ""
        yield f"{each['system']}/{each['component']}{state}: {', '.join(shown) or 'silent'}{more}"
        if radio := each["radio"]:
            yield (
                f"  signal {radio['rssi']} here, {radio['remote_rssi']} there; noise {radio['noise']} and "
                f"{radio['remote_noise']}; buffer {radio['free']} % free; {radio['errors']} packets with "
                f"errors, {radio['fixed']} corrected"
            )
    yield ""
    yield (
        f"{found['link']}, {found['seconds']:.1f} s: {found['received_per_s']:,.0f} bytes/s received, "
        f"{found['sent_per_s']:,.0f} sent"
    )
    lost, signed = (sum(each[name] for each in found["components"]) for name in ("lost", "signed"))
    yield (
        f"{found['frames']:,} frames, {lost:,} lost, {found['damaged']:,} with a wrong checksum, "
        f"{found['unknown']:,} of unknown ids, {signed:,} signed; {found['other_bytes']:,} other bytes"
    )
    if signing := found["signing"]:
        others = [
            f", {count:,} {what}: {reason}"
            for name, what in (("unproven", "accepted"), ("refused", "refused"))
            for reason, count in signing[name].items()
        ]
        yield f"key {signing['fingerprint']}: {signing['signed']:,} frames proven{''.join(others)}"


# ports


def ports(*, json: bool = False) -> None:
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
