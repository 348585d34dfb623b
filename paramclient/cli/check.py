"""The subcommand check: measures a vehicle and its link, and prints slow or unusual results."""

from __future__ import annotations

import platform
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import version
from typing import Annotated, Final

from cyclopts import Parameter

from paramclient.cli.check_measurements import ListCheck, Measurements, Report
from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.json_output import Json, as_json
from paramclient.cli.options import Seconds, TrafficOptions
from paramclient.cli.output import Coloured, milliseconds, print_json, print_line, print_table, say
from paramclient.cli.session import VEHICLE_TIMEOUT, ChosenVehicle, Deadline, listen, wait_for_vehicle
from paramclient.errors import UsageError
from paramclient.model.identity import version_text
from paramclient.version import __version__

__all__ = ["check"]

CHECK_TIMEOUT: Final = 60.0
"""Seconds for the whole measurement without --timeout: a list at 57600 baud takes 35."""
NOTABLE_LOSS: Final = 0.005
"""Share of lost frames from which downloads noticeably repeat requests."""
SEVERE_LOSS: Final = 0.1
"""Share of lost frames from which downloads take several times as long."""
ROUND_TRIP_LONG: Final = 0.5
"""Seconds from which a round trip is reported as long: each repeat of a lost request costs at least one."""
LIST_RATE_SLOW: Final = 200.0
"""Values per second below which a list is reported as slow. ArduPilot sends 1,680 and PX4 1,000 over UDP or
USB (measured); a 57600 baud radio carries 40."""
_DEFAULTS: Final = TrafficOptions()
_STYLES: Final = {"problem": "red", "slow": "yellow"}
"""Styles of rich for each severity."""


async def check(
    url: str,
    /,
    *,
    vehicle: Annotated[str | None, Parameter(name="--vehicle")] = None,
    timeout: Seconds = None,
    options: TrafficOptions = _DEFAULTS,
) -> int:
    """Measure a vehicle and its link: identity, services and their speed. Report slow or unusual results.

    Changes nothing: parameters and files are only read. Takes about 5 s on a fast link and 45 s at 57600
    baud, because the whole table is downloaded once as a list and once as a file.

    Args:
        url: The link, such as udpin:0.0.0.0:14550, tcp:HOST:PORT or sim:px4.
        vehicle: The vehicle: 4 or 4/1 (system and component id), or uid:HARDWARE-ID.
        timeout: Timeout for the whole measurement in seconds. Default: 60.
    """
    choice = ChosenVehicle.parse(vehicle)
    if choice.is_all:
        raise UsageError("check measures one vehicle")
    deadline = Deadline(CHECK_TIMEOUT if timeout is None else timeout)
    async with listen(url, options) as client:
        if client.listens_only:
            raise UsageError(f"{client.link.name} is a log: check needs a link to a vehicle")
        heartbeat_timeout = VEHICLE_TIMEOUT if timeout is None else deadline.left()
        found = await wait_for_vehicle(client, choice, timeout=heartbeat_timeout)
        progress = _say_step if sys.stderr.isatty() else None
        report = await Measurements(client, found, deadline, progress).take()
    findings = list(_findings(report))
    if options.json:
        versions = {
            "paramclient": __version__,
            "pymavlink": version("pymavlink"),
            "python": platform.python_version(),
            "system": platform.platform(),
        }
        print_json({**as_json(report), "findings": findings, "versions": versions})
    else:
        print_table(("what", "measured"), _rows(report))
        print_line("")
        if findings:
            rows = (
                (Coloured(each.severity, _STYLES[each.severity]), f"{each.text} {each.advice}".rstrip())
                for each in findings
            )
            print_table(("severity", "slow or unusual"), rows)
        else:
            print_line("Nothing slow or unusual.")
    listed = report.list_
    is_whole = listed is not None and listed.error is None and not listed.missing
    return ExitCode.DONE if is_whole else ExitCode.INCOMPLETE


def _say_step(measurement: str) -> None:
    say(f"measuring: {measurement}")


# Tables


def _rows(report: Report) -> Iterator[tuple[str, str]]:
    kind = " ".join(dict.fromkeys(filter(None, (report.autopilot, report.vehicle_type))))
    armed = {True: ", armed", False: ", disarmed", None: ""}[report.is_armed]
    yield "vehicle", f"{report.system}/{report.component} {kind}{armed}"
    if report.has_version:
        yield "firmware", version_text(report.identity.firmware)
        yield "hardware id", report.identity.uid or "none"
    else:
        yield "firmware", "unknown: no AUTOPILOT_VERSION received"
    yield "encoding", f"{report.encoding}: {report.encoding_reason}"
    link, trip = report.link, report.link.round_trip
    if trip is None:
        yield "round trip", "no command was acknowledged"
    else:
        spread = f"{milliseconds(trip.min_s)} to {milliseconds(trip.max_s)}"
        yield "round trip", f"{milliseconds(trip.median_s)} ({spread}, {trip.count} commands)"
    loss = "unknown" if link.loss is None else f"{link.loss:.1%}"
    yield "loss", f"{loss} ({link.lost:,} of the vehicle's frames in {link.seconds:.1f} s)"
    none = "not measured: no time left"
    reads, listed, files = report.reads, report.list_, report.files
    if reads is None:
        yield "single reads", none
    elif reads.single_s is None:
        yield "single reads", "no response"
    else:
        rate = f", {reads.per_s:.0f} per second with {reads.in_flight} at once" if reads.per_s else ""
        yield "single reads", f"{milliseconds(reads.single_s)} each{rate}"
    yield "list", none if listed is None else _list_text(listed)
    if files is None:
        yield "parameter file", none
    elif files.size is not None and files.elapsed_s is not None:
        found = f"{files.parameters} parameters, {files.size:,} bytes in {files.elapsed_s:.2f} s"
        yield "parameter file", f"{found}, {'with' if files.defaults else 'without'} defaults"
    else:
        yield "parameter file", files.error or "none"
    proof = report.hash
    title = "checksum" if report.autopilot == "ardupilot" else "hash"
    if proof is None:
        yield title, none
    elif proof.elapsed_s is None:
        yield title, f"none: {proof.error}"
    else:
        yield title, f"{proof.before}, {proof.bytes} bytes in {milliseconds(proof.elapsed_s)}"
    yield "other autopilots", ", ".join(link.autopilots) or "none"
    yield "measured in", f"{report.elapsed_s:.1f} s"


def _list_text(listed: ListCheck) -> str:
    if listed.error is not None:
        return listed.error
    rate = f", {listed.per_s:,.0f} per second" if listed.per_s else ""
    gaps = f", {listed.lost} requested again" if listed.lost else ""
    missing = f", {listed.missing} missing" if listed.missing else ""
    return f"{listed.received} of {listed.count} in {listed.elapsed_s:.2f} s{rate}{gaps}{missing}"


# Findings


@dataclass(frozen=True, slots=True)
class _Finding(Json):
    """One slow or unusual result, its likely cause, and what to do."""

    severity: str
    text: str
    advice: str = ""


def _findings(report: Report) -> Iterator[_Finding]:
    """Yield the findings: identity, loss, round trip, list, and how a table is confirmed or downloaded."""
    if not report.has_version:
        yield _Finding(
            "problem",
            "The vehicle did not answer the request for AUTOPILOT_VERSION: another vehicle with this system "
            "id would be taken for it.",
        )
    yield from _about_link(report)
    yield from _about_list(report)
    files, found = report.files, report.hash
    if report.autopilot == "px4" and found is not None and found.before is None:
        yield _Finding(
            "slow", f"{found.error}: each session downloads the table anew.", "Set MAV_HASH_CHK_EN to 1."
        )
    if report.autopilot == "ardupilot" and files is not None and files.size is None:
        yield _Finding(
            "slow",
            f"The packed parameter file cannot be read ({files.error}), so tables are downloaded as lists, "
            "without defaults.",
            "Check that BRD_OPTIONS does not turn MAVFTP off (bit 1), and that the firmware is 4.1 or newer.",
        )


def _about_link(report: Report) -> Iterator[_Finding]:
    link = report.link
    if link.loss is not None and link.loss >= NOTABLE_LOSS:
        yield _Finding(
            "problem" if link.loss >= SEVERE_LOSS else "slow",
            f"{link.loss:.1%} of the vehicle's frames were lost ({link.lost:,}).",
            "Check antenna, distance and baud rate, or send less telemetry on this link.",
        )
    if link.round_trip is None:
        yield _Finding(
            "problem",
            "No command was acknowledged: frames to the vehicle are lost, another station was first on a "
            "port that answers only one (PX4 over UDP), or the vehicle expects signed frames.",
            "Close other ground stations and restart the vehicle's link; with signing, give --signing-key.",
        )
    elif link.round_trip.median_s >= ROUND_TRIP_LONG:
        yield _Finding(
            "slow",
            f"The round trip is {link.round_trip.median_s:.2f} s. Each repeat of a lost request takes at "
            "least as long.",
        )


def _about_list(report: Report) -> Iterator[_Finding]:
    listed = report.list_
    if listed is None:
        return
    if listed.error is not None:
        yield _Finding("problem", f"The list could not be downloaded: {listed.error}.")
    elif listed.is_cut_short:
        yield _Finding("slow", f"The list was cut short after {listed.elapsed_s:.0f} s by the time limit.")
    elif listed.missing:
        yield _Finding(
            "problem",
            f"{listed.missing} of {listed.count} parameters stayed missing: the vehicle counts parameters "
            "that it does not send.",
        )
    if listed.per_s is not None and listed.per_s < LIST_RATE_SLOW:
        yield _Finding(
            "slow",
            f"The list is received at {listed.per_s:.0f} values per second: a slow port, a radio, or a "
            "low-bandwidth mode.",
            "Raise the port's baud rate or data rate (PX4: MAV_n_RATE, ArduPilot: SERIALn_BAUD).",
        )
