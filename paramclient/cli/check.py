"""The subcommand check: measures a vehicle and its link by reads, and prints slow or unusual results."""

from __future__ import annotations

import platform
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import asdict
from importlib.metadata import version
from statistics import median
from typing import Annotated, Any, Final

import anyio
from cyclopts import Parameter

from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.options import Seconds, TrafficOptions
from paramclient.cli.output import Coloured, Status, milliseconds, print_json, print_line, print_table
from paramclient.cli.session import VEHICLE_TIMEOUT, ChosenVehicle, Deadline, listen, wait_for_vehicle
from paramclient.client.client import ParamClient
from paramclient.client.component import Component
from paramclient.errors import (
    FileTransferError,
    LinkError,
    NoReply,
    PackError,
    ParamClientError,
    UsageError,
    VehicleError,
)
from paramclient.model.identity import version_text
from paramclient.model.notation import hash_text, rounded
from paramclient.protocol import param_pck
from paramclient.protocol.file_download import WITH_DEFAULTS
from paramclient.protocol.list_download import ListResult, download_list
from paramclient.protocol.param_pck import PARAM_FILE
from paramclient.version import __version__
from paramclient.wire.frames import enum_word
from paramclient.wire.messages import (
    HASH_CHECK,
    MAV_AUTOPILOT_INVALID,
    MAV_CMD_REQUEST_MESSAGE,
    MAV_TYPE_GCS,
    AutopilotVersion,
    CommandAck,
    CommandLong,
    message_id,
)

__all__ = ["check"]

CHECK_TIMEOUT: Final = 60.0
"""Seconds for the whole measurement without --timeout: a list at 57600 baud takes 35."""
CHECK_LISTENING_TIME: Final = 2.2
"""Seconds in which every component is heard twice, as each sends a heartbeat once a second."""
VERSION_TIMEOUT: Final = 3.0
"""Seconds for AUTOPILOT_VERSION: four attempts at the initial timeout."""
MEASURE_TIMEOUT: Final = 3.0
"""Seconds for one small request: longer than any measured round trip with repeats."""
ROUND_TRIP_COUNT: Final = 10
"""Number of round trips that are measured: enough for a median and a maximum."""
SINGLE_READ_COUNT: Final = 5
"""Number of sequential reads that are measured: enough for a median."""
CONCURRENT_READ_COUNT: Final = 30
"""Number of concurrent reads: ArduPilot serves five in 100 ms, so 30 show its rate within 0.6 s."""
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
    deadline = Deadline(CHECK_TIMEOUT if timeout is None else timeout)
    async with listen(url, options) as client:
        if client.listens_only:
            raise UsageError(f"{client.link.name} is a log: check needs a link to a vehicle")
        heartbeat_timeout = VEHICLE_TIMEOUT if timeout is None else deadline.left()
        found = await wait_for_vehicle(client, choice, timeout=heartbeat_timeout)
        report = _Report(client, found, deadline)
        await report.measure()
    if options.json:
        versions = {
            "paramclient": __version__,
            "pymavlink": version("pymavlink"),
            "python": platform.python_version(),
            "system": platform.platform(),
        }
        print_json({**report.json, "findings": report.findings, "versions": versions})
    else:
        print_table(("what", "measured"), report.rows.items())
        print_line("")
        if report.findings:
            rows = [
                (Coloured(each["severity"], _STYLES[each["severity"]]), f"{each['text']} {each['advice']}")
                for each in report.findings
            ]
            print_table(("severity", "slow or unusual"), rows)
        else:
            print_line("Nothing slow or unusual.")
    listed = report.json["list"]
    is_whole = listed is not None and listed["error"] is None and not listed["missing"]
    return ExitCode.DONE if is_whole else ExitCode.INCOMPLETE


class _Report:
    """The measurements of one vehicle, each as JSON, as a row of the table, and with its findings.

    Sends no PARAM_SET, no command except MAV_CMD_REQUEST_MESSAGE, and writes no file.

    Args:
        client: an open client that counts traffic, without a cache.
        component: the vehicle.
        deadline: a measurement after it is left out, and a list download that takes longer is cut short.
    """

    def __init__(self, client: ParamClient, component: Component, deadline: Deadline) -> None:
        self._client, self._component, self._deadline = client, component, deadline
        self._identification = component.node.identification
        self._proof = "checksum" if self._identification.is_ardupilot else "hash"
        self.json: dict[str, Any] = {}
        self.rows: dict[str, str] = {}
        self.findings: list[dict[str, str]] = []

    async def measure(self) -> None:
        """Take all measurements.

        Raises:
            LinkError: the link failed.
        """
        began, listened = anyio.current_time(), self._client.traffic_report().seconds
        await self._step("listening", lambda: anyio.sleep(max(0.0, CHECK_LISTENING_TIME - listened)))
        await self._step("identification", self._wait_for_identity)
        self._describe()
        self.json |= dict.fromkeys(("link", "reads", "list", "files", "hash"))
        self.rows["round trip"] = "no command was acknowledged"
        self.rows["loss"] = ""
        titles = ("single reads", "list", "parameter file", self._proof)
        self.rows |= dict.fromkeys(titles, "not measured: no time left")
        trips = await self._step("round trip", self._measure_round_trips)
        await self._step("hash", self._read_hash)
        await self._step("single reads", self._measure_reads)
        await self._step("list download", self._measure_list)
        await self._step("MAVFTP", self._check_files)
        self._describe_link(trips or [])
        self.json["elapsed_s"] = round(anyio.current_time() - began, 3)
        self.rows["measured in"] = f"{self.json['elapsed_s']:.1f} s"

    def _find(self, severity: str, text: str, advice: str = "") -> None:
        self.findings.append({"severity": severity, "text": text, "advice": advice})

    def _left(self) -> float:
        """Return the timeout of one request in seconds."""
        return self._deadline.left(MEASURE_TIMEOUT) or 0.0

    async def _step(self, name: str, measure: Callable[[], Awaitable[Any]]) -> Any:
        """Return the result of a measurement; None if no time is left for it."""
        if not self._left():
            return None
        with Status(f"measuring: {name}"):
            return await measure()

    async def _wait_for_identity(self) -> None:
        """Wait until AUTOPILOT_VERSION was received or finally refused, at most `VERSION_TIMEOUT`."""
        await self._component.wait_until_identified(self._deadline.left(VERSION_TIMEOUT) or 0.0)

    def _describe(self) -> None:
        component, identity, kind = (
            self._component,
            self._component.identity,
            self._identification.vehicle_type,
        )
        has_version = self._identification.capabilities is not None
        vehicle_type = None if kind is None else enum_word("MAV_TYPE", kind)
        self.json |= {
            "system": component.system,
            "component": component.component,
            "autopilot": component.autopilot,
            "vehicle_type": vehicle_type,
            "identity": asdict(identity),
            "has_version": has_version,
            "encoding": component.encoding.value,
            "encoding_reason": component.encoding_reason,
            "is_armed": component.is_armed,
        }
        words = " ".join(dict.fromkeys(filter(None, (component.autopilot, vehicle_type))))
        armed = {True: ", armed", False: ", disarmed", None: ""}[component.is_armed]
        self.rows["vehicle"] = f"{component.system}/{component.component} {words}{armed}"
        if has_version:
            self.rows["firmware"] = version_text(identity.firmware)
            self.rows["hardware id"] = identity.uid or "none"
        else:
            self.rows["firmware"] = "unknown: no AUTOPILOT_VERSION received"
            self._find(
                "problem",
                "The vehicle did not answer the request for AUTOPILOT_VERSION: another vehicle with this "
                "system id would be taken for it.",
            )
        self.rows["encoding"] = f"{component.encoding.value}: {component.encoding_reason}"

    async def _measure_round_trips(self) -> list[float]:
        """Measure the time from command to acknowledgement, of commands that were sent once."""
        channel, what = self._component.node.channel, f"COMMAND_ACK of {self._component.node.channel}"
        command = CommandLong(*channel.target, MAV_CMD_REQUEST_MESSAGE, float(message_id(AutopilotVersion)))
        found: list[float] = []
        for _ in range(ROUND_TRIP_COUNT):
            began = anyio.current_time()
            sent: list[int] = []

            def request(attempt: int, sent: list[int] = sent) -> CommandLong:
                sent.append(attempt)
                return command

            with (
                anyio.move_on_after(self._left()) as scope,
                channel.inbox((CommandAck, MAV_CMD_REQUEST_MESSAGE)) as inbox,
                suppress(NoReply),
            ):
                await channel.exchange(request, inbox, lambda ack: ack, what=what)
                if len(sent) == 1:
                    found.append(anyio.current_time() - began)
                continue
            if scope.cancelled_caught and not found:
                break  # the vehicle acknowledges no commands
        return found

    async def _read_hash(self) -> None:
        """Read PX4's hash or ArduPilot's checksum, with its time and its bytes of both directions."""
        client, began = self._client, anyio.current_time()
        before = client.bytes_sent + client.bytes_received
        found = dict.fromkeys(("before", "elapsed_s", "bytes", "error"))
        self.json["hash"] = found
        try:
            if self._identification.is_ardupilot:
                crc = await self._component.file_checksum(PARAM_FILE, timeout=self._left())
            else:
                crc = (await self._component.get(HASH_CHECK, timeout=self._left())).bits
        except (FileTransferError, NoReply, VehicleError) as error:
            found["error"] = str(error)
            self.rows[self._proof] = f"none: {error}"
            if self._component.autopilot == "px4":
                text = f"{error}: each session downloads the table anew."
                self._find("slow", text, "Set MAV_HASH_CHK_EN to 1.")
            return
        elapsed, count = anyio.current_time() - began, client.bytes_sent + client.bytes_received - before
        found |= {"before": hash_text(crc), "elapsed_s": round(elapsed, 4), "bytes": count}
        self.rows[self._proof] = f"{hash_text(crc)}, {count} bytes in {milliseconds(elapsed)}"

    async def _measure_reads(self) -> None:
        """Measure reads of single parameters: one after the other, and many at once."""
        single: list[float] = []
        self.json["reads"], self.rows["single reads"] = {"in_flight": 0, "answered": 0}, "no response"
        for index in range(SINGLE_READ_COUNT):
            began = anyio.current_time()
            if await self._is_answered(index):
                single.append(anyio.current_time() - began)
            elif not single:
                return
        count = self._component.count or 0
        # indices spread over the table, without those that were just read
        step = max((count - SINGLE_READ_COUNT) // CONCURRENT_READ_COUNT, 1)
        indices = range(SINGLE_READ_COUNT, count, step)[:CONCURRENT_READ_COUNT]
        began = anyio.current_time()
        answered_at: list[float] = []

        async def read(index: int) -> None:
            if await self._is_answered(index):
                answered_at.append(anyio.current_time())

        async with anyio.create_task_group() as tasks:
            for index in indices:
                tasks.start_soon(read, index)
        rate = len(answered_at) / (max(answered_at) - began) if answered_at else None
        speed = {"single_s": rounded(median(single))} | ({"per_s": rounded(rate)} if rate else {})
        self.json["reads"] = speed | {"in_flight": len(indices), "answered": len(answered_at)}
        rates = f", {rate:.0f} per second with {len(indices)} at once" if rate else ""
        self.rows["single reads"] = f"{milliseconds(median(single))} each{rates}"

    async def _is_answered(self, index: int) -> bool:
        try:
            await self._component.get(index, timeout=self._left())
        except (NoReply, VehicleError):
            return False
        return True

    async def _measure_list(self) -> None:
        """Measure one list download, also if a file download would be faster."""
        session, began = self._component.session, anyio.current_time()
        arrivals: list[tuple[float, int]] = []
        result: ListResult | None = None
        error: ParamClientError | None = None

        def progress(received: int, total: int | None) -> None:
            if received and (not arrivals or received > arrivals[-1][1]):
                arrivals.append((anyio.current_time(), received))

        session.observers.add(progress)
        try:
            # the vehicle sends the whole list even if later measurements have begun
            with anyio.move_on_after(max(0.0, (self._deadline.left() or 0.0) - MEASURE_TIMEOUT)):
                result = await download_list(session)
        except LinkError:
            raise
        except ParamClientError as failure:
            error = failure
        finally:
            session.observers.discard(progress)
        elapsed, count = anyio.current_time() - began, None if error else self._component.count
        received = arrivals[-1][1] if arrivals and not error else 0
        steady = [(at, number) for at, number in arrivals if number >= STEADY_SHARE * received]
        rates = [number / (at - arrivals[0][0]) for at, number in steady if at > arrivals[0][0]]
        rate = rates[0] if rates and not error else None
        lost = 0 if result is None else result.lost
        missing = (count or 0) - received if result is None else len(result.missing)
        is_cut_short = result is None and error is None
        self.json["list"] = {
            "count": count,
            "received": received,
            "elapsed_s": round(elapsed, 4),
            "per_s": rounded(rate),
            "lost": lost,
            "missing": missing,
            "is_cut_short": is_cut_short,
            "error": None if error is None else str(error),
        }
        parts = [f"{received} of {count} in {elapsed:.2f} s"]
        parts += [f"{rate:,.0f} per second"] if rate else []
        parts += [f"{lost} requested again"] if lost else []
        parts += [f"{missing} missing"] if missing else []
        self.rows["list"] = ", ".join(parts) if error is None else str(error)
        if error is not None:
            self._find("problem", f"The list could not be downloaded: {error}.")
        elif is_cut_short:
            self._find("slow", f"The list was cut short after {elapsed:.0f} s by the time limit.")
        elif missing:
            self._find(
                "problem",
                f"{missing} of {count} parameters stayed missing: the vehicle counts parameters that it does "
                "not send.",
            )
        if rate is not None and rate < LIST_RATE_SLOW:
            self._find(
                "slow",
                f"The list is received at {rate:.0f} values per second: a slow port, a radio, or a "
                "low-bandwidth mode.",
                "Raise the port's baud rate or data rate (PX4: MAV_n_RATE, ArduPilot: SERIALn_BAUD).",
            )

    async def _check_files(self) -> None:
        """Download the packed parameter file over MAVFTP."""
        began = anyio.current_time()
        found: dict[str, Any] = {"is_serving": True}
        found |= dict.fromkeys(("size", "elapsed_s", "parameters", "defaults", "error"))
        self.json["files"] = found
        try:
            data = await self._component.read_file(PARAM_FILE + WITH_DEFAULTS, timeout=self._deadline.left())
            elapsed = anyio.current_time() - began
            content = param_pck.decode(data)
        except (FileTransferError, NoReply, PackError) as error:
            found |= {"is_serving": not isinstance(error, NoReply), "error": str(error)}
            self.rows["parameter file"] = str(error) or "none"
            if self._identification.is_ardupilot:
                self._find(
                    "slow",
                    f"The packed parameter file cannot be read ({error}), so tables are downloaded as lists, "
                    "without defaults.",
                    "Check that BRD_OPTIONS does not turn MAVFTP off (bit 1), and that the firmware is 4.1 "
                    "or newer.",
                )
            return
        count = len(content.entries)
        defaults = count if content.with_defaults else 0
        found |= {"size": len(data), "elapsed_s": rounded(elapsed), "parameters": count, "defaults": defaults}
        what = f"{count} parameters, {len(data):,} bytes in {elapsed:.2f} s"
        self.rows["parameter file"] = f"{what}, {'with' if defaults else 'without'} defaults"

    def _describe_link(self, trips: list[float]) -> None:
        """Add the round trips, and the loss of the vehicle's frames since the link was opened."""
        report, own = self._client.traffic_report(), self._component.address
        mine = next((each for each in report.components if (each.system, each.component) == own), None)
        lost = 0 if mine is None else max(mine.totals["lost"], 0)
        sent = 0 if mine is None else mine.totals["frames"] - mine.totals["repeated"] + lost
        loss = lost / sent if sent else None
        others = [
            f"{each.system}/{each.component}"
            for each in report.components
            if each.heartbeat is not None
            and (each.system, each.component) != own
            and each.heartbeat.type != MAV_TYPE_GCS
            and each.heartbeat.autopilot != MAV_AUTOPILOT_INVALID
        ]
        trip: dict[str, Any] | None = None
        if trips:
            least, middle, most = min(trips), median(trips), max(trips)
            trip = {"count": len(trips), "min_s": round(least, 4)}
            trip |= {"median_s": round(middle, 4), "max_s": round(most, 4)}
            spread = f"{milliseconds(least)} to {milliseconds(most)}"
            self.rows["round trip"] = f"{milliseconds(middle)} ({spread}, {len(trips)} commands)"
        self.json["link"] = {
            "name": self._client.link.name,
            "seconds": round(report.seconds, 3),
            "round_trip": trip,
            "loss": rounded(loss),
            "lost": lost,
            "autopilots": others,
        }
        share = "unknown" if loss is None else f"{loss:.1%}"
        self.rows["loss"] = f"{share} ({lost:,} of the vehicle's frames in {report.seconds:.1f} s)"
        self.rows["other autopilots"] = ", ".join(others) or "none"
        if loss is not None and loss >= NOTABLE_LOSS:
            self._find(
                "problem" if loss >= SEVERE_LOSS else "slow",
                f"{loss:.1%} of the vehicle's frames were lost ({lost:,}).",
                "Check antenna, distance and baud rate, or send less telemetry on this link.",
            )
        if not trips:
            self._find(
                "problem",
                "No command was acknowledged: frames to the vehicle are lost, another station was first on a "
                "port that answers only one (PX4 over UDP), or the vehicle expects signed frames.",
                "Close other ground stations and restart the vehicle's link; with signing, give "
                "--signing-key.",
            )
        elif median(trips) >= ROUND_TRIP_LONG:
            self._find(
                "slow",
                f"The round trip is {median(trips):.2f} s. Each repeat of a lost request takes at least as "
                "long.",
            )
