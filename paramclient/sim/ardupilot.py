"""A simulated ArduPilot autopilot."""

from __future__ import annotations

import math
import re
import struct
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

from paramclient.errors import CommandResult, ParamErrorCode
from paramclient.model.values import Encoding, ParamType, bits_of
from paramclient.protocol.ftp import Opcode, Packet
from paramclient.protocol.param_pck import PARAM_FILE
from paramclient.sim.ftp import Address, FileServer
from paramclient.sim.param_table import Entry, Table, ardupilot_table, as_table, stored_table
from paramclient.sim.vehicle import SIMULATED_COMMIT, Vehicle
from paramclient.wire import frames, messages


@dataclass(kw_only=True, eq=False, repr=False)
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
      change. Hidden parameters can be read and set by name.
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
        uid2: the reported hardware id, up to 18 bytes; by default unique for every system.
        groups: by the name of a switch in the table, the parameters that are shown behind it while it is not
            0.
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

    Other arguments are those of every `Vehicle`. Within `boot_time`, PARAM_REQUEST_LIST is ignored.

    Raises:
        UsageError: an argument is invalid.
    """

    encoding: ClassVar = Encoding.C_CAST
    _restart_delay: ClassVar = 0.2
    _system_id: ClassVar = "SYSID_THISMAV"
    _clock_delay: ClassVar = 1.4
    _armed_result: ClassVar = CommandResult.FAILED

    kind: Literal["copter", "plane", "rover"] = "copter"
    uid2: bytes | None = None
    table: Table | None = None
    groups: Mapping[str, Table] | None = None
    reboot_groups: Collection[str] = ()
    read_only: Iterable[str] | None = None
    live: Collection[str] = ("BARO1_GND_PRESS", "STAT_RUNTIME")
    live_period: float = 30.0
    period: float = 0.00595
    ftp: bool = True
    ftp_rate: float = 48_500.0

    def __post_init__(self) -> None:
        is_built_in = self.table is None
        table = ardupilot_table() if self.table is None else as_table(self.table)
        groups = self.groups
        if groups is None:
            groups = {"EK2_ENABLE": stored_table("ardupilot_ek2.csv")} if is_built_in else {}
        members = {switch: as_table(group) for switch, group in groups.items()}
        rows = tuple(each for row in table for each in (row, *members.get(row.name, ())))
        self._in_groups = frozenset(row.name for row in table[_NOT_IN_GROUPS:] if is_built_in)
        self._switch_of = {row.name: switch for switch, group in members.items() for row in group}
        internal = [row.name for row in rows if _INTERNAL.fullmatch(row.name)]
        self._read_only = frozenset(internal if self.read_only is None else self.read_only)
        uid2 = self.uid2 or (int.from_bytes(_UID2, "little") + self.system - 1).to_bytes(18, "little")
        self._stored: set[Entry] = set()
        """Parameters that have had another value than at the first start."""
        self._list_fills_loop = self.burst > _BUSY_RATE * self.period
        kind, state, self._state_after_reboot = _KINDS[self.kind]
        self._set_up_table(
            rows,
            messages.Heartbeat(kind, messages.MAV_AUTOPILOT_ARDUPILOTMEGA, 81, system_status=state),
            messages.AutopilotVersion(
                64495 if self.ftp else 64495 & ~messages.CAPABILITY_FTP,
                flight_sw_version=67502080,
                git_hash=SIMULATED_COMMIT.encode("ascii"),
                uid2=uid2,
            ),
            FileServer(self._packed_params, self.ftp_rate) if self.ftp else None,
        )

    # Time

    def _switch_on(self, at: float) -> None:
        self._waiting: deque[tuple[messages.ParamRequestRead, frames.Frame]] = deque()
        self._ready: list[messages.ParamValue] = []
        self._answers: dict[Entry, ParamType | None] = {}
        """Parameters whose sets are not yet answered, with the type of the answer where it is another one."""
        self._has_answered_in_list = False
        self._list_pause_at = math.inf
        self._backlog: deque[frames.Frame] = deque()
        self._file_answers: list[tuple[Packet, Address]] = []
        self._was_on = {entry.name for entry in self.entries if entry.bits != 0}
        super()._switch_on(at)
        if not self._is_first_run:
            self._due[self._measure] = at + self._clock_delay
        if self.live_period:
            self._due[self._change_live] = at + self.live_period

    def _tasks(self) -> list[Callable[[float], None]]:
        first = [self._take_system_id, self._measure, self._change_live, self._end_look_up]
        return [*first, self._send_reads, *super()._tasks(), self._open_window, self._answer_sets]

    def _next(self, period: float, pause: float = 0.0) -> float:
        """Return the start of the next period after a pause; periods are counted from switching on."""
        if self._now < self._on_at:
            return self._on_at
        turns = (self._now + pause - self._on_at) / period
        return self._on_at + (math.floor(turns + _ROUNDING) + 1) * period

    def _send_clock(self, now: float) -> None:
        if self.kind != "copter" and now >= self._on_at + self._clock_delay:
            self._send_system_time(now)

    def _measure(self, at: float) -> None:
        """Change the values that are measured at a start by 0.1 %, and count the start."""
        for entry in self.entries:
            value = entry.value
            if entry.name == _BOOT_COUNT:
                entry.store(entry.bits + 1 & 0x7FFF)
            elif isinstance(value, float) and value and value != _NO_SENSOR and _MEASURED(entry.name):
                entry.store(bits_of(1.001 * value, entry.type))

    def _change_live(self, at: float) -> None:
        self._due[self._change_live] = self._again(at, self.live_period)
        for entry in filter(None, map(self._find, self.live)):
            if isinstance(entry.value, int):
                later = entry.bits + max(1, int(self.live_period))
                self._write(entry, later % (1 << 8 * ParamType(entry.type).size))
            else:
                self._write(entry, entry.bits ^ 1)

    # Groups

    def _key(self, name: str) -> str:
        return name.upper()

    def _is_listed(self, entry: Entry) -> bool:
        switch = self._switch_of.get(entry.name)
        if switch in self.reboot_groups:
            return switch in self._was_on
        return switch is None or self._entry(switch).bits != 0

    # Sets

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
            self._write(entry, _converted(value, entry.type))
            has_default = entry.packed is not None and entry.packed.default is None
            if has_default and entry.name in self._in_groups and entry not in self._stored:
                self._answers[entry] = ParamType.REAL32

    def _write(self, entry: Entry, bits: int) -> None:
        super()._write(entry, bits)
        self._answers.setdefault(entry, None)
        self._sooner(self._answer_sets, self._next(_LOOP))

    def _store(self, entry: Entry, bits: int) -> None:
        if bits != entry.bits:
            self._stored.add(entry)
        super()._store(entry, bits)
        if entry.name in self._switch_of.values():
            self._relist()
        if entry.name == self._system_id and self.kind != "copter":
            self._due[self._take_system_id] = self._next(1.0)

    def _answer_sets(self, at: float) -> None:
        for entry, kind in self._answers.items():
            self._send_value(entry, index=messages.NO_INDEX, kind=kind)
        self._answers.clear()

    # Reads

    def _on_read(self, request: messages.ParamRequestRead, sender: frames.Frame) -> None:
        if len(self._waiting) < _READ_QUEUE:
            self._waiting.append((request, sender))
            self._end_look_up(self._now)

    def _next_reads(self) -> float:
        """Return when the looked up responses are sent: with the next slot."""
        return self._next(_SLOT) if self._ready else math.inf

    def _look_up(self) -> None:
        """Look up responses to waiting reads until those for the next slot are complete.

        The value is that of the look-up, so a response may be older than a set received before it is sent.
        """
        look_up = self._end_look_up
        while self._waiting and len(self._ready) < _READS_PER_SLOT and self._due[look_up] == math.inf:
            request, sender = self._waiting.popleft()
            entry = self._requested(request)
            if entry is None:
                self._refuse(ParamErrorCode.DOES_NOT_EXIST, request, sender)
                self._due[look_up] = self._now + _LOOK
            elif not self._is_dead(entry):
                index = request.param_index
                name, index = (request.param_id, messages.NO_INDEX) if index < 0 else (entry.name, index)
                self._ready.append(messages.ParamValue(name, entry.raw, entry.type, len(self._listed), index))

    def _end_look_up(self, at: float) -> None:
        self._look_up()
        if self._due[self._send_reads] == math.inf and not self._is_busy:
            self._due[self._send_reads] = self._next_reads()

    def _send_reads(self, at: float) -> None:
        self._answer_reads()
        self._due[self._send_reads] = at + _SLOT if self._ready else math.inf

    def _answer_reads(self) -> None:
        """Send the completed responses, and look up those for the next slot."""
        for answer in self._ready:
            self.send(answer)
        self._ready.clear()
        self._look_up()

    # The list

    @property
    def _is_busy(self) -> bool:
        """Whether the list occupies the main loop, until a window opens for what was received meanwhile."""
        return self._due[self._open_window] < math.inf

    def _take(self, frame: frames.Frame) -> None:
        if not self._is_busy:
            super()._take(frame)
        else:
            self._backlog.append(frame)

    def _on_list(self) -> None:
        if self._now < self._on_at + self.boot_time:
            return
        self._send_banner()
        self._list_count = len(self._listed)
        self._has_answered_in_list = False
        self._list_pause_at = self._now + _LIST_START
        self._start_list(self._next(_SLOT) if self._position is None else self._due[self._send_list])

    def _send_list(self, at: float) -> None:
        if self._list_fills_loop and not self._is_busy:
            if self._list_pause_at <= at:
                self._list_pause_at = math.inf
            self._due[self._open_window] = min(self._list_pause_at, at + _LIST_RUN)
            if self._due[self._send_reads] <= at + _ROUNDING:
                self._answer_reads()
            self._due[self._send_reads] = math.inf
        super()._send_list(at)
        if self._is_busy and self._position is None:
            self._due[self._open_window] = self._list_pause_at = math.inf
            self._take_backlog()
            self._due[self._send_reads] = self._next_reads()

    def _next_place(self, position: int) -> int:
        """Return the place after the last one sent, also if parameters were shown or hidden meanwhile."""
        last = -1 if self._last_listed is None else self._last_listed.order
        return bisect_right(self._listed, last, key=lambda entry: entry.order)

    def _open_window(self, at: float) -> None:
        """Process the messages received during a run of the list, and decide how the list continues."""
        is_pause_due = self._list_pause_at <= at
        self._list_pause_at = math.inf
        self._take_backlog(until_list=not is_pause_due)
        if self._position is None:  # the vehicle has rebooted
            return
        if self._ready:
            is_first = not self._has_answered_in_list
            self._has_answered_in_list = True
            is_pause_due = not is_first or len(self._ready) + len(self._waiting) > _READS_WITHOUT_PAUSE
            self._answer_reads()
            self._due[self._send_reads] = self._next_reads() if is_pause_due else math.inf
            if is_pause_due:
                self._due[self._send_list] = self._next(_SLOT, _LIST_PAUSE)
        elif self._list_pause_at < math.inf:
            self._due[self._open_window] = self._list_pause_at
            return
        elif is_pause_due:
            self._due[self._send_list] = self._next(_SLOT)
        if not is_pause_due:
            self._due[self._open_window] = at + _LIST_RUN

    def _take_backlog(self, *, until_list: bool = False) -> None:
        """Process the waiting frames, or those up to a request for the list."""
        while self._backlog and not (until_list and self._list_pause_at < math.inf):
            super()._take(self._backlog.popleft())
        self._serve_files(self._now)

    # Files

    def _serve_files(self, at: float) -> None:
        if self.file_server is None:
            return
        room = _FILE_QUEUE - len(self._file_answers)
        if room <= 0 or self._is_busy:  # a server without room waits until now
            self._file_answers += self.file_server.work(self._now, room)
        if self._is_busy:
            is_full = len(self._file_answers) >= _FILE_QUEUE
            self._due[self._serve_files] = math.inf if is_full else self.file_server.next_deadline()
            return
        self._file_answers += self.file_server.work(self._now)
        self._due[self._serve_files] = self.file_server.next_deadline()
        for answer, sender in self._file_answers:
            self.send(messages.FileTransfer(0, *sender, answer.pack()))
            is_opened = answer.requested == Opcode.OPEN_FILE_RO and answer.opcode == Opcode.ACK
            if is_opened and any(path.startswith(PARAM_FILE) for path in self.open_files):
                self._send_banner()
        self._file_answers.clear()

    def _send_banner(self) -> None:
        for text in _BANNER:
            self.send(messages.StatusText(_INFO, text))


_INTERNAL = re.compile(r"MIS_TOTAL|BARO\d_(GND_PRESS|DEVID)|ARSPD\d?_DEVID|MNT\d_DEVID")
_MEASURED = re.compile(r"INS_GYR\d?OFFS_[XYZ]|INS_GYR2_CALTEMP|BARO\d_GND_PRESS").fullmatch
_NO_SENSOR = -300.0
"""Calibration temperature without a sensor, in °C."""
_BOOT_COUNT = "STAT_BOOTCNT"
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


def _converted(value: float, kind: ParamType | int) -> int:
    """Return the bits of a finite float32 in another type; integers are truncated and clamped."""
    if isinstance(kind, ParamType) and kind.is_integer:
        low, high = kind.bounds
        return bits_of(min(max(int(value), low), high), kind)
    return bits_of(struct.pack("<f", value), kind)
