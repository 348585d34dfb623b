"""The subcommand link: components, message rates and packet loss on a link."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict
from typing import Final

import anyio

from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.options import Seconds, TrafficOptions
from paramclient.cli.output import LiveView, milliseconds, print_json, print_line, print_table
from paramclient.cli.session import Deadline, listen, received_in_words
from paramclient.client.client import ParamClient
from paramclient.client.component import Component
from paramclient.client.traffic import ComponentTraffic, TrafficReport
from paramclient.errors import NoReply, ParamClientError
from paramclient.model.identity import autopilot_name
from paramclient.model.notation import rounded
from paramclient.protocol.channel import task_group
from paramclient.wire.frames import enum_word, message_name
from paramclient.wire.messages import MAV_AUTOPILOT_INVALID, MAV_TYPE_GCS
from paramclient.wire.signing import SigningReport

__all__ = ["link"]

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
NO_AUTOPILOT: Final = ("unknown", autopilot_name(MAV_AUTOPILOT_INVALID))
"""Autopilot names of components that have no parameters to read."""


async def link(
    url: str,
    /,
    *,
    seconds: Seconds = None,
    listen_only: bool = False,
    options: TrafficOptions = _DEFAULTS,
) -> int:
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
        view, deadline = LiveView() if is_live else None, Deadline(limit)
        while True:
            report = client.traffic_report()  # raises if the link has failed
            if view is not None:
                nothing = ["", f"nothing received yet: {_pace(client, report)}"]
                lines = _lines(client, report) if report.totals["frames"] else nothing
                view.draw(_COLUMNS, _rows(client, report), lines)
            if not (left := deadline.left(REFRESH_INTERVAL)):
                break
            await anyio.sleep(left)
        tasks.cancel_scope.cancel()
        if not report.totals["frames"]:
            hint = received_in_words(client)
            raise NoReply(
                f"a MAVLink frame on {client.link.name}", attempts=0, waited=report.seconds, hint=hint
            )
    if options.json:
        print_json(_json(client, report))
    elif not is_live:
        print_table(_COLUMNS, _rows(client, report), right=" ".join(_COLUMNS[2:]))
        for line in _lines(client, report):
            print_line(line)
    return ExitCode.DONE


async def _measure_round_trips(client: ParamClient) -> None:
    """Read a value of each component with an autopilot every `MEASURE_INTERVAL`, until cancelled."""
    await anyio.sleep(MEASURE_DELAY)
    async with anyio.create_task_group() as tasks:
        while True:
            for component in client.components.values():
                if component.autopilot not in NO_AUTOPILOT:
                    tasks.start_soon(_read_a_value, component)
            await anyio.sleep(MEASURE_INTERVAL)


async def _read_a_value(component: Component) -> None:
    with suppress(ParamClientError):
        await component.get(0, timeout=MEASURE_INTERVAL)


# Tables

_COLUMNS: Final = ("from", "what", "v", "frames/s", "bytes/s", "loss", "round trip", "heartbeat")
"""Columns of the table of components."""


def _rows(client: ParamClient, report: TrafficReport) -> Iterator[tuple[object, ...]]:
    for each in report.components:
        trip = _round_trip(client, each)
        yield (
            f"{each.system}/{each.component}",
            _what(each),
            each.version,
            f"{each.recent['frames']:.1f}",
            f"{each.recent['bytes']:,.0f}",
            None if each.loss is None else f"{each.loss:.1%}",
            None if trip is None else milliseconds(trip),
            None if each.heartbeat_at is None else f"{report.at - each.heartbeat_at:.1f} s",
        )


def _lines(client: ParamClient, report: TrafficReport) -> Iterator[str]:
    yield ""
    for each in report.components:
        state = "" if each.heartbeat is None else f" {_state(each.heartbeat.system_status)}"
        current = [message for message in each.messages if each.recent[message]]
        shown = [
            f"{message_name(message)} {each.recent[message]:.1f}/s"
            for message in current[:MESSAGES_SHOWN_MAX]
        ]
        more = len(current) - len(shown)
        kinds = f"{', '.join(shown)}{f' and {more} more' if more else ''}" if shown else "silent"
        yield f"{each.system}/{each.component}{state}: {kinds}"
        if each.radio is not None:
            yield (
                f"  signal {each.radio.rssi} here, {each.radio.remote_rssi} there; "
                f"noise {each.radio.noise} and {each.radio.remote_noise}; buffer {each.radio.free} % free; "
                f"{each.radio.errors} packets with errors, {each.radio.fixed} corrected"
            )
    yield ""
    yield _pace(client, report)
    signed = sum(each.totals["signed"] for each in report.components)
    lost = sum(each.totals["lost"] for each in report.components)
    yield (
        f"{report.totals['frames']:,} frames, {lost:,} lost, {report.damaged:,} with a wrong checksum, "
        f"{report.totals['unknown']:,} of unknown ids, {signed:,} signed; {report.other_bytes:,} other bytes"
    )
    signing = client.signing_report()
    if signing is not None:
        unproven, refused = (
            "".join(f", {count:,} {what}: {reason}" for reason, count in counts.items())
            for counts, what in ((signing.unproven, "accepted"), (signing.refused, "refused"))
        )
        yield f"key {signing.fingerprint}: {signing.signed:,} frames proven{unproven}{refused}"


def _pace(client: ParamClient, report: TrafficReport) -> str:
    return (
        f"{client.link.name}, {report.seconds:.1f} s: "
        f"{report.recent['received']:,.0f} bytes/s received, {report.recent['sent']:,.0f} sent"
    )


def _what(each: ComponentTraffic) -> str:
    beat = each.heartbeat
    if beat is None:
        return "radio" if each.radio is not None else ""
    words = [_type(beat.type)]
    if beat.autopilot != MAV_AUTOPILOT_INVALID:
        words.insert(0, autopilot_name(beat.autopilot))
    return " ".join(dict.fromkeys(words))


def _type(number: int) -> str:
    return "ground station" if number == MAV_TYPE_GCS else enum_word("MAV_TYPE", number)


def _state(number: int) -> str:
    return enum_word("MAV_STATE", number)


def _round_trip(client: ParamClient, each: ComponentTraffic) -> float | None:
    component = client.components.get((each.system, each.component))
    return None if component is None else component.round_trip


# JSON


def _json(client: ParamClient, report: TrafficReport) -> dict[str, object]:
    signing = client.signing_report()
    return {
        "link": client.link.name,
        "seconds": round(report.seconds, 3),
        "bytes_received": report.totals["received"],
        "bytes_sent": report.totals["sent"],
        "received_per_s": round(report.recent["received"], 1),
        "sent_per_s": round(report.recent["sent"], 1),
        "frames": report.totals["frames"],
        "unknown": report.totals["unknown"],
        "damaged": report.damaged,
        "other_bytes": report.other_bytes,
        "signing": None if signing is None else _signing_json(signing),
        "components": [
            _component_json(report.at, each, _round_trip(client, each)) for each in report.components
        ],
    }


def _signing_json(signing: SigningReport) -> dict[str, object]:
    return {
        "fingerprint": signing.fingerprint,
        "policy": signing.policy,
        "link_id": signing.link_id,
        "signed": signing.signed,
        "unsigned": signing.unsigned,
        "unproven": {str(why): count for why, count in signing.unproven.items()},
        "refused": {str(why): count for why, count in signing.refused.items()},
    }


def _component_json(now: float, each: ComponentTraffic, round_trip: float | None) -> dict[str, object]:
    beat = each.heartbeat
    return {
        "system": each.system,
        "component": each.component,
        "mavlink": each.version,
        "autopilot": None if beat is None else autopilot_name(beat.autopilot),
        "type": None if beat is None else _type(beat.type),
        "state": None if beat is None else _state(beat.system_status),
        "heartbeat_age_s": None if each.heartbeat_at is None else rounded(now - each.heartbeat_at),
        "age_s": round(now - each.received_at, 4),
        "frames": each.totals["frames"],
        "bytes": each.totals["bytes"],
        "frames_per_s": round(each.recent["frames"], 2),
        "bytes_per_s": round(each.recent["bytes"], 1),
        "lost": each.totals["lost"],
        "loss": rounded(each.loss),
        "repeated": each.totals["repeated"],
        "late": each.totals["late"],
        "signed": each.totals["signed"],
        "round_trip_s": rounded(round_trip),
        "messages": {
            message_name(message): {
                "id": message,
                "count": each.totals[message],
                "per_s": round(each.recent[message], 2),
            }
            for message in each.messages
        },
        "radio": None if each.radio is None else asdict(each.radio),
    }
