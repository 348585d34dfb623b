"""The measurements of check: round trips, reads, list and file downloads, hash. They only read."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass
from statistics import median
from typing import Final, TypeVar

import anyio

from paramclient.cli.json_output import IdentityJson, Json
from paramclient.cli.session import Deadline
from paramclient.client.client import ParamClient
from paramclient.client.component import Component
from paramclient.errors import (
    FileTransferError,
    LinkError,
    NoReply,
    PackError,
    ParamClientError,
    VehicleError,
)
from paramclient.model.notation import hash_text, rounded
from paramclient.protocol import param_pck
from paramclient.protocol.file_download import WITH_DEFAULTS
from paramclient.protocol.list_download import ListResult, download_list
from paramclient.protocol.param_pck import PARAM_FILE
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

__all__ = ["HashMeasurement", "ListCheck", "Measurements", "Report"]

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

Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class RoundTrips(Json):
    """Measured round-trip times in seconds, and their number."""

    count: int
    min_s: float
    median_s: float
    max_s: float


@dataclass(frozen=True, slots=True)
class LinkCheck(Json):
    """The link since it was opened, `loss` and `lost` of the vehicle's frames."""

    name: str
    seconds: float
    round_trip: RoundTrips | None
    loss: float | None
    lost: int
    autopilots: list[str]


@dataclass(frozen=True, slots=True)
class ReadCheck(Json):
    """Reads of single parameters: one after the other, and `in_flight` at once."""

    single_s: float | None = None
    per_s: float | None = None
    in_flight: int = 0
    answered: int = 0


@dataclass(frozen=True, slots=True)
class ListCheck(Json):
    """The list download."""

    count: int | None
    received: int
    elapsed_s: float
    per_s: float | None
    lost: int
    missing: int
    is_cut_short: bool
    error: str | None


@dataclass(frozen=True, slots=True)
class FileCheck(Json):
    """MAVFTP and the packed parameter file; `defaults` is the number of its defaults."""

    is_serving: bool
    size: int | None
    elapsed_s: float | None
    parameters: int | None
    defaults: int | None
    error: str | None


@dataclass(frozen=True, slots=True)
class HashMeasurement(Json):
    """PX4's hash or ArduPilot's checksum, `before` the downloads, or why there is none.

    `bytes` are those of both directions.
    """

    before: str | None
    elapsed_s: float | None
    bytes: int | None
    error: str | None


@dataclass(frozen=True, slots=True)
class Report(Json):
    """All measurements of one vehicle. A part for which no time was left is None."""

    system: int
    component: int
    autopilot: str
    vehicle_type: str | None
    identity: IdentityJson
    has_version: bool
    encoding: str
    encoding_reason: str
    is_armed: bool | None
    link: LinkCheck
    reads: ReadCheck | None
    list_: ListCheck | None
    files: FileCheck | None
    hash: HashMeasurement | None
    elapsed_s: float


class Measurements:
    """The measurements of one vehicle.

    Sends no PARAM_SET, no command except MAV_CMD_REQUEST_MESSAGE, and writes no file.

    Args:
        client: an open client that counts traffic, without a cache.
        component: the vehicle.
        deadline: a measurement after it is left out, and a list download that takes longer is cut short.
        progress: called with the name of the next measurement; or None.
    """

    def __init__(
        self,
        client: ParamClient,
        component: Component,
        deadline: Deadline,
        progress: Callable[[str], None] | None,
    ) -> None:
        self._client = client
        self._component = component
        self._deadline = deadline
        self._progress = progress
        self._began = anyio.current_time()
        self._channel = component.node.channel
        self._identification = component.node.identification

    async def take(self) -> Report:
        """Take all measurements.

        Raises:
            LinkError: the link failed.
        """
        component = self._component
        listened = self._client.traffic_report().seconds
        await self._step("listening", lambda: anyio.sleep(max(0.0, CHECK_LISTENING_TIME - listened)))
        await self._step("identification", self._wait_for_identity)
        trips = await self._step("round trip", self._measure_round_trips)
        found = await self._step("hash", self._read_hash)
        reads = await self._step("single reads", self._measure_reads)
        listed = await self._step("list download", self._measure_list)
        files = await self._step("MAVFTP", self._check_files)
        kind = self._identification.vehicle_type
        return Report(
            system=component.system,
            component=component.component,
            autopilot=component.autopilot,
            vehicle_type=None if kind is None else enum_word("MAV_TYPE", kind),
            identity=IdentityJson.of(component.identity),
            has_version=self._identification.capabilities is not None,
            encoding=component.encoding.value,
            encoding_reason=component.encoding_reason,
            is_armed=component.is_armed,
            link=self._link(trips),
            reads=reads,
            list_=listed,
            files=files,
            hash=found,
            elapsed_s=round(anyio.current_time() - self._began, 3),
        )

    def _left(self) -> float:
        """Return the timeout of one request in seconds."""
        return self._deadline.left(MEASURE_TIMEOUT) or 0.0

    async def _step(self, name: str, measure: Callable[[], Awaitable[Result]]) -> Result | None:
        """Return the result of a measurement; None if no time is left for it."""
        if not self._left():
            return None
        if self._progress is not None:
            self._progress(name)
        return await measure()

    async def _wait_for_identity(self) -> None:
        """Wait until AUTOPILOT_VERSION was received or finally refused, at most `VERSION_TIMEOUT`."""
        await self._component.wait_until_identified(self._deadline.left(VERSION_TIMEOUT) or 0.0)

    async def _measure_round_trips(self) -> RoundTrips | None:
        """Measure the time from command to acknowledgement, of commands that were sent once."""
        channel, what = self._channel, f"COMMAND_ACK of {self._component.system}/{self._component.component}"
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
        if not found:
            return None
        return RoundTrips(len(found), round(min(found), 4), round(median(found), 4), round(max(found), 4))

    async def _read_hash(self) -> HashMeasurement:
        client, began = self._client, anyio.current_time()
        before = client.bytes_sent + client.bytes_received
        try:
            if self._identification.is_ardupilot:
                found = await client.ftp(self._component).checksum(PARAM_FILE, timeout=self._left())
            else:
                found = (await self._component.get(HASH_CHECK, timeout=self._left())).bits
        except (FileTransferError, NoReply, VehicleError) as error:
            return HashMeasurement(None, None, None, str(error))
        elapsed = round(anyio.current_time() - began, 4)
        sent = client.bytes_sent + client.bytes_received - before
        return HashMeasurement(hash_text(found), elapsed, sent, None)

    async def _measure_reads(self) -> ReadCheck:
        single = []
        for index in range(SINGLE_READ_COUNT):
            began = anyio.current_time()
            if await self._is_answered(index):
                single.append(anyio.current_time() - began)
            elif not single:
                return ReadCheck()
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
        return ReadCheck(rounded(median(single)), rounded(rate), len(indices), len(answered_at))

    async def _is_answered(self, index: int) -> bool:
        try:
            await self._component.get(index, timeout=self._left())
        except (NoReply, VehicleError):
            return False
        return True

    async def _measure_list(self) -> ListCheck:
        """Measure one list download, also if a file download would be faster."""
        session = self._component.session
        began = anyio.current_time()
        arrivals: list[tuple[float, int]] = []
        found: ListResult | None = None

        def progress(received: int, total: int | None) -> None:
            if received and (not arrivals or received > arrivals[-1][1]):
                arrivals.append((anyio.current_time(), received))

        session.observers.add(progress)
        try:
            # the vehicle sends the whole list even if later measurements have begun
            with anyio.move_on_after(max(0.0, (self._deadline.left() or 0.0) - MEASURE_TIMEOUT)):
                found = await download_list(session)
        except LinkError:
            raise
        except ParamClientError as error:
            elapsed = round(anyio.current_time() - began, 4)
            return ListCheck(None, 0, elapsed, None, 0, 0, is_cut_short=False, error=str(error))
        finally:
            session.observers.discard(progress)
        now = anyio.current_time()
        received = arrivals[-1][1] if arrivals else 0
        first = arrivals[0][0] if arrivals else now
        rates = (
            number / (at - first)
            for at, number in arrivals
            if number >= STEADY_SHARE * received and at > first
        )
        count = self._component.count
        return ListCheck(
            count=count,
            received=received,
            elapsed_s=round(now - began, 4),
            per_s=rounded(next(rates, None)),
            lost=0 if found is None else found.lost,
            missing=(count or 0) - received if found is None else len(found.missing),
            is_cut_short=found is None,
            error=None,
        )

    async def _check_files(self) -> FileCheck:
        began = anyio.current_time()
        try:
            ftp = self._client.ftp(self._component)
            data = await ftp.read(PARAM_FILE + WITH_DEFAULTS, timeout=self._deadline.left())
            elapsed = rounded(anyio.current_time() - began)
            content = param_pck.decode(data)
        except (FileTransferError, NoReply, PackError) as error:
            return FileCheck(not isinstance(error, NoReply), None, None, None, None, str(error))
        parameters = len(content.entries)
        defaults = parameters if content.with_defaults else 0
        return FileCheck(True, len(data), elapsed, parameters, defaults, None)

    def _link(self, trips: RoundTrips | None) -> LinkCheck:
        client, component = self._client, self._component
        report = client.traffic_report()
        address = (component.system, component.component)
        mine = next((each for each in report.components if (each.system, each.component) == address), None)
        lost = 0 if mine is None else max(mine.totals["lost"], 0)
        sent = 0 if mine is None else mine.totals["frames"] - mine.totals["repeated"] + lost
        others = [
            f"{each.system}/{each.component}"
            for each in report.components
            if each.heartbeat is not None
            and (each.system, each.component) != address
            and each.heartbeat.type != MAV_TYPE_GCS
            and each.heartbeat.autopilot != MAV_AUTOPILOT_INVALID
        ]
        return LinkCheck(
            name=client.link.name,
            seconds=round(report.seconds, 3),
            round_trip=trips,
            loss=rounded(lost / sent) if sent else None,
            lost=lost,
            autopilots=others,
        )
