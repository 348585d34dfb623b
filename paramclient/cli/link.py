"""The subcommands link, with components, message rates and packet loss of a link, and ports."""

from __future__ import annotations

import sys
from contextlib import suppress
from dataclasses import asdict
from typing import Final

import anyio

from paramclient.cli.json_output import JsonObject, taken
from paramclient.cli.options import Seconds, TrafficOptions
from paramclient.cli.output import milliseconds, print_json, print_line, print_table, say, show
from paramclient.cli.session import Deadline, open_client, received_in_words
from paramclient.client.client import ParamClient
from paramclient.client.component import Component
from paramclient.client.taps import ComponentTraffic, TrafficReport
from paramclient.errors import NoReply, ParamClientError
from paramclient.links import list_ports
from paramclient.model.identity import autopilot_name
from paramclient.model.names import first_of
from paramclient.model.notation import rounded
from paramclient.protocol.channel import task_group
from paramclient.protocol.identity import kind_in_words
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


async def link(
    url: str,
    /,
    *,
    seconds: Seconds = None,
    listen_only: bool = False,
    options: TrafficOptions = TrafficOptions(),
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
    opened, found = open_client(url, options, cache=False, traffic=True, listen_only=listen_only), None
    async with opened as client, task_group() as tasks:
        deadline = Deadline(seconds, None if is_live else LINK_LISTENING_TIME)  # opening takes its own time
        tasks.start_soon(_measure_round_trips, client)
        try:
            while left := deadline.left(REFRESH_INTERVAL):
                await anyio.sleep(left)
                report = client.traffic_report(is_recent=is_live)  # raises if the link has failed
                found = _json(client, report)
                if is_live:
                    sys.stdout.write("\x1b[H\x1b[J")  # erases it, for the next table in the same place
                    _print(found)
        except anyio.get_cancelled_exc_class():
            say(f"interrupted. {received_in_words(client)}")
            raise
        finally:
            if found and found["frames"] and not is_live:
                (print_json if options.json else _print)(found)
        tasks.cancel_scope.cancel()
        if not (found and found["frames"]):
            what, hint = f"a MAVLink frame on {client.link.name}", received_in_words(client)
            raise NoReply(what, attempts=0, waited=client.traffic_report().seconds, hint=hint)


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


def _json(client: ParamClient, report: TrafficReport) -> JsonObject:
    signing = client.signing_report()
    names = ("fingerprint", "policy", "link_id", "signed", "unsigned", "unproven", "refused")
    return {
        "link": client.link.name,
        "seconds": round(report.seconds, 3),
        **{f"bytes_{name}": report.totals[name] for name in ("received", "sent")},
        **{f"{name}_per_s": round(report.rates[name], 1) for name in ("received", "sent")},
        **{name: report.totals[name] for name in ("frames", "unknown")},
        **taken(report, "damaged", "other_bytes"),
        "signing": None if signing is None else taken(signing, *names),
        "components": [_component_json(client, report.at, each) for each in report.components],
    }


def _component_json(client: ParamClient, now: float, each: ComponentTraffic) -> JsonObject:
    totals, rates = each.totals, each.rates
    beat, component = each.heartbeat, client.components.get((each.system, each.component))
    return {
        **taken(each, "system", "component"),
        "mavlink": each.version,
        "autopilot": beat and autopilot_name(beat.autopilot),
        "kind": beat and kind_in_words(beat.autopilot, beat.type),
        "state": beat and enum_word("MAV_STATE", beat.system_status),
        "heartbeat_age_s": None if each.heartbeat_at is None else rounded(now - each.heartbeat_at),
        "age_s": rounded(now - each.received_at),
        **{name: totals[name] for name in ("frames", "bytes", "lost", "repeated", "late", "signed")},
        **{f"{name}_per_s": round(rates[name], 2) for name in ("frames", "bytes")},
        "loss": rounded(each.loss),
        "round_trip_s": component and rounded(component.round_trip),
        "messages": {
            message_name(number): {"id": number, "count": totals[number], "per_s": round(rates[number], 2)}
            for number in each.messages
        },
        "radio": each.radio,
    }


def _print(found: JsonObject) -> None:
    rows, lines = [], [""]
    for each in found["components"]:
        address, radio = f"{each['system']}/{each['component']}", each["radio"]
        trip, age, loss = each["round_trip_s"], each["heartbeat_age_s"], each["loss"]
        row = (
            address,
            each["kind"] or ("radio" if radio else ""),
            each["mavlink"],
            round(each["frames_per_s"], 1),
            round(each["bytes_per_s"]),
            None if loss is None else f"{loss:.1%}",
            None if trip is None else milliseconds(trip),
            None if age is None else f"{age:.1f} s",
        )
        rows.append(row)
        kinds = [f"{name} {one['per_s']:.1f}/s" for name, one in each["messages"].items() if one["per_s"]]
        state = f" {each['state']}" if each["state"] else ""
        lines.append(f"{address}{state}: {first_of(kinds, MESSAGES_SHOWN_MAX) or 'silent'}")
        lines += [f"  {', '.join(f'{name} {value}' for name, value in radio.items())}"] if radio else []
    lost, signed = (sum(each[name] for each in found["components"]) for name in ("lost", "signed"))
    rates = f"{found['received_per_s']:,.0f} bytes/s received, {found['sent_per_s']:,.0f} sent"
    faults = f"{found['damaged']:,} with a wrong checksum, {found['unknown']:,} of unknown ids"
    lines += ["", f"{found['link']}, {found['seconds']:.1f} s: {rates}"]
    frames = f"{found['frames']:,} frames, {lost:,} lost, {faults}, {signed:,} signed"
    lines.append(f"{frames}; {found['other_bytes']:,} other bytes")
    if signing := found["signing"]:
        accepted = [f", {count:,} accepted: {reason}" for reason, count in signing["unproven"].items()]
        refused = [f", {count:,} refused: {reason}" for reason, count in signing["refused"].items()]
        proven = f"key {signing['fingerprint']}: {signing['signed']:,} frames proven"
        lines.append("".join([proven, *accepted, *refused]))
    print_table(("from", "what", "v", "frames/s", "bytes/s", "loss", "round trip", "heartbeat"), rows)
    print_line("\n".join(lines))


# ports


def ports(*, json: bool = False) -> None:
    """List the serial ports of this computer, autopilots first.

    Needs the extra `serial`: pip install 'paramclient[serial]'.

    Args:
        json: Print JSON.
    """
    found = [asdict(port) | taken(port, "link", "autopilot") for port in list_ports()]
    for port in found:
        for name in ("vendor_id", "product_id"):
            port[name] = None if port[name] is None else f"{port[name]:04x}"
    columns = ["device", "autopilot", "product", "manufacturer", "vendor_id", "product_id", "link"]
    rows = ([port[name] for name in columns] for port in found)
    show({"ports": found}, columns, rows, json=json, empty="this computer has no serial ports")
