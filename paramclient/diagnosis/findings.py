"""Findings of a diagnosis: slow or unusual results, their likely cause, and advice."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from statistics import median
from typing import Final

from paramclient.diagnosis.report import LinkReport, VehicleReport

__all__ = ["Finding", "Severity", "findings_of"]

NOTABLE_LOSS: Final = 0.005
"""Share of lost frames from which downloads noticeably repeat requests."""
SEVERE_LOSS: Final = 0.1
"""Share of lost frames from which downloads take several times as long."""
ROUND_TRIP_LONG: Final = 0.5
"""Seconds from which a round trip is reported as long: each repeat of a lost request costs at least one."""
LIST_RATE_SLOW: Final = 200.0
"""Values per second below which a list is reported as slow. ArduPilot sends 1,680 and PX4 1,000 over UDP or
USB (measured); a 57600 baud radio carries 40."""
LIST_PAUSE_LONG: Final = 0.6
"""Seconds from which a pause of the list is reported: ArduPilot pauses its list for 0.2 to 0.4 s while it
answers reads (measured)."""
ARDUPILOT_READ_RATES: Final = (35.0, 60.0)
"""Reads per second of an ArduPilot on a clean link: five in each 100 ms (measured: 49)."""
RADIO_BUFFER_LOW: Final = 30
"""Percent of free transmit buffer below which a radio delays frames."""


class Severity(StrEnum):
    """The severity of a finding.

    Attributes:
        NOTE: explains a result; nothing is wrong.
        SLOW: costs time.
        PROBLEM: can give wrong or missing results, or stop the vehicle from answering.
    """

    NOTE = "note"
    SLOW = "slow"
    PROBLEM = "problem"


@dataclass(frozen=True, slots=True)
class Finding:
    """One slow or unusual result.

    Attributes:
        severity: the severity.
        text: the result, and its likely cause.
        advice: what to do, or an empty text.
    """

    severity: Severity
    text: str
    advice: str = ""


def findings_of(report: VehicleReport) -> list[Finding]:
    """Return the slow and unusual results in a report: problems first, notes last."""
    order = (Severity.PROBLEM, Severity.SLOW, Severity.NOTE)
    found = [*_about_link(report.link), *_about_vehicle(report), *_about_services(report)]
    return sorted(found, key=lambda each: order.index(each.severity))


def _about_link(link: LinkReport) -> Iterator[Finding]:
    if link.loss is not None and link.loss >= NOTABLE_LOSS:
        is_severe = link.loss >= SEVERE_LOSS
        yield Finding(
            Severity.PROBLEM if is_severe else Severity.SLOW,
            f"{link.loss:.1%} of the vehicle's frames were lost ({link.lost:,}).",
            "Check antenna, distance and baud rate, or send less telemetry on this link.",
        )
    if link.damaged:
        yield Finding(
            Severity.PROBLEM,
            f"{_count(link.damaged, 'frame')} had a wrong checksum: noise on a wire, a wrong baud rate, or "
            "two programs that read one serial port.",
            "Compare the baud rate with the vehicle's, and close other programs that use the port.",
        )
    if link.unusable_names:
        yield Finding(
            Severity.PROBLEM,
            f"{_count(link.unusable_names, 'message')} had a parameter name that no parameter file can hold: "
            "damage on a link without checksums, faulty firmware, or forged messages. They were left out.",
            "Compare the parameters that are missing with the firmware's own list, and sign the link.",
        )
    if link.repeated:
        yield Finding(
            Severity.NOTE,
            f"{_count(link.repeated, 'frame')} arrived twice: the vehicle is reached over two paths, such as "
            "two radios or a router with a loop.",
        )
    if link.unknown:
        yield Finding(
            Severity.NOTE,
            f"{_count(link.unknown, 'frame')} had message ids that the dialect does not have. They are "
            "ignored.",
        )
    if link.mavlink == 1:
        yield Finding(
            Severity.NOTE,
            "The vehicle speaks MAVLink 1: no signatures, and no message ids above 255.",
            "Set the port to MAVLink 2 (ArduPilot: SERIALn_PROTOCOL 2; PX4: MAV_PROTO_VER 2).",
        )
    if link.round_trips and median(link.round_trips) >= ROUND_TRIP_LONG:
        yield Finding(
            Severity.SLOW,
            f"The round trip is {median(link.round_trips):.2f} s. Each repeat of a lost request takes at "
            "least as long.",
        )
    if not link.round_trips and link.unanswered:
        yield Finding(
            Severity.PROBLEM,
            "No command was acknowledged: frames to the vehicle are lost, another station was first on a "
            "port that answers only one (PX4 over UDP), or the vehicle expects signed frames.",
            "Close other ground stations and restart the vehicle's link; with signing, give --signing-key.",
        )
    elif link.unanswered:
        total = link.unanswered + len(link.round_trips)
        yield Finding(
            Severity.SLOW, f"{link.unanswered} of {total} commands had to be repeated or were not answered."
        )
    for station in link.stations:
        where = f"{station.system}/{station.component}"
        if station.has_our_address:
            yield Finding(
                Severity.PROBLEM,
                f"Another ground station has this one's address, {where}: each takes the other's answers.",
                "Give one of them another system id.",
            )
        else:
            yield Finding(
                Severity.NOTE,
                f"Another ground station, {where}, is on this link. Its list requests and file sessions "
                "delay downloads.",
            )
    if link.autopilots:
        named = ", ".join(f"{system}/{component}" for system, component in link.autopilots)
        yield Finding(
            Severity.NOTE,
            f"Other autopilots are on this link: {named}. They share its bandwidth.",
            "Name the vehicle with --system in every command that writes.",
        )
    if link.radio_free is not None and link.radio_free < RADIO_BUFFER_LOW:
        yield Finding(
            Severity.SLOW,
            f"The radio's transmit buffer is {100 - link.radio_free} % full: the vehicle sends more than the "
            "radio can transmit.",
            "Lower the vehicle's stream rates on this port.",
        )


def _about_vehicle(report: VehicleReport) -> Iterator[Finding]:
    if not report.has_version:
        yield Finding(
            Severity.PROBLEM,
            "The vehicle did not answer the request for AUTOPILOT_VERSION, so its hardware id and firmware "
            "are unknown. Its cached table is kept by system id and link: another vehicle with that id would "
            "be taken for this one.",
        )
    elif not report.identity.has_own_uid:
        yield Finding(
            Severity.NOTE,
            "The vehicle has no hardware id: the cache identifies it by system id and link."
            if report.identity.uid is None
            else "The hardware id is one of simulated PX4 vehicles, and not of any hardware: "
            "the cache identifies it by hardware id and system id.",
        )
    if report.encoding_reason.startswith("the standard's"):
        yield Finding(
            Severity.PROBLEM,
            "Neither heartbeat nor capabilities indicate the encoding of values; "
            f"{report.encoding} is assumed.",
            "Compare one integer parameter with its known value; if it is wrong, use --encoding c-cast.",
        )
    if report.is_armed:
        yield Finding(Severity.NOTE, "The vehicle is armed: a download in flight delays its telemetry.")
    if report.link.signed:
        count = _count(report.link.signed, "frame")
        yield Finding(
            Severity.NOTE, f"The vehicle has signed {count}. Signatures are verified only with --signing-key."
        )


def _about_services(report: VehicleReport) -> Iterator[Finding]:
    is_ardupilot = report.autopilot == "ardupilot"
    reads, listed, files = report.reads, report.list, report.files
    if reads is not None and reads.single is None:
        yield Finding(
            Severity.PROBLEM, "No PARAM_REQUEST_READ was answered.", "Is this component the autopilot?"
        )
    elif reads is not None and reads.answered < reads.in_flight:
        missing = reads.in_flight - reads.answered
        yield Finding(Severity.PROBLEM, f"{missing} of {reads.in_flight} reads stayed unanswered.")
    elif reads is not None and reads.rate is not None and is_ardupilot:
        low, high = ARDUPILOT_READ_RATES
        if low <= reads.rate <= high:
            yield Finding(
                Severity.NOTE,
                f"{reads.rate:.0f} reads per second is what ArduPilot serves: at most five in each 100 ms.",
            )
    if listed is not None and listed.error is not None:
        yield Finding(Severity.PROBLEM, f"The list could not be downloaded: {listed.error}.")
    elif listed is not None and listed.is_cut_short:
        left = ""
        if listed.count is not None and listed.rate:
            left = f" All of it takes {listed.count / listed.rate:.0f} s."
        yield Finding(
            Severity.SLOW, f"The list was cut short after {listed.elapsed:.0f} s by the time limit.{left}"
        )
    elif listed is not None and listed.missing:
        yield Finding(
            Severity.PROBLEM,
            f"{_count(listed.missing, 'index', 'indices')} of {listed.count} stayed missing: the vehicle "
            "counts parameters that it does not send.",
        )
    if listed is not None and listed.rate is not None and listed.rate < LIST_RATE_SLOW:
        yield Finding(
            Severity.SLOW,
            f"The list is received at {listed.rate:.0f} values per second: a slow port, a radio, or a "
            "low-bandwidth mode.",
            "Raise the port's baud rate or data rate (PX4: MAV_n_RATE, ArduPilot: SERIALn_BAUD).",
        )
    if listed is not None and not listed.lost and listed.longest_pause >= LIST_PAUSE_LONG:
        yield Finding(
            Severity.SLOW,
            f"The list paused for {listed.longest_pause:.1f} s without packet loss: the vehicle is busy, or "
            "serves another station.",
        )
    yield from _about_files(report, is_ardupilot=is_ardupilot)
    yield from _about_hash(report)
    if files is not None and not files.defaults and report.descriptions is None:
        yield Finding(
            Severity.NOTE,
            "The vehicle provides neither defaults nor descriptions of its parameters.",
            "Give the firmware's own file with --metadata.",
        )


def _about_files(report: VehicleReport, *, is_ardupilot: bool) -> Iterator[Finding]:
    files = report.files
    if files is None or files.size is not None:
        return
    if files.is_announced and not files.is_serving:
        yield Finding(
            Severity.SLOW,
            f"The vehicle announces MAVFTP and does not answer: {files.error}.",
            "Another station's file session may be open; it ends after 3 s (ArduPilot) or 10 s (PX4).",
        )
    elif is_ardupilot:
        yield Finding(
            Severity.SLOW,
            f"The packed parameter file cannot be read ({files.error}), so tables are downloaded as lists, "
            "without defaults.",
            "Check that BRD_OPTIONS does not turn MAVFTP off (bit 1), and that the firmware is 4.1 or newer.",
        )
    elif report.autopilot == "px4":
        yield Finding(
            Severity.NOTE,
            f"This PX4 has no packed parameter file ({files.error}), so tables are downloaded as lists.",
        )


def _about_hash(report: VehicleReport) -> Iterator[Finding]:
    found = report.hash
    if found is None:
        return
    if found.before is None:
        advice = "Set MAV_HASH_CHK_EN to 1." if report.autopilot == "px4" else ""
        yield Finding(
            Severity.SLOW if report.autopilot == "px4" else Severity.NOTE,
            f"{found.error}: each session downloads the table anew.",
            advice,
        )
    elif found.after is not None and found.after != found.before:
        yield Finding(
            Severity.NOTE,
            f"The hash changed from {found.before:08x} to {found.after:08x} within {found.seconds:.1f} s: "
            "parameters were written or came into use in between.",
        )
    elif found.confirms_list is False:
        yield Finding(
            Severity.SLOW,
            "The hash did not confirm the downloaded list, so the next session downloads again.",
        )


def _count(number: int, one: str, many: str | None = None) -> str:
    return f"{number:,} {one if number == 1 else many or one + 's'}"
