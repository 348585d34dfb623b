"""The command that looks at the link itself: link."""

from __future__ import annotations

import sys
from collections.abc import Awaitable, Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Final

import anyio
from cyclopts import Parameter

from paramclient.cli.connection import Deadline, listen
from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.options import Seconds, SigningOptions
from paramclient.cli.output import live_view, milliseconds, print_document, print_line, print_table
from paramclient.client.client import ParamClient
from paramclient.client.component import Component
from paramclient.errors import NoReply, ParamClientError
from paramclient.model.identity import autopilot_name
from paramclient.protocol.stats.traffic import ComponentTraffic, TrafficReport
from paramclient.protocol.wire import MAV_AUTOPILOT_INVALID, MAV_TYPE_GCS, enum_word

__all__ = ["link"]

LISTENING_TIME: Final = 5.0
"""Seconds to listen where no terminal shows it live and the user sets no limit."""
REFRESH_INTERVAL: Final = 0.25
"""Seconds between two looks."""
MOST_MESSAGES: Final = 5
"""Kinds of messages that are named to people, for each component."""
FIRST_MEASURE: Final = 2.0
MEASURE_INTERVAL: Final = 4.0
"""Seconds until the round trip is measured by reading a value, and between two such reads: request and answer
together take less of the link than our heartbeats."""
_UNSIGNED: Final = SigningOptions()
NO_AUTOPILOT: Final = ("unknown", autopilot_name(MAV_AUTOPILOT_INVALID))


async def link(
    url: str,
    /,
    *,
    seconds: Seconds = None,
    json: bool = False,
    listen_only: bool = False,
    tlog: Path | None = None,
    verbose: Annotated[bool, Parameter(name=("--verbose", "-v"))] = False,
    options: SigningOptions = _UNSIGNED,
) -> int:
    """Print who is heard on a link, how much comes, and what is lost on the way.

    On a terminal the table is live until Ctrl-C. Elsewhere, and with --json, it is printed once, after
    --seconds or 5. Loss is counted by the gaps in the frames' sequence numbers.

    Args:
        url: The link, such as udpin:0.0.0.0:14550, tcp:HOST:PORT or sim:px4.
        seconds: How long to listen.
        json: Print JSON, for programs.
        listen_only: Send nothing, so that no round trip is measured.
        tlog: Write everything on the link, both ways, to this telemetry log, which must not exist yet.
        verbose: Tell on stderr what is done, step by step.
    """
    is_live = sys.stdout.isatty() and not json
    limit = seconds if is_live or seconds is not None else LISTENING_TIME
    async with listen(url, options.signing, listen_only=listen_only, tlog=tlog) as client:
        report = await _while_measuring(client, _show if is_live else _listen, limit)
    if not report.frames:
        noise = f" (but {report.bytes_received:,} other bytes)" if report.bytes_received else ""
        raise NoReply(f"anything on {client.link.name}{noise}", attempts=0, waited=report.seconds)
    if json:
        from paramclient.documents.traffic import TrafficDoc  # only here: loads pydantic

        trips = {(each.system, each.component): _round_trip(client, each) for each in report.components}
        print_document(TrafficDoc.of(client.link.name, report, client.signing_report(), trips))
    elif not is_live:
        print_table(_COLUMNS, _rows(client, report), right=" ".join(_COLUMNS[2:]))
        for line in _lines(client, report):
            print_line(line)
    return ExitCode.DONE


async def _while_measuring(
    client: ParamClient,
    look: Callable[[ParamClient, float | None], Awaitable[TrafficReport]],
    seconds: float | None,
) -> TrafficReport:
    outcome: TrafficReport | Exception
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(_measure, client)
        try:
            outcome = await look(client, seconds)
        except Exception as error:  # out of the group it would come wrapped
            outcome = error
        tasks.cancel_scope.cancel()
    if isinstance(outcome, Exception):
        raise outcome
    return outcome


async def _listen(client: ParamClient, seconds: float | None) -> TrafficReport:
    deadline = Deadline(seconds)
    while left := deadline.left(REFRESH_INTERVAL):
        client.traffic_report()  # a link that fails ends it
        await anyio.sleep(left)
    return client.traffic_report()


async def _show(client: ParamClient, seconds: float | None) -> TrafficReport:
    with live_view() as draw:
        deadline = Deadline(seconds)  # from now on: what draws is loaded
        while True:
            report = client.traffic_report()
            if report.frames:
                draw(_COLUMNS, _rows(client, report), _lines(client, report))
            else:
                draw(_COLUMNS, (), ["", f"nothing heard yet: {_pace(client, report)}"])
            left = deadline.left(REFRESH_INTERVAL)
            if not left:
                return report
            await anyio.sleep(left)


async def _measure(client: ParamClient) -> None:
    """Keep the round trips up to date: each autopilot is asked for a value now and then."""
    await anyio.sleep(FIRST_MEASURE)
    async with anyio.create_task_group() as tasks:
        while True:
            for component in client.components.values():
                if component.autopilot not in NO_AUTOPILOT:
                    tasks.start_soon(_read_a_value, component)
            await anyio.sleep(MEASURE_INTERVAL)


async def _read_a_value(component: Component) -> None:
    with suppress(ParamClientError):
        await component.get(0, timeout=MEASURE_INTERVAL)


# for people

_COLUMNS: Final = ("from", "what", "v", "frames/s", "bytes/s", "loss", "round trip", "heartbeat")


def _rows(client: ParamClient, report: TrafficReport) -> Iterator[tuple[object, ...]]:
    for each in report.components:
        trip = _round_trip(client, each)
        yield (
            f"{each.system}/{each.component}",
            _what(each),
            each.version,
            f"{each.frame_rate:.1f}",
            f"{each.byte_rate:,.0f}",
            None if each.loss is None else f"{each.loss:.1%}",
            None if trip is None else milliseconds(trip),
            None if each.heartbeat_age is None else f"{each.heartbeat_age:.1f} s",
        )


def _lines(client: ParamClient, report: TrafficReport) -> Iterator[str]:
    yield ""
    for each in report.components:
        state = "" if each.heartbeat is None else f" {_state(each.heartbeat.system_status)}"
        current = [message for message in each.messages if message.rate]
        shown = [f"{message.name} {message.rate:.1f}/s" for message in current[:MOST_MESSAGES]]
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
    signed = sum(each.signed for each in report.components)
    lost = sum(each.lost for each in report.components)
    yield (
        f"{report.frames:,} frames, {lost:,} lost, {report.damaged:,} with a wrong checksum, "
        f"{report.unknown:,} of unknown ids, {signed:,} signed; {report.other_bytes:,} other bytes"
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
        f"{report.received_rate:,.0f} bytes/s received, {report.sent_rate:,.0f} sent"
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
