"""The subcommand check: measures a vehicle and its link by reads, and prints slow or unusual results."""

from __future__ import annotations

import platform
from collections.abc import Awaitable, Hashable, Sequence
from contextlib import suppress
from statistics import median
from typing import Final, TypeVar

import anyio

from paramclient.cli.json_output import JsonObject, taken, vehicle_json
from paramclient.cli.options import Seconds, TrafficOptions
from paramclient.cli.output import ExitCode, Status, milliseconds, print_json, print_line, print_table
from paramclient.cli.session import ChosenVehicle, Deadline, open_client, wait_for_vehicle
from paramclient.client.client import ParamClient
from paramclient.client.component import Component
from paramclient.client.taps import FrameCutter, SeenFrame, Tap
from paramclient.errors import LinkError, ParamClientError, UsageError
from paramclient.model.notation import hash_text
from paramclient.protocol.commands import request_message
from paramclient.protocol.file_download import WITH_DEFAULTS
from paramclient.protocol.list_download import download_list
from paramclient.protocol.param_pck import PARAM_FILE, Pack, decode
from paramclient.protocol.selection import node_in_words
from paramclient.version import __version__
from paramclient.wire import messages

CHECK_TIMEOUT: Final = 60.0
"""Seconds for the whole measurement without --timeout: a list at 57600 baud takes 35."""
CHECK_LISTENING_TIME: Final = 2.2
"""Seconds in which every component is heard twice, as each sends a heartbeat once a second."""
MEASURE_TIMEOUT: Final = 3.0
"""Seconds for one small request: longer than any measured round trip with repeats."""
ROUND_TRIP_COUNT: Final = 10
"""Number of round trips that are measured: enough for a median and a maximum; fewer where they are long."""
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
SLOW_LIST: Final = ": a slow port or radio. Raise its rate (PX4: MAV_n_RATE, ArduPilot: SERIALn_BAUD)."
"""Causes of a slow list, and what to do."""
ENABLE_FTP: Final = "Is MAVFTP on (BRD_OPTIONS, bit 1), and used by no other? Is the firmware 4.1 or newer?"
NO_PROOF: Final = {"px4": "Set MAV_HASH_CHK_EN to 1.", "ardupilot": ENABLE_FTP}
"""What to do about a vehicle that confirms no table, by its autopilot."""
LESS_LOSS: Final = "Check antenna, distance and baud rate, or send less telemetry on this link."
"""What to do about lost frames."""
NO_ACKNOWLEDGEMENT: Final = (
    "No command was acknowledged: frames to the vehicle are lost, or another station was first (PX4 over UDP "
    "answers only one): close it, and restart the link. A vehicle that signs needs --signing-key."
)
"""The finding about a vehicle that acknowledges no command, and what to do about it."""

PROOF: Final = (messages.ParamRequestRead, messages.ParamValue, messages.FileTransfer)
"""Messages with which a cached table is proven."""

Result = TypeVar("Result")


async def check(
    url: str,
    /,
    *,
    vehicle: str | None = None,
    timeout: Seconds = None,
    options: TrafficOptions = TrafficOptions(),
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
    async with open_client(url, options, cache=False, traffic=True) as client:
        if client.listens_only:
            raise UsageError(f"{client.link.name} is a log: check needs a link to a vehicle")
        found = _Check(client, await wait_for_vehicle(client, choice, deadline), deadline)
        await found.measure()
    if options.json:
        members = [{"severity": severity, "text": text} for severity, text in found.findings]
        versions = {"paramclient": __version__, "python": platform.python_version()}
        found.json |= {"findings": members, "versions": versions | {"system": platform.platform()}}
        print_json(found.json)
        return found.code
    print_table(("what", "measured"), found.rows)
    print_line("" if found.findings else "\nNothing slow or unusual.")
    print_table(("severity", "slow or unusual"), found.findings)
    return found.code


class _Proof(Tap):
    """Counts the bytes of the frames that prove a table, in both directions."""

    size = 0

    def received(self, frames: Sequence[SeenFrame], size: int, peer: Hashable) -> None:
        self.size += sum(each.size for each in frames if isinstance(messages.decode(each.frame), PROOF))

    def sent(self, frame: bytes) -> None:
        self.received(FrameCutter(stream=False).cut(frame, None), len(frame), None)


class _Check:
    """Measures one thing after the other. What no time is left for has an error; a failed link ends it.

    Sends no PARAM_SET, no command except MAV_CMD_REQUEST_MESSAGE, and writes no file.

    Attributes:
        json, rows: the measurements, and the same in words.
        findings: what is slow or unusual: its severity, and sentences that end with what to do.
        code: the exit code.
    """

    def __init__(self, client: ParamClient, component: Component, deadline: Deadline) -> None:
        self._client, self._component, self._deadline = client, component, deadline
        self.json: JsonObject = {}
        self.rows: list[tuple[str, str]] = []
        self.findings: list[tuple[str, str]] = []
        self.code = ExitCode.DONE

    async def measure(self) -> None:
        """Measure everything."""
        began = anyio.current_time()
        with Status(f"measuring {node_in_words(self._component.node)}"):
            for step in (self._identify, self._round_trip, self._hash, self._list, self._file, self._loss):
                await step()
        self.json["elapsed_s"] = elapsed = round(anyio.current_time() - began, 3)
        self.rows.append(("measured in", f"{elapsed:.1f} s"))

    async def _identify(self) -> None:
        component = self._component
        await anyio.sleep(max(0.0, CHECK_LISTENING_TIME - self._client.traffic_report().seconds))
        await component.wait_until_identified(self._deadline.left(MEASURE_TIMEOUT) or 0.0)
        self.json = vehicle_json(component) | taken(component, "encoding", "encoding_reason", "is_armed")
        armed = {True: ", armed", False: ", disarmed", None: ""}[component.is_armed]
        self.rows += [
            ("vehicle", f"{node_in_words(component.node)}{armed}"),
            ("firmware", self.json["firmware"] or "unknown: no AUTOPILOT_VERSION received"),
            ("hardware id", self.json["uid"] or "none"),
            ("encoding", f"{component.encoding}: {component.encoding_reason}"),
        ]

    async def _round_trip(self) -> None:
        """Measure the time from command to acknowledgement; stop if the vehicle acknowledges none."""
        trips: list[float] = []
        with suppress(TimeoutError):  # also NoReply
            while len(trips) < ROUND_TRIP_COUNT and sum(trips) < MEASURE_TIMEOUT:
                # for answers to repeats
                await anyio.sleep(self._deadline.left(self._component.node.channel.timing.slowest) or 0.0)
                began = anyio.current_time()
                with anyio.fail_after(self._deadline.left(MEASURE_TIMEOUT)):
                    await request_message(self._component.node.channel, messages.AutopilotVersion)
                trips.append(round(anyio.current_time() - began, 4))
        self.json["link"] = {"name": self._client.link.name, "round_trip": None}
        if not trips:
            self.rows.append(("round trip", "no command was acknowledged"))
            self.findings.append(("problem", NO_ACKNOWLEDGEMENT))
            return
        middle, most = median(trips), max(trips)
        self.json["link"]["round_trip"] = {"count": len(trips), "median_s": middle, "max_s": most}
        words = f"{milliseconds(middle)} (at most {milliseconds(most)}, {len(trips)} commands)"
        self.rows.append(("round trip", words))
        if middle >= ROUND_TRIP_LONG:
            self.findings.append(("slow", f"The round trip is {middle:.2f} s: each repeat takes as long."))

    async def _hash(self) -> None:
        """Read PX4's hash or ArduPilot's checksum, with its time and its bytes of both directions."""
        component, timeout = self._component, self._deadline.left(MEASURE_TIMEOUT)
        taps, proof = self._client.core.link_task.taps, _Proof()
        taps.append(proof)
        if is_ardupilot := component.autopilot == "ardupilot":
            crc, found = await _measured(component.file_checksum(PARAM_FILE, timeout=timeout))
        else:
            param, found = await _measured(component.get(messages.HASH_CHECK, timeout=timeout))
            crc = None if param is None else param.bits
        taps.remove(proof)
        found |= {"before": hash_text(crc), "bytes": proof.size}
        self.json["hash"], problem = found, found["error"]
        words = f"{found['before']}, {proof.size} bytes in {milliseconds(found['elapsed_s'] or 0.0)}"
        what = "checksum" if is_ardupilot else "hash"
        self.rows.append((what, f"none: {problem}" if problem else words))
        if problem and (advice := NO_PROOF.get(component.autopilot)):
            self.findings.append(("slow", f"Without a {what}, sessions download. {advice}"))

    async def _list(self) -> None:
        """Measure one list download, also if a file download would be faster."""
        component, began, at = self._component, anyio.current_time(), dict[int, float]()

        def note(received: int, _: int | None) -> None:
            if received:
                at.setdefault(received, anyio.current_time() - began)

        component.session.observers.add(note)
        result, found = None, JsonObject(error=None)
        # the vehicle sends the whole list even if later measurements have begun
        with anyio.move_on_after(max(0.0, (self._deadline.left() or 0.0) - MEASURE_TIMEOUT)) as limit:
            result, found = await _measured(download_list(component.session))
        elapsed, received, count = anyio.current_time() - began, max(at, default=0), component.count
        if limit.cancelled_caught:
            found["error"] = f"the time limit ended it after {elapsed:.0f} s"
        first = min(at.values(), default=0.0)
        steady = [each for each in at if each >= STEADY_SHARE * received and at[each] > first]
        rate = round(steady[0] / (at[steady[0]] - first), 4) if steady else None
        lost, missing = (result.lost, len(result.missing)) if result else (0, (count or 0) - received)
        found |= {"count": count, "received": received, "elapsed_s": round(elapsed, 4), "per_s": rate}
        self.json["list"] = found | {"lost": lost, "missing": missing}
        words = f"{received} of {count or '?'} in {elapsed:.2f} s"
        words += f", {rate:,.0f} per second" if rate else ""
        words += f", {lost} requested again" if lost else ""
        words += f", {missing} missing" if missing else ""
        self.rows.append(("list", words if received else found["error"] or words))
        if problem := found["error"] or (missing and f"{missing} of {count} parameters stayed missing"):
            self.code = ExitCode.INCOMPLETE
            self.findings.append(("problem", f"The list could not be downloaded: {problem}."))
        if doubt := component.session.encoding_doubt:
            self.findings.append(("problem", doubt))
        if rate and rate < LIST_RATE_SLOW and (result is None or result.is_served):
            self.findings.append(("slow", f"The list is received at {rate:.0f} values per second{SLOW_LIST}"))

    async def _file(self) -> None:
        """Download the packed parameter file over MAVFTP."""

        async def read() -> tuple[int, Pack]:
            data = await self._component.read_file(PARAM_FILE + WITH_DEFAULTS, timeout=self._deadline.left())
            return len(data), decode(data)

        done, found = await _measured(read())
        if done is not None:
            size, pack = done
            found |= {"size": size, "parameters": len(pack.entries), "defaults": pack.with_defaults}
            words = f"{found['parameters']} parameters, {size:,} bytes in {found['elapsed_s']:.2f} s"
            words += f", {'with' if pack.with_defaults else 'without'} defaults"
        elif self._component.autopilot == "ardupilot":
            text = f"The packed parameter file cannot be read ({found['error']}), so tables are downloaded as"
            self.findings.append(("slow", f"{text} lists, without defaults."))
        self.json["files"] = found
        self.rows.append(("parameter file", found["error"] or words))

    async def _loss(self) -> None:
        """Count the vehicle's frames that were lost since the link was opened."""
        client, component = self._client, self._component
        report = client.traffic_report()
        (own,) = (each for each in report.components if (each.system, each.component) == component.address)
        lost, share = max(own.totals["lost"], 0), own.loss or 0.0
        others = [f"{each.system}/{each.component}" for each in client.autopilots if each is not component]
        self.json["link"] |= {"seconds": round(report.seconds, 3), "loss": round(share, 4), "lost": lost}
        self.json["link"]["autopilots"] = others
        words = f"{share:.1%} ({lost:,} of the vehicle's frames in {report.seconds:.1f} s)"
        self.rows += [("loss", words), ("other autopilots", ", ".join(others) or "none")]
        if share >= NOTABLE_LOSS:
            text = f"{share:.1%} of the vehicle's frames were lost ({lost:,}). {LESS_LOSS}"
            self.findings.append(("problem" if share >= SEVERE_LOSS else "slow", text))


async def _measured(work: Awaitable[Result]) -> tuple[Result | None, JsonObject]:
    """Await a measurement; return its result, and as JSON its seconds or its error.

    Raises:
        LinkError: the link failed.
    """
    began = anyio.current_time()
    try:
        result = await work
    except LinkError:
        raise
    except ParamClientError as error:
        return None, {"elapsed_s": None, "error": str(error)}
    return result, {"elapsed_s": round(anyio.current_time() - began, 4), "error": None}
