"""The subcommand check: measures a vehicle and its link, and prints or saves the report."""

from __future__ import annotations

import json
import platform
import sys
from collections.abc import Iterable, Iterator
from importlib.metadata import version
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Final

from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.options import Id, Seconds, TrafficOptions
from paramclient.cli.output import (
    Coloured,
    milliseconds,
    print_document,
    print_line,
    print_table,
    printable,
    say,
)
from paramclient.cli.session import VEHICLE_TIMEOUT, Deadline, listen, wait_for_vehicle
from paramclient.cli.vehicle_name import VehicleName, check_uid
from paramclient.diagnosis import Finding, Severity, VehicleReport, check_vehicle, findings_of
from paramclient.errors import UsageError
from paramclient.model.identity import version_text
from paramclient.model.wording import first_of
from paramclient.version import __version__

if TYPE_CHECKING:
    from paramclient.documents.check import CheckDoc, VersionsDoc

__all__ = ["check"]

CHECK_TIMEOUT: Final = 60.0
"""Seconds for the whole measurement without --timeout: a list at 57600 baud takes 35."""
ENTRIES_SHOWN_MAX: Final = 8
"""Files and directories that a row names, so that it stays one line; it gives the number of further ones."""
_DEFAULTS: Final = TrafficOptions()
_STYLES: Final = {Severity.PROBLEM: "red", Severity.SLOW: "yellow", Severity.NOTE: ""}
"""Styles of rich for each severity."""


async def check(
    url: str,
    /,
    *,
    vehicle: str | None = None,
    system: Id = None,
    component: Id = None,
    timeout: Seconds = None,
    report: Path | None = None,
    options: TrafficOptions = _DEFAULTS,
) -> int:
    """Measure a vehicle and its link: identity, services and their speed. Report slow or unusual results.

    Changes nothing: parameters and files are only read. Takes about 5 s on a fast link and 45 s at 57600
    baud, because the whole table is downloaded once as a list and once as a file.

    Args:
        url: The link, such as udpin:0.0.0.0:14550, tcp:HOST:PORT or sim:px4.
        vehicle: The vehicle to measure: 4 or 4/1, px4 or ardupilot, or a hardware id or key of the
            cache. Instead of --system.
        system: The system to measure, 1 to 255. Default: the first one received.
        component: The component to measure, 1 to 255. Default: the autopilot.
        timeout: Timeout for the whole measurement in seconds. Default: 60.
        report: Also write the result to this new file, to attach it to an issue.
    """
    if report is not None:
        _check_is_new(report)
    named = VehicleName.chosen(vehicle, system, component)
    deadline = Deadline(CHECK_TIMEOUT if timeout is None else timeout)
    async with listen(url, options) as client:
        if client.listens_only:
            raise UsageError(f"{client.link.name} is a log: check needs a link to a vehicle")
        heartbeat_timeout = VEHICLE_TIMEOUT if timeout is None else deadline.left()
        found = await wait_for_vehicle(
            client, named.system, named.component, kind=named.kind, timeout=heartbeat_timeout
        )
        await check_uid(client, found, named.uid)
        left = deadline.left()
        assert left is not None
        measured = await check_vehicle(
            client, found, timeout=left, progress=_show_progress if sys.stderr.isatty() else None
        )
    findings = findings_of(measured)
    if options.json or report is not None:
        document = _document(measured, findings)
        if options.json:
            print_document(document)
        if report is not None:
            _write(report, measured, findings, document)
    if not options.json:
        print_table(("what", "measured"), _rows(measured))
        print_line("")
        if findings:
            print_table(
                ("severity", "slow or unusual"),
                ((Coloured(each.severity, _STYLES[each.severity]), _sentence(each)) for each in findings),
            )
        else:
            print_line("Nothing slow or unusual.")
    if report is not None:
        say(f"written to {report}")
    is_whole = measured.list is not None and measured.list.error is None and not measured.list.missing
    return ExitCode.DONE if is_whole else ExitCode.INCOMPLETE


def _check_is_new(path: Path) -> None:
    if path.exists():
        raise UsageError(f"{path} exists already; name a file that does not")


def _show_progress(measurement: str) -> None:
    say(f"measuring: {measurement}")


# Tables


def _sentence(finding: Finding) -> str:
    return f"{finding.text} {finding.advice}".rstrip()


def _rows(report: VehicleReport) -> Iterator[tuple[str, str]]:
    yield "vehicle", _vehicle(report)
    yield from _identity_rows(report)
    yield "encoding", f"{report.encoding}: {report.encoding_reason}"
    yield from _link_rows(report)
    yield from _service_rows(report)
    stations = ", ".join(f"{each.system}/{each.component}" for each in report.link.stations)
    yield "other stations", stations or "none"
    if report.link.autopilots:
        named = ", ".join(f"{system}/{component}" for system, component in report.link.autopilots)
        yield "other autopilots", named
    yield "measured in", f"{report.elapsed:.1f} s"


def _vehicle(report: VehicleReport) -> str:
    kind = " ".join(dict.fromkeys(filter(None, (report.autopilot, report.vehicle_type))))
    armed = {True: ", armed", False: ", disarmed", None: ""}[report.is_armed]
    return f"{report.system}/{report.component} {kind}{armed}"


def _identity_rows(report: VehicleReport) -> Iterator[tuple[str, str]]:
    identity = report.identity
    if not report.has_version:
        yield "firmware", "unknown: no AUTOPILOT_VERSION received"
        return
    git_hash = f", commit {identity.git_hash}" if identity.git_hash.strip("0") else ""
    yield "firmware", f"{version_text(identity.firmware)}{git_hash}"
    yield "hardware id", identity.uid or "none"
    yield "capabilities", f"0x{identity.capabilities:x}"


def _link_rows(report: VehicleReport) -> Iterator[tuple[str, str]]:
    link = report.link
    signed = ", signed" if link.signed else ""
    yield "protocol", f"MAVLink {link.mavlink}{signed}" if link.mavlink else "no frame received"
    trips = link.round_trips
    if trips:
        spread = f"{milliseconds(trips[0])} to {milliseconds(trips[-1])}"
        yield "round trip", f"{milliseconds(median(trips))} ({spread}, {len(trips)} commands)"
    else:
        yield "round trip", "no command was acknowledged"
    loss = "unknown" if link.loss is None else f"{link.loss:.1%}"
    yield "loss", f"{loss} ({link.lost:,} of the vehicle's frames in {link.seconds:.1f} s)"


def _service_rows(report: VehicleReport) -> Iterator[tuple[str, str]]:
    none = "not measured: no time left"
    reads, listed, files, found = report.reads, report.list, report.files, report.hash
    if reads is None:
        yield "single reads", none
    elif reads.single is None:
        yield "single reads", "no response"
    else:
        rate = f", {reads.rate:.0f} per second with {reads.in_flight} at once" if reads.rate else ""
        repeats = reads.requests - reads.in_flight
        again = f", {repeats} repeated" if repeats else ""
        yield "single reads", f"{milliseconds(reads.single)} each{rate}{again}"
    if listed is None:
        yield "list", none
    elif listed.error is not None:
        yield "list", listed.error
    else:
        rate = f", {listed.rate:,.0f} per second" if listed.rate else ""
        gaps = f", {listed.lost} requested again" if listed.lost else ""
        missing = f", {listed.missing} missing" if listed.missing else ""
        yield "list", f"{listed.received} of {listed.count} in {listed.elapsed:.2f} s{rate}{gaps}{missing}"
    if files is None:
        yield "MAVFTP", none
    else:
        entries = f": {first_of(files.entries, ENTRIES_SHOWN_MAX)}" if files.entries else ""
        yield "MAVFTP", f"served{entries}" if files.is_serving else f"not served: {files.error}"
        if files.size is not None and files.elapsed is not None:
            yield (
                "parameter file",
                f"{files.parameters} parameters, {files.size:,} bytes in {files.elapsed:.2f} s",
            )
        else:
            yield "parameter file", files.error or "none"
        yield "defaults", "in the parameter file" if files.defaults else "not provided by the vehicle"
    yield "descriptions", report.descriptions or "not provided by the vehicle"
    if found is None:
        yield "hash", none
    elif found.before is None:
        yield "hash", found.error or "none"
    else:
        after = "no response" if found.after is None else f"{found.after:08x}"
        holds = f"the same after {found.seconds:.1f} s" if found.after == found.before else f"then {after}"
        yield "hash", f"{found.before:08x}, {holds}"


# JSON and Markdown


def _document(report: VehicleReport, findings: Iterable[Finding]) -> CheckDoc:
    from paramclient.documents.check import CheckDoc, VersionsDoc  # only here: loads pydantic

    versions = VersionsDoc(
        paramclient=__version__,
        pymavlink=version("pymavlink"),
        python=platform.python_version(),
        system=platform.platform(),
    )
    return CheckDoc.of(report, findings, versions)


def _write(path: Path, report: VehicleReport, findings: list[Finding], document: CheckDoc) -> None:
    """Write the result as Markdown: the tables, then all figures as JSON.

    Raises:
        UsageError: the file cannot be written.
    """
    versions = document.versions
    lines = [
        f"# paramclient check {report.link.name}",
        "",
        f"paramclient {versions.paramclient}, {_platform(versions)}",
        "",
        "| what | measured |",
        "| --- | --- |",
        *(f"| {what} | {_cell(text)} |" for what, text in _rows(report)),
        "",
        "## Slow or unusual",
        "",
        *([f"- **{each.severity}**: {_cell(_sentence(each))}" for each in findings] or ["Nothing."]),
        "",
        "## All figures",
        "",
        "```json",
        json.dumps(document.as_json(), indent=2, allow_nan=False),
        "```",
        "",
    ]
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write("\n".join(lines))
    except OSError as error:
        raise UsageError(f"{path} cannot be written: {error.strerror}") from error


def _platform(versions: VersionsDoc) -> str:
    return f"pymavlink {versions.pymavlink}, Python {versions.python}, {versions.system}"


def _cell(text: str) -> str:
    """Return text escaped for a Markdown cell: text of the vehicle may contain any character."""
    return printable(text).replace("|", "\\|").replace("`", "'").replace("<", "&lt;")
