"""The measurements of a diagnosis: round trips, reads, list and file downloads, hash. Only reads."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from itertools import pairwise
from statistics import median
from typing import Final, TypeVar

import anyio

from paramclient.client.client import ParamClient
from paramclient.client.component import Component
from paramclient.client.traffic import ComponentTraffic
from paramclient.diagnosis.report import (
    FileService,
    HashService,
    HeardStation,
    LinkReport,
    ListService,
    ReadService,
    VehicleReport,
)
from paramclient.errors import (
    CommandRefused,
    FileTransferError,
    LinkError,
    NoReply,
    PackError,
    ParamClientError,
    VehicleError,
)
from paramclient.metadata.download import announced_metadata
from paramclient.protocol import param_pck
from paramclient.protocol.fetch import Progress
from paramclient.protocol.file_download import PARAM_FILE, WITH_DEFAULTS
from paramclient.wire.frames import enum_word
from paramclient.wire.messages import (
    CAPABILITY_FTP,
    HASH_CHECK,
    MAV_AUTOPILOT_ARDUPILOTMEGA,
    MAV_AUTOPILOT_INVALID,
    MAV_CMD_REQUEST_MESSAGE,
    MAV_TYPE_GCS,
    AutopilotVersion,
    message_id,
)

__all__ = ["check_vehicle"]

DIAGNOSIS_LISTENING_TIME: Final = 2.2
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


async def check_vehicle(
    client: ParamClient,
    component: Component,
    *,
    timeout: float = 60.0,
    progress: Callable[[str], None] | None = None,
) -> VehicleReport:
    """Measure which services a vehicle offers, and how fast they are.

    Writes nothing: sends no PARAM_SET, no command except MAV_CMD_REQUEST_MESSAGE, and writes no file. The
    downloads fill the client's table, as any download does.

    Args:
        client: an open client, made with `traffic=True` and without a cache, so that no values are known
            before.
        component: one of its components.
        timeout: seconds for the whole diagnosis. A measurement without time left is None in the report, and a
            list download that takes longer is cut short.
        progress: called with the name of the next measurement, in words.

    Raises:
        UsageError: the client does not count traffic, or sends nothing.
        LinkError: the link failed, or the client was closed.
    """
    return await _Diagnosis(client, component, timeout, progress or _ignore).run()


class _Diagnosis:
    """One diagnosis: the measurements in their order."""

    def __init__(
        self, client: ParamClient, component: Component, timeout: float, progress: Callable[[str], None]
    ) -> None:
        self._client = client
        self._component = component
        self._began = anyio.current_time()
        self._deadline = self._began + timeout
        self._report_progress = progress
        self._unanswered = 0

    async def run(self) -> VehicleReport:
        """Take all measurements and return the report."""
        component = self._component
        self._report_progress("listening")
        self._client.traffic_report()
        self._core = component.core
        opened_at = self._core.client.opened_at
        await anyio.sleep(max(0.0, DIAGNOSIS_LISTENING_TIME - (anyio.current_time() - opened_at)))
        self._report_progress("identification")
        await self._wait_for_identity()
        self._report_progress("round trip")
        round_trips = await self._measure_round_trips()
        self._report_progress("hash")
        hash_began = anyio.current_time()
        before = await self._within(self._read_hash)
        self._report_progress("single reads")
        reads = await self._within(self._measure_reads)
        self._report_progress("list download")
        listed = await self._within(self._measure_list)
        self._report_progress("MAVFTP")
        files = await self._within(self._check_files)
        self._report_progress("descriptions")
        descriptions = await self._within(self._find_descriptions)
        self._report_progress("hash again")
        after = await self._within(self._read_hash)
        identity = component.identity
        machine = self._core.machine
        return VehicleReport(
            system=component.system,
            component=component.component,
            autopilot=component.autopilot,
            vehicle_type=_vehicle_type(machine.identification.vehicle_type),
            identity=identity,
            has_version=machine.identification.firmware is not None,
            encoding=component.encoding,
            encoding_reason=component.encoding_reason,
            is_armed=component.is_armed,
            descriptions=descriptions,
            link=self._make_link_report(round_trips),
            reads=reads,
            list=listed,
            files=files,
            hash=None if before is None else self._make_hash_service(before, after, hash_began),
            elapsed=anyio.current_time() - self._began,
        )

    def _left(self, at_most: float) -> float:
        """Return the timeout of one request in seconds: `at_most`, or the time left of the diagnosis."""
        return max(0.0, min(at_most, self._deadline - anyio.current_time()))

    async def _within(self, measure: Callable[[], Awaitable[Result]]) -> Result | None:
        """Return the result of a measurement; None if no time is left for it."""
        return await measure() if self._left(MEASURE_TIMEOUT) > 0 else None

    async def _wait_for_identity(self) -> None:
        """Wait until AUTOPILOT_VERSION was received or finally refused, at most `VERSION_TIMEOUT`."""
        with anyio.move_on_after(self._left(VERSION_TIMEOUT)):
            while not self._core.machine.identification.settled:
                await self._core.client.link_task.activity.wait()

    async def _measure_round_trips(self) -> tuple[float, ...]:
        """Return the seconds from command to acknowledgement, for commands that were sent once, sorted."""
        component, machine = self._component, self._core.machine
        round_trips: list[float] = []
        for _ in range(ROUND_TRIP_COUNT):
            left = self._left(MEASURE_TIMEOUT)
            if not left:
                break
            began = anyio.current_time()
            command = machine.commands.begin(
                MAV_CMD_REQUEST_MESSAGE, (float(message_id(AutopilotVersion)),), began
            )
            what = f"COMMAND_ACK of {component.system}/{component.component}"
            try:
                await self._core.wait(command, left, lambda what=what: (what, 0))  # type: ignore[misc]
            except CommandRefused:
                pass  # a refusal is an acknowledgement too
            except NoReply:
                self._unanswered += 1
                if not round_trips:
                    break  # the vehicle acknowledges no commands
                continue
            finally:
                machine.commands.cancel(command, anyio.current_time())
            if command.attempts == 1:
                round_trips.append(anyio.current_time() - began)
            else:
                self._unanswered += 1
        return tuple(sorted(round_trips))

    async def _read_hash(self) -> int | str:
        """Return the vehicle's present hash, or the reason why there is none."""
        if self._core.machine.identification.autopilot == MAV_AUTOPILOT_ARDUPILOTMEGA:
            return "ArduPilot has no parameter hash"
        try:
            param = await self._component.get(HASH_CHECK, timeout=self._left(MEASURE_TIMEOUT))
        except (NoReply, VehicleError) as error:
            return str(error)
        return param.bits

    async def _measure_reads(self) -> ReadService:
        component = self._component
        single = []
        for index in range(SINGLE_READ_COUNT):
            began = anyio.current_time()
            if await self._is_answered(index):
                single.append(anyio.current_time() - began)
            elif not single:
                return ReadService(None, None, 0, 0, 0)
        count = component.count or 0
        # indices spread over the table, without those that were just read
        step = max((count - SINGLE_READ_COUNT) // CONCURRENT_READ_COUNT, 1)
        indices = range(SINGLE_READ_COUNT, count, step)[:CONCURRENT_READ_COUNT]
        if not indices:
            return ReadService(median(single), None, 0, 0, 0)
        reads = self._core.machine.reads
        requests = reads.retries
        began = anyio.current_time()
        answered_at: list[float] = []

        async def read(index: int) -> None:
            if await self._is_answered(index):
                answered_at.append(anyio.current_time())

        async with anyio.create_task_group() as tasks:
            for index in indices:
                tasks.start_soon(read, index)
        rate = len(answered_at) / (max(answered_at) - began) if answered_at else None
        requests = len(indices) + reads.retries - requests
        return ReadService(median(single), rate, len(indices), len(answered_at), requests)

    async def _is_answered(self, index: int) -> bool:
        try:
            await self._component.get(index, timeout=self._left(MEASURE_TIMEOUT))
        except (NoReply, VehicleError):
            return False
        return True

    async def _measure_list(self) -> ListService:
        """Measure one list download, also if a file download would be faster."""
        machine = self._core.machine
        began = anyio.current_time()
        arrivals: list[tuple[float, int]] = []

        def progress(state: Progress) -> None:
            if state.received and (not arrivals or state.received > arrivals[-1][1]):
                arrivals.append((anyio.current_time(), state.received))

        # the vehicle sends the whole list even if later measurements have begun
        deadline = max(began, self._deadline - MEASURE_TIMEOUT)
        try:
            fetch = machine.begin_fetch(began, refresh=True, by_list=True)
            try:
                result = await self._core.wait_for_fetch(fetch, deadline, progress)
            finally:
                machine.end_fetch(fetch, anyio.current_time())
                self._core.client.wake()
        except LinkError:
            raise
        except ParamClientError as error:
            elapsed = anyio.current_time() - began
            return ListService(None, 0, elapsed, None, None, 0.0, 0, 0, False, str(error))
        now = anyio.current_time()
        has_arrived = fetch.first_value_at <= now
        return ListService(
            count=result.count,
            received=result.received,
            elapsed=now - began,
            first=fetch.first_value_at - began if has_arrived else None,
            rate=_steady_rate(fetch.first_value_at, [*arrivals, (now, result.received)], result.received),
            longest_pause=_longest_pause(fetch.first_value_at, arrivals) if has_arrived else 0.0,
            lost=result.lost,
            missing=len(result.missing),
            is_cut_short=not fetch.done,
            error=None,
        )

    async def _check_files(self) -> FileService:
        machine = self._core.machine
        capabilities = machine.identification.capabilities
        is_announced = None if capabilities is None else bool(capabilities & CAPABILITY_FTP)
        ftp = self._client.ftp(self._component)
        entries: tuple[str, ...] | None = None
        size = parameters = defaults = None
        elapsed: float | None = None
        error: str | None = None
        is_serving = False
        try:
            began = anyio.current_time()
            data = await ftp.read(PARAM_FILE + WITH_DEFAULTS, timeout=self._left(float("inf")))
            elapsed = anyio.current_time() - began
            is_serving = True
            size = len(data)
            content = param_pck.decode(data)
            parameters = len(content.entries)
            defaults = parameters if content.with_defaults else 0
        except FileTransferError as refusal:
            is_serving = True
            error = str(refusal)
        except (NoReply, PackError) as failure:
            error = str(failure)
        if is_serving:
            try:
                listed = await ftp.list("/", timeout=self._left(MEASURE_TIMEOUT))
                named = (each for each in listed if each.name not in (".", ".."))  # ArduPilot lists both
                entries = tuple(sorted(each.name + "/" * each.is_directory for each in named))
            except (NoReply, VehicleError):
                entries = None
        return FileService(is_announced, is_serving, entries, size, elapsed, parameters, defaults, error)

    async def _find_descriptions(self) -> str | None:
        try:
            announced = await announced_metadata(self._component, self._left(MEASURE_TIMEOUT))
        except (NoReply, VehicleError):
            return None
        return None if announced is None else announced.uri

    def _make_hash_service(self, before: int | str, after: int | str | None, began: float) -> HashService:
        seconds = anyio.current_time() - began
        if isinstance(before, str):
            return HashService(None, None, seconds, None, before)
        last = self._core.machine.fetches.last
        confirms = None if last is None or last.missing else last.hash is not None
        return HashService(before, after if isinstance(after, int) else None, seconds, confirms, None)

    def _make_link_report(self, round_trips: tuple[float, ...]) -> LinkReport:
        client, component = self._client, self._component
        report = client.traffic_report()
        own = self._core.client.station.own_address
        address = (component.system, component.component)
        mine = next((each for each in report.components if (each.system, each.component) == address), None)
        sent = 0 if mine is None else mine.frames - mine.repeated + mine.lost
        return LinkReport(
            name=client.link.name,
            seconds=report.seconds,
            round_trips=round_trips,
            unanswered=self._unanswered,
            loss=max(mine.lost, 0) / sent if mine is not None and sent > 0 else None,
            lost=0 if mine is None else max(mine.lost, 0),
            repeated=0 if mine is None else mine.repeated,
            damaged=report.damaged,
            unusable_names=self._core.machine.table.left_out,
            unknown=report.unknown,
            other_bytes=report.other_bytes,
            bytes_received=report.bytes_received,
            bytes_sent=report.bytes_sent,
            mavlink=0 if mine is None else mine.version,
            signed=0 if mine is None else mine.signed,
            autopilots=tuple(
                (each.system, each.component)
                for each in report.components
                if (each.system, each.component) != address and _is_autopilot(each)
            ),
            stations=tuple(
                HeardStation(each.system, each.component, (each.system, each.component) == own)
                for each in report.components
                if each.heartbeat is not None and each.heartbeat.type == MAV_TYPE_GCS
            ),
            radio_free=next((each.radio.free for each in report.components if each.radio is not None), None),
        )


def _is_autopilot(each: ComponentTraffic) -> bool:
    beat = each.heartbeat
    return beat is not None and beat.type != MAV_TYPE_GCS and beat.autopilot != MAV_AUTOPILOT_INVALID


def _vehicle_type(number: int | None) -> str | None:
    return None if number is None else enum_word("MAV_TYPE", number)


def _steady_rate(first: float, arrivals: list[tuple[float, int]], received: int) -> float | None:
    """Return values per second up to the time at which `STEADY_SHARE` of them were received, or None."""
    for at, number in arrivals:
        if number >= STEADY_SHARE * received and at > first:
            return number / (at - first)
    return None


def _longest_pause(first: float, arrivals: list[tuple[float, int]]) -> float:
    moments = [first, *(at for at, _ in arrivals)]
    return max((later - earlier for earlier, later in pairwise(moments)), default=0.0)


def _ignore(_: str) -> None:
    """Report nothing: the default of `progress`."""
