"""A simulated ArduPilot autopilot."""

from __future__ import annotations

import math
import re
import struct
from bisect import bisect_right
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from typing import Literal, Unpack

from paramclient.errors import CommandResult, ParamErrorCode, UsageError
from paramclient.model.values import Encoding, ParamType, WireValue, bits_of, from_bits
from paramclient.protocol.ftp import Opcode, Packet
from paramclient.protocol.param_pck import PARAM_FILE
from paramclient.sim.ftp import Address, FileServer
from paramclient.sim.param_table import (
    Entry,
    SimParam,
    Table,
    ardupilot_table,
    as_table,
    ek2_group,
    with_system_id,
)
from paramclient.sim.vehicle import SIMULATED_COMMIT, Vehicle, VehicleOptions
from paramclient.wire import frames, messages

__all__ = ["ArduPilotVehicle"]


class ArduPilotVehicle(Vehicle):
    """An ArduPilot autopilot, ArduCopter 4.6, as measured; with `param_error` as newer versions.

    - Values are sent as float32 for every type; type and value are exact on board.
    - PARAM_REQUEST_LIST: a banner, then all parameters by index from the next slot on (slots start every
      100 ms), 10 every 5.95 ms. A second request restarts the list. The list keeps the count of its start,
      also if a group is shown or hidden meanwhile.
    - A list of more than 1,000 values per second occupies the main loop: for 130 ms, received messages are
      not processed, and no block of a file is sent. Then all received messages are processed. If a list was
      requested, it restarts at 0 immediately, pauses 18 ms later and continues with the next slot. If there
      are reads, 5 are answered and the list pauses; the next slot answers 5 more, the one after it 5 more and
      continues the list. The list therefore runs for 130 of every 300 ms. The first time in a list, up to 10
      waiting reads do not make it pause.
    - Reads wait for the next slot, which serves 5; 20 more can wait, further ones are dropped silently. A
      read of an unknown name takes 5 ms, and no place in a slot. A response by name has index 65535 and the
      requested spelling; names are case-insensitive.
    - A set converts the value to the parameter's type (truncated to whole numbers, clamped to its range) and
      is answered within 6 ms, index 65535, even if nothing changed; sets of one name meanwhile share one
      response. NaN, infinity and unknown names are not answered. For a read-only parameter, the old value and
      a STATUSTEXT are sent.
    - The response to a set has the type REAL32, independent of the parameter's type, if the value is the
      default, the parameter never had another value, and it belongs to a group: of the real quad's table,
      all but the first 57.
    - A parameter that switches a group shows it while it is not 0 and hides it at 0: count and indices
      change. A group may contain the switch of another one, which is shown while both are not 0. Hidden
      parameters can be read and set by name.
    - MAVFTP serves `@PARAM/param.pck` and `files`: one session, 5 requests waiting, bursts limited to a third
      of the link (see `FileServer`).
    - SYSID_THISMAV takes effect with the next full second, on a Copter after a reboot, without announcement.
    - A reboot command is acknowledged, and the vehicle switches off 0.2 s later; while armed the result is
      FAILED. After the reboot, the heartbeat has another MAV_STATE for a while: ACTIVE for 2 s on a Copter,
      CALIBRATING on the others.
    - SYSTEM_TIME is sent once a second by Plane and Rover, according to their stream settings; by a Copter
      only on request. It is not sent before the main loop runs, 1.4 s after the first heartbeat; an earlier
      request is acknowledged, and SYSTEM_TIME sent then.
    - After every start but the first, the vehicle measures gyroscopes and barometers again (INS_GYR*OFFS_*,
      INS_GYR2_CALTEMP, BARO*_GND_PRESS of existing sensors) when the main loop starts, and counts the start
      (STAT_BOOTCNT), without announcement.
    - Some values change on their own and are sent unsolicited, index 65535.

    Args:
        table: the parameters (see `Table`), in the order of their indices; None for those of a real quad,
            `ardupilot_table()`. SYSID_THISMAV, if the table has it, is set to `system`.
        kind: "copter", "plane" or "rover".
        system, component: the vehicle's ids, 1 to 255.
        uid2: the reported hardware id, up to 18 bytes; by default unique for every system.
        groups: by the name of a switch in the table or in another group, the parameters that are shown behind
            it while it is not 0.
            None: with the table of the real quad, the 52 of EK2_ENABLE; with another table, none.
        reboot_groups: names of switches that take effect only after a reboot.
        read_only: names that cannot be set. None: those that ArduPilot marks as internal, such as
            BARO1_GND_PRESS and BARO1_DEVID.
        live: names of parameters that change on their own: whole numbers count seconds, others change their
            last bit. Names that are not in the table are ignored.
        live_period: seconds between two such changes; 0 for none.
        burst, period: by default UDP. On 57600 baud it is 1 every 0.025 s.
        ftp: whether MAVFTP is available.
        ftp_rate: bytes per second of a burst: a third of the link. By default UDP as measured; on 57600 baud
            it is 1920.
        options: those of every `Vehicle`. Within `boot_time`, PARAM_REQUEST_LIST is ignored.

    Raises:
        UsageError: an argument is invalid.
    """

    _restart_delay = 0.2
    _clock_delay = 1.4
    _armed_result = CommandResult.FAILED
    _read_at: float
    _answer_at: float

    def __init__(
        self,
        *,
        kind: Literal["copter", "plane", "rover"] = "copter",
        system: int = 1,
        component: int = 1,
        uid2: bytes | None = None,
        table: Table | None = None,
        groups: Mapping[str, Table] | None = None,
        reboot_groups: Iterable[str] = (),
        read_only: Iterable[str] | None = None,
        live: Iterable[str] = ("STAT_RUNTIME", "BARO1_GND_PRESS"),
        live_period: float = 30.0,
        burst: int = 10,
        period: float = 0.00595,
        ftp: bool = True,
        ftp_rate: float = 48_500.0,
        **options: Unpack[VehicleOptions],
    ) -> None:
        if kind not in _KINDS:
            raise UsageError(f"kind must be one of {', '.join(_KINDS)}, not {kind!r}")
        self._is_copter = kind == "copter"
        vehicle_type, state, self._start_state = _KINDS[kind]
        if groups is None:
            groups = {"EK2_ENABLE": ek2_group()} if table is None else {}
        rows = with_system_id(ardupilot_table() if table is None else as_table(table), _SYSTEM_ID, system)
        members = {switch: as_table(group) for switch, group in groups.items()}
        if read_only is None:
            every = (row.name for group in (rows, *members.values()) for row in group)
            read_only = [name for name in every if _INTERNAL.fullmatch(name)]
        elif unknown := frozenset(read_only).difference(row.name for row in rows):
            raise UsageError(f"not in the table: {', '.join(sorted(unknown))}")
        every_row = tuple(_with_groups(rows, dict(members)))
        if unknown := frozenset(members).difference(row.name for row in every_row):
            raise UsageError(f"not in the table: {', '.join(sorted(unknown))}")
        if uid2 is None:
            uid2 = (int.from_bytes(_UID2, "little") + system - 1).to_bytes(18, "little")
        if len(uid2) > 18:
            raise UsageError(f"uid2 must have at most 18 bytes, not {len(uid2)}")
        if not 0.0 <= live_period < math.inf:
            raise UsageError(f"live_period must be a number of seconds from 0 up, not {live_period}")
        if ftp:
            self.file_server = FileServer(self._packed_params, ftp_rate)
        self._in_groups = (
            frozenset(row.name for row in rows[_NOT_IN_GROUPS:]) if table is None else frozenset()
        )
        self._stored: set[str] = set()
        self._switch_of = {row.name: switch for switch, group in members.items() for row in group}
        self._switches = members.keys()
        self._late_switches = frozenset(reboot_groups)
        if others := self._late_switches - self._switches:
            raise UsageError(f"reboot_groups that are not switches in groups: {', '.join(sorted(others))}")
        self._was_on = {row.name: row.bits != 0 for row in every_row if row.name in self._late_switches}
        self._read_only = frozenset(read_only)
        self._live = frozenset(live)
        self._live_period = live_period
        super().__init__(
            as_table(every_row),
            system=system,
            component=component,
            encoding=Encoding.C_CAST,
            heartbeat=messages.Heartbeat(
                vehicle_type, messages.MAV_AUTOPILOT_ARDUPILOTMEGA, base_mode=81, system_status=state
            ),
            version=messages.AutopilotVersion(
                64495 if ftp else 64495 & ~messages.CAPABILITY_FTP,
                flight_sw_version=67502080,
                git_hash=SIMULATED_COMMIT.encode("ascii"),
                uid2=uid2.ljust(18, b"\0"),
            ),
            burst=burst,
            period=period,
            **options,
        )
        self._list_fills_loop = burst > _BUSY_RATE * period

    def _key(self, name: str) -> str:
        return name.upper()

    def _is_listed(self, entry: Entry) -> bool:
        switch = self._switch_of.get(entry.name)
        while switch is not None:
            is_on = self._was_on[switch] if switch in self._late_switches else self._entry(switch).bits != 0
            if not is_on:
                return False
            switch = self._switch_of.get(switch)
        return True

    def _timers(self) -> tuple[float, ...]:
        times = (self._read_at, self._look_at, self._answer_at, self._live_at)
        return *times, self._system_id_at, self._window_at, self._measured_at

    def _take(self, frame: frames.Frame) -> None:
        if self._window_at == math.inf:
            super()._take(frame)
        elif len(self._backlog) < _BACKLOG:
            self._backlog.append(frame)

    def _on_list(self) -> None:
        if self._now < self._on_at + self._boot_time:
            return
        self._send_banner()
        self._list_count = len(self._listed)
        self._has_answered_in_list = False
        self._list_pause_at = self._now + _LIST_START
        self._start_list(self._next(_SLOT) if self._position is None else self._next_burst)

    def _on_read(self, request: messages.ParamRequestRead, sender: frames.Frame) -> None:
        if len(self._waiting) < _READ_QUEUE:
            self._waiting.append((request, sender))
            self._look_up()
            if self._ready and self._read_at == math.inf:
                self._read_at = self._next(_SLOT)

    def _on_set(self, request: messages.ParamSet, sender: frames.Frame) -> None:
        entry = self._find(request.param_id)
        (value,) = struct.unpack("<f", request.raw)
        if entry is None:
            self._refuse(ParamErrorCode.DOES_NOT_EXIST, request, sender)
        elif not math.isfinite(value):
            self._refuse(ParamErrorCode.VALUE_OUT_OF_RANGE, request, sender)
        elif entry.name in self._read_only:
            self._send_value(entry, index=messages.NO_INDEX)
            self.send(messages.StatusText(_WARNING, f"Param write denied ({entry.name})"))
            self._refuse(ParamErrorCode.READ_ONLY, request, sender)
        else:
            bits = _converted(value, entry.type)
            if bits == entry.bits and self._was_never_stored(entry):
                self._untyped.add(entry.name)
            self._write(entry, bits)

    def _was_never_stored(self, entry: Entry) -> bool:
        """Return whether a parameter of a group has its default and has never had another value."""
        has_default = entry.packed is not None and entry.packed.default is None
        return has_default and entry.name in self._in_groups and entry.name not in self._stored

    def _write(self, entry: Entry, bits: int) -> None:
        self._hold(entry, bits)
        self._answers[entry.name] = entry
        self._answer_at = min(self._answer_at, self._next(_LOOP))

    def _next_place(self, position: int) -> int:
        """Return the place after the last one sent, also if parameters were shown or hidden meanwhile."""
        last = -1 if self._last_listed is None else self._last_listed.order
        return bisect_right(self._listed, last, key=lambda entry: entry.order)

    def _count_in_list(self) -> int:
        return self._list_count

    def load(self, values: Mapping[str, WireValue]) -> None:
        """Change values as code on board does that announces nothing.

        Raises:
            UsageError: the vehicle has no parameter with such a name, or a value does not fit its type.
        """
        for name, value in values.items():
            entry = self._entry(name)
            self._hold(entry, bits_of(value, entry.type))

    def _hold(self, entry: Entry, bits: int) -> None:
        if bits != entry.bits:
            self._stored.add(entry.name)
        entry.store(bits)
        if entry.name in self._switches:
            self._relist()
        if entry.name == _SYSTEM_ID and not self._is_copter:
            self._system_id_at = self._next(1.0)

    def _send_clock(self, now: float) -> None:
        if not self._is_copter and now >= self._on_at + self._clock_delay:
            self._send_system_time(now)

    def _end_all(self) -> None:
        super()._end_all()
        self._was_on = {name: self._entry(name).bits != 0 for name in self._late_switches}
        self._take_system_id(self._find(_SYSTEM_ID))

    def _switch_on(self, at: float) -> None:
        self._waiting: deque[tuple[messages.ParamRequestRead, frames.Frame]] = deque()
        self._ready: list[messages.ParamValue] = []
        self._answers: dict[str, Entry] = {}
        self._untyped: set[str] = set()
        self._read_at = math.inf
        self._look_at = math.inf
        self._answer_at = math.inf
        self._system_id_at = math.inf
        self._measured_at = math.inf if self._is_first_run else at + self._clock_delay
        self._live_at = at + self._live_period if self._live_period else math.inf
        self._list_count = 0
        self._has_answered_in_list = False
        self._list_pause_at = math.inf
        self._window_at = math.inf
        self._backlog: list[frames.Frame] = []
        self._file_answers: list[tuple[Packet, Address]] = []
        super()._switch_on(at)

    def _work(self, now: float) -> None:
        if self._system_id_at <= now:
            self._system_id_at = math.inf
            self._take_system_id(self._find(_SYSTEM_ID))
        if self._measured_at <= now:
            self._measured_at = math.inf
            self._measure()
        if self._live_at <= now:
            self._live_at += self._live_period
            if self._live_at <= now:
                self._live_at = now + self._live_period
            self._change_live()
        if self._look_at <= now:
            self._look_at = math.inf
            self._look_up()
            if self._ready and self._read_at == math.inf and self._window_at == math.inf:
                self._read_at = self._next(_SLOT)
        while self._read_at <= now:
            self._answer_reads()
            self._read_at = self._read_at + _SLOT if self._ready else math.inf
        super()._work(now)
        self._process_backlog(now)
        if self._answer_at <= now:
            self._answer_at = math.inf
            for entry in self._answers.values():
                kind = ParamType.REAL32 if entry.name in self._untyped else None
                self._send_value(entry, index=messages.NO_INDEX, kind=kind)
            self._answers.clear()
            self._untyped.clear()

    def _measure(self) -> None:
        """Change the values that are measured at a start by 0.1 %, and count the start."""
        for entry in self.entries:
            if entry.name == _BOOT_COUNT:
                entry.store(entry.bits + 1 & 0x7FFF)
            value = from_bits(entry.bits, entry.type)
            if (
                _MEASURED.fullmatch(entry.name)
                and isinstance(value, float)
                and value not in (0.0, _NO_SENSOR)
            ):
                entry.store(bits_of(1.001 * float(value), entry.type))

    def _send_list(self, now: float) -> None:
        starts_at = self._next_burst
        if self._list_fills_loop and self._window_at == math.inf and starts_at <= now:
            if not starts_at < self._list_pause_at:
                self._list_pause_at = math.inf
            self._window_at = min(self._list_pause_at, starts_at + _LIST_RUN)
            if self._read_at <= starts_at + _ROUNDING:
                self._answer_reads()
            self._read_at = math.inf
        super()._send_list(now)

    def _process_backlog(self, now: float) -> None:
        """Process received messages, after the list has occupied the main loop."""
        if self._window_at == math.inf:
            return
        if self._position is None or self._high_latency:
            self._window_at = self._list_pause_at = math.inf
            self._take_backlog()
            self._read_at = self._next(_SLOT) if self._ready else math.inf
        elif self._window_at <= now:
            self._open_window(self._window_at)

    def _open_window(self, at: float) -> None:
        """Process the messages received during a run of the list, and decide how the list continues."""
        is_pause_due = self._list_pause_at <= at
        self._list_pause_at = self._window_at = math.inf
        self._take_backlog(until_list=not is_pause_due)
        if self._position is None:  # the vehicle has rebooted
            return
        if self._ready:
            is_first = not self._has_answered_in_list
            self._has_answered_in_list = True
            is_pause_due = not is_first or len(self._ready) + len(self._waiting) > _READS_WITHOUT_PAUSE
            self._answer_reads()
            self._read_at = self._next(_SLOT) if self._ready and is_pause_due else math.inf
            if is_pause_due:
                self._next_burst = self._next(_SLOT, after=at + _LIST_PAUSE)
        elif self._list_pause_at < math.inf:
            self._window_at = self._list_pause_at
            return
        elif is_pause_due:
            self._next_burst = self._next(_SLOT)
        if not is_pause_due:
            self._window_at = at + _LIST_RUN

    def _take_backlog(self, *, until_list: bool = False) -> None:
        """Process the waiting frames, or those up to a request for the list."""
        backlog, self._backlog = deque(self._backlog), []
        while backlog and not (until_list and self._list_pause_at < math.inf):
            super()._take(backlog.popleft())
        self._backlog.extend(backlog)
        if not self._high_latency:
            self._serve_files(self._now)

    def _answer_reads(self) -> None:
        """Send the completed responses, and look up those for the next slot."""
        for answer in self._ready:
            self.send(answer)
        self._ready.clear()
        self._look_up()

    def _serve_files(self, now: float) -> None:
        if self.file_server is None:
            return
        is_held = self._window_at < math.inf
        self._file_answers += self.file_server.work(
            now, _FILE_QUEUE - len(self._file_answers) if is_held else None
        )
        if is_held:
            return
        for answer, sender in self._file_answers:
            self.send(messages.FileTransfer(0, *sender, answer.pack()))
            is_opened = answer.requested == Opcode.OPEN_FILE_RO and answer.opcode == Opcode.ACK
            if is_opened and any(path.startswith(PARAM_FILE) for path in self.open_files):
                self._send_banner()
        self._file_answers.clear()

    def _next_file_work(self) -> float:
        is_full = self._window_at < math.inf and len(self._file_answers) >= _FILE_QUEUE
        return math.inf if is_full else super()._next_file_work()

    def _send_banner(self) -> None:
        for text in _BANNER:
            self.send(messages.StatusText(_INFO, text))

    def _next(self, period: float, *, after: float | None = None) -> float:
        """Return the start of the next period; periods are counted from switching on."""
        if after is None:
            after = self._now
        if after < self._on_at:
            return self._on_at
        turns = (after - self._on_at) / period
        return self._on_at + (math.floor(turns + _ROUNDING) + 1) * period

    def _look_up(self) -> None:
        """Look up responses to waiting reads until those for the next slot are complete.

        The value is that of the look-up, so a response may be older than a set received before it is sent.
        """
        while self._waiting and len(self._ready) < _READS_PER_SLOT and self._look_at == math.inf:
            request, sender = self._waiting.popleft()
            if request.param_index == -1:
                entry, name, index = self._find(request.param_id), request.param_id, messages.NO_INDEX
            else:
                entry = self._by_index(request.param_index)
                name, index = ("" if entry is None else entry.name), request.param_index
            if entry is None:
                self._refuse(ParamErrorCode.DOES_NOT_EXIST, request, sender)
                self._look_at = self._now + _LOOK
            elif not self._is_dead(entry):
                self._ready.append(messages.ParamValue(name, entry.raw, entry.type, len(self._listed), index))

    def _change_live(self) -> None:
        for entry in self.entries:
            if entry.name in self._live:
                value = entry.value
                if isinstance(value, int) and isinstance(entry.type, ParamType):
                    later = value + max(1, int(self._live_period))
                    self._write(entry, bits_of(later if later <= entry.type.bounds[1] else 0, entry.type))
                else:
                    self._write(entry, entry.bits ^ 1)


_INTERNAL = re.compile(r"MIS_TOTAL|BARO\d_(GND_PRESS|DEVID)|ARSPD\d?_DEVID|MNT\d_DEVID")
_MEASURED = re.compile(r"INS_GYR\d?OFFS_[XYZ]|INS_GYR2_CALTEMP|BARO\d_GND_PRESS")
_NO_SENSOR = -300.0
"""Calibration temperature without a sensor, in °C."""
_BOOT_COUNT = "STAT_BOOTCNT"
_SYSTEM_ID = "SYSID_THISMAV"
_STANDBY = 3
_CALIBRATING = 2
_KINDS: dict[str, tuple[int, int, tuple[int, float]]] = {
    "copter": (2, _STANDBY, (messages.MAV_STATE_ACTIVE, 2.0)),
    "plane": (1, _STANDBY, (_CALIBRATING, 0.7)),
    "rover": (10, messages.MAV_STATE_ACTIVE, (_CALIBRATING, 1.3)),
}
"""By kind: MAV_TYPE, MAV_STATE while disarmed, MAV_STATE after a reboot, and its duration in seconds."""
_UID2 = b"3d1219c7c4c5404aa\0"
_BANNER = (
    f"ArduCopter V4.6.0-dev ({SIMULATED_COMMIT})",
    "3d1219c7c4c5404aaa1f6d2a48adfda4",
    "Frame: QUAD/PLUS",
)
_INFO = 6
_WARNING = 4
_LOOP = 0.0058
"""Period of the main loop, which answers sets, in seconds."""
_SLOT = 0.1
"""Period of the parameter task, which answers reads, in seconds."""
_ROUNDING = 1e-6
"""Tolerance for the number of periods, which may be slightly less than whole at the start of a period."""
_LOOK = 0.005
"""Seconds per look-up of an unknown name; real boards take 1 ms."""
_READS_PER_SLOT = 5
_READ_QUEUE = 20
_NOT_IN_GROUPS = 57
"""Number of parameters at the start of the real quad's table that belong to no group."""
_BUSY_RATE = 1000.0
"""Values per second above which a list occupies the main loop."""
_LIST_RUN = 0.130
"""Seconds for which such a list occupies the main loop."""
_LIST_START = 0.018
"""Seconds from a list request until the list pauses, if a slot has started in between."""
_LIST_PAUSE = 0.080
"""Seconds from the responses to reads until a slot may continue the list."""
_READS_WITHOUT_PAUSE = 10
"""Reads, waiting for the first time in a list, that do not make it pause."""
_FILE_QUEUE = 19
"""MAVFTP responses that wait while a list occupies the main loop, in addition to the one in preparation."""
_BACKLOG = 1000
"""Received frames that wait for processing."""


def _with_groups(rows: Iterable[SimParam], groups: dict[str, tuple[SimParam, ...]]) -> Iterator[SimParam]:
    """Yield parameters, each with the group behind it that it switches, and take that group."""
    for row in rows:
        yield row
        yield from _with_groups(groups.pop(row.name, ()), groups)


def _converted(value: float, kind: ParamType | int) -> int:
    """Return the bits of a finite float32 in another type; integers are truncated and clamped."""
    if isinstance(kind, ParamType) and kind.is_integer:
        low, high = kind.bounds
        return bits_of(min(max(int(value), low), high), kind)
    return bits_of(struct.pack("<f", value) if kind != ParamType.REAL64 else value, kind)
