"""The subcommand check: measures a vehicle and its link by reads, and prints slow or unusual results."""

from __future__ import annotations

import platform
from collections.abc import Iterator
from dataclasses import asdict
from statistics import median
from typing import Annotated, Final

import anyio
from cyclopts import Parameter

from paramclient.cli.json_output import JsonObject, taken
from paramclient.cli.options import Seconds, TrafficOptions
from paramclient.cli.output import (
    Coloured,
    ExitCode,
    Status,
    milliseconds,
    print_json,
    print_line,
    print_table,
)
from paramclient.cli.session import ChosenVehicle, Deadline, listen, wait_for_vehicle
from paramclient.client.client import ParamClient
from paramclient.client.component import Component
from paramclient.errors import LinkError, NoReply, ParamClientError, UsageError
from paramclient.model.identity import version_text
from paramclient.model.notation import hash_text, rounded
from paramclient.protocol import param_pck
from paramclient.protocol.commands import request_message
from paramclient.protocol.file_download import WITH_DEFAULTS
from paramclient.protocol.list_download import download_list
from paramclient.protocol.param_pck import PARAM_FILE
from paramclient.version import __version__
from paramclient.wire.frames import enum_word
from paramclient.wire.messages import HASH_CHECK, AutopilotVersion

CHECK_TIMEOUT: Final = 60.0
"""Seconds for the whole measurement without --timeout: a list at 57600 baud takes 35."""
CHECK_LISTENING_TIME: Final = 2.2
"""Seconds in which every component is heard twice, as each sends a heartbeat once a second."""
MEASURE_TIMEOUT: Final = 3.0
"""Seconds for one small request: longer than any measured round trip with repeats."""
ROUND_TRIP_COUNT: Final = 10
"""Number of round trips that are measured: enough for a median and a maximum."""
STEADY_SHARE: Final = 0.9
"""Share of the list up to which its rate is measured: after it come the repeats of lost values."""
NOTABLE_LOSS: Final = 0.005
"""Share of lost frames from which downloads noticeably repeat requests."""
SEVERE_LOSS: Final = 0.1
"""Share of lost frames from which downloads take several times as long."""
ROUND_TRIP_LONG: Final = 0.5
"""Seconds from which a round trip is reported as long: each repeat of a lost request costs at least one."""
LIST_RATE_SLOW: Final = 200.0
"""Values per second below which a list is reported as slow. ArduPilot sends 1,680 and PX4 1,000 over UDP or
USB (measured); a 57600 baud radio carries 40."""
FASTER_PORT: Final = "Raise the port's baud rate or data rate (PX4: MAV_n_RATE, ArduPilot: SERIALn_BAUD)."
"""What to do about a slow list."""
ENABLE_FTP: Final = "Check that BRD_OPTIONS leaves MAVFTP on (bit 1), and that the firmware is 4.1 or newer."
"""What to do about an ArduPilot that serves no parameter file."""
LESS_LOSS: Final = "Check antenna, distance and baud rate, or send less telemetry on this link."
"""What to do about lost frames."""
NO_ACKNOWLEDGEMENT: Final = (
    "No command was acknowledged: frames to the vehicle are lost, another station was first on a port that "
    "answers only one (PX4 over UDP), or the vehicle expects signed frames. Close other ground stations and "
    "restart the vehicle's link; with signing, give --signing-key."
)
"""The finding about a vehicle that acknowledges no command, and what to do about it."""
_DEFAULTS: Final = TrafficOptions()
_STYLES: Final = {"problem": "red", "slow": "yellow"}
"""Styles of each severity."""


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
    choice = ChosenVehicle.parse(vehicle, one="check measures one vehicle")
    deadline = Deadline(timeout, CHECK_TIMEOUT)
    async with listen(url, options) as client:
        if client.listens_only:
            raise UsageError(f"{client.link.name} is a log: check needs a link to a vehicle")
        component = await wait_for_vehicle(client, choice, deadline)
        found = await _measure(client, component, deadline)
    findings = [*_findings(found)]
    if options.json:
        members = [{"severity": severity, "text": text} for severity, text in findings]
        versions = {"paramclient": __version__, "python": platform.python_version()}
        print_json({**found, "findings": members, "versions": versions | {"system": platform.platform()}})
    else:
        print_table(("what", "measured"), _rows(found))
        print_line("")
        if findings:
            rows = [(Coloured(severity, _STYLES[severity]), text) for severity, text in findings]
            print_table(("severity", "slow or unusual"), rows)
        else:
            print_line("Nothing slow or unusual.")
    return ExitCode.INCOMPLETE if _list_problem(found["list"]) else ExitCode.DONE


# Measurements


async def _measure(client: ParamClient, component: Component, deadline: Deadline) -> JsonObject:
    """Return all measurements; those for which no time is left have an error.

    Sends no PARAM_SET, no command except MAV_CMD_REQUEST_MESSAGE, and writes no file.

    Raises:
        LinkError: the link failed.
    """
    began, identification = anyio.current_time(), component.node.identification

    with Status("measuring: identification"):
        await anyio.sleep(max(0.0, CHECK_LISTENING_TIME - client.traffic_report().seconds))
        await component.wait_until_identified(deadline.left(MEASURE_TIMEOUT) or 0.0)
    kind = identification.vehicle_type
    found: JsonObject = {
        **taken(component, "system", "component", "autopilot"),
        "vehicle_type": None if kind is None else enum_word("MAV_TYPE", kind),
        "identity": asdict(component.identity),
        "has_version": identification.capabilities is not None,
        **taken(component, "encoding", "encoding_reason", "is_armed"),
    }
    with Status("measuring: round trip and hash"):
        trips, crc = await _round_trips(component, deadline), await _hash(client, component, deadline)
    with Status("measuring: list download"):
        listed = await _list(component, deadline)
    with Status("measuring: parameter file"):
        files = await _files(component, deadline)
    found |= {"link": _link(client, component, trips), "list": listed, "files": files, "hash": crc}
    return found | {"elapsed_s": round(anyio.current_time() - began, 3)}


async def _round_trips(component: Component, deadline: Deadline) -> list[float]:
    """Measure the time from command to acknowledgement; stop if the vehicle acknowledges none."""
    found: list[float] = []
    for _ in range(ROUND_TRIP_COUNT):
        began = anyio.current_time()
        try:
            with anyio.fail_after(deadline.left(MEASURE_TIMEOUT)):
                await request_message(component.node.channel, AutopilotVersion)
        except (NoReply, TimeoutError):
            return found
        found.append(anyio.current_time() - began)
    return found


async def _hash(client: ParamClient, component: Component, deadline: Deadline) -> JsonObject:
    """Read PX4's hash or ArduPilot's checksum, with its time and its bytes of both directions."""
    began, before = anyio.current_time(), client.bytes_sent + client.bytes_received
    timeout = deadline.left(MEASURE_TIMEOUT)
    try:
        if component.node.identification.is_ardupilot:
            crc = await component.file_checksum(PARAM_FILE, timeout=timeout)
        else:
            crc = (await component.get(HASH_CHECK, timeout=timeout)).bits
    except LinkError:
        raise
    except ParamClientError as error:
        return {"before": None, "elapsed_s": None, "bytes": None, "error": str(error)}
    count = client.bytes_sent + client.bytes_received - before
    elapsed = rounded(anyio.current_time() - began)
    return {"before": hash_text(crc), "elapsed_s": elapsed, "bytes": count, "error": None}


async def _list(component: Component, deadline: Deadline) -> JsonObject:
    """Measure one list download, also if a file download would be faster."""
    session, began, arrivals = component.session, anyio.current_time(), list[tuple[float, int]]()
    result, problem = None, None

    def progress(received: int, _: int | None) -> None:
        if received and (not arrivals or received > arrivals[-1][1]):
            arrivals.append((anyio.current_time() - began, received))

    session.observers.add(progress)
    try:
        # the vehicle sends the whole list even if later measurements have begun
        with anyio.move_on_after(max(0.0, (deadline.left() or 0.0) - MEASURE_TIMEOUT)):
            result = await download_list(session)
    except LinkError:
        raise
    except ParamClientError as error:
        problem, arrivals = str(error), []
    finally:
        session.observers.discard(progress)
    received = arrivals[-1][1] if arrivals else 0
    steady = [each for each in arrivals if each[1] >= STEADY_SHARE * received and each[0] > arrivals[0][0]]
    count = None if problem else component.count
    return {
        "count": count,
        "received": received,
        "elapsed_s": rounded(anyio.current_time() - began),
        "per_s": rounded(steady[0][1] / (steady[0][0] - arrivals[0][0])) if steady else None,
        "lost": result.lost if result else 0,
        "missing": len(result.missing) if result else (count or 0) - received,
        "is_cut_short": result is None and problem is None,
        "error": problem,
    }


async def _files(component: Component, deadline: Deadline) -> JsonObject:
    """Download the packed parameter file over MAVFTP."""
    began = anyio.current_time()
    try:
        data = await component.read_file(PARAM_FILE + WITH_DEFAULTS, timeout=deadline.left())
        elapsed, content = anyio.current_time() - began, param_pck.decode(data)
    except LinkError:
        raise
    except ParamClientError as error:
        missing = dict.fromkeys(("size", "elapsed_s", "parameters", "defaults"))
        return {"is_serving": not isinstance(error, NoReply), **missing, "error": str(error)}
    count = len(content.entries)
    return {
        "is_serving": True,
        "size": len(data),
        "elapsed_s": rounded(elapsed),
        "parameters": count,
        "defaults": count if content.with_defaults else 0,
        "error": None,
    }


def _link(client: ParamClient, component: Component, trips: list[float]) -> JsonObject:
    """Return the round trips, and the loss of the vehicle's frames since the link was opened."""
    report, trip = client.traffic_report(), None
    (own,) = (each for each in report.components if (each.system, each.component) == component.address)
    lost = max(own.totals["lost"], 0)
    sent = own.totals["frames"] - own.totals["repeated"] + lost
    if trips:
        trip = {"count": len(trips), "median_s": rounded(median(trips)), "max_s": rounded(max(trips))}
    others = [each.address for each in client.autopilots if each.node is not component.node]
    return {
        "name": client.link.name,
        "seconds": round(report.seconds, 3),
        "round_trip": trip,
        "loss": rounded(lost / sent) if sent else None,
        "lost": lost,
        "autopilots": [f"{system}/{number}" for system, number in others],
    }


# Output


def _rows(found: JsonObject) -> Iterator[tuple[str, str]]:
    """Yield the measurements in words."""
    link, listed, files, crc = (found[name] for name in ("link", "list", "files", "hash"))
    proof = "checksum" if found["autopilot"] == "ardupilot" else "hash"
    words = " ".join(dict.fromkeys(filter(None, (found["autopilot"], found["vehicle_type"]))))
    armed = {True: ", armed", False: ", disarmed", None: ""}[found["is_armed"]]
    yield "vehicle", f"{found['system']}/{found['component']} {words}{armed}"
    if found["has_version"]:
        yield "firmware", version_text(found["identity"]["firmware"])
        yield "hardware id", found["identity"]["uid"] or "none"
    else:
        yield "firmware", "unknown: no AUTOPILOT_VERSION received"
    yield "encoding", f"{found['encoding']}: {found['encoding_reason']}"
    if trip := link["round_trip"]:
        most = f"at most {milliseconds(trip['max_s'])}, {trip['count']} commands"
        yield "round trip", f"{milliseconds(trip['median_s'])} ({most})"
    else:
        yield "round trip", "no command was acknowledged"
    share = "unknown" if link["loss"] is None else f"{link['loss']:.1%}"
    yield "loss", f"{share} ({link['lost']:,} of the vehicle's frames in {link['seconds']:.1f} s)"
    yield "list", listed["error"] or ", ".join(_list_in_words(listed))
    if files["error"]:
        yield "parameter file", files["error"]
    else:
        what = f"{files['parameters']} parameters, {files['size']:,} bytes in {files['elapsed_s']:.2f} s"
        yield "parameter file", f"{what}, {'with' if files['defaults'] else 'without'} defaults"
    if crc["error"]:
        yield proof, f"none: {crc['error']}"
    else:
        yield proof, f"{crc['before']}, {crc['bytes']} bytes in {milliseconds(crc['elapsed_s'])}"
    yield "other autopilots", ", ".join(link["autopilots"]) or "none"
    yield "measured in", f"{found['elapsed_s']:.1f} s"


def _list_in_words(listed: JsonObject) -> Iterator[str]:
    yield f"{listed['received']} of {listed['count'] or '?'} in {listed['elapsed_s']:.2f} s"
    if listed["per_s"]:
        yield f"{listed['per_s']:,.0f} per second"
    if listed["lost"]:
        yield f"{listed['lost']} requested again"
    if listed["missing"]:
        yield f"{listed['missing']} missing"


def _list_problem(listed: JsonObject) -> str | None:
    """Return why a list is not whole; None if it is."""
    if listed["is_cut_short"]:
        return f"the time limit ended it after {listed['elapsed_s']:.0f} s"
    if listed["missing"]:
        return f"{listed['missing']} of {listed['count']} parameters stayed missing"
    return None if listed["error"] is None else str(listed["error"])


def _findings(found: JsonObject) -> Iterator[tuple[str, str]]:
    """Yield what is slow or unusual: its severity, and sentences that end with what to do."""
    link, listed, files, crc = (found[name] for name in ("link", "list", "files", "hash"))
    if problem := _list_problem(listed):
        yield "problem", f"The list could not be downloaded: {problem}."
    if listed["per_s"] and listed["per_s"] < LIST_RATE_SLOW:
        text = f"The list is received at {listed['per_s']:.0f} values per second"
        yield "slow", f"{text}: a slow port, a radio, or a low-bandwidth mode. {FASTER_PORT}"
    if crc["error"] and found["autopilot"] == "px4":
        yield "slow", f"{crc['error']}: each session downloads the table anew. Set MAV_HASH_CHK_EN to 1."
    if files["error"] and found["autopilot"] == "ardupilot":
        text = f"The packed parameter file cannot be read ({files['error']})"
        yield "slow", f"{text}, so tables are downloaded as lists, without defaults. {ENABLE_FTP}"
    if link["loss"] is not None and link["loss"] >= NOTABLE_LOSS:
        text = f"{link['loss']:.1%} of the vehicle's frames were lost ({link['lost']:,}). {LESS_LOSS}"
        yield "problem" if link["loss"] >= SEVERE_LOSS else "slow", text
    if link["round_trip"] is None:
        yield "problem", NO_ACKNOWLEDGEMENT
    elif link["round_trip"]["median_s"] >= ROUND_TRIP_LONG:
        text = f"The round trip is {link['round_trip']['median_s']:.2f} s."
        yield "slow", f"{text} Each repeat of a lost request takes at least as long."
