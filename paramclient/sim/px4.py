"""A simulated PX4 autopilot, and the metadata files that it serves."""

from __future__ import annotations

import json
import lzma
import math
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any, ClassVar, Final

from paramclient.errors import CommandResult
from paramclient.model.px4_hash import crc32_px4, hash_bits
from paramclient.model.values import ParamType, bits_of
from paramclient.sim.ftp import FileServer
from paramclient.sim.param_table import Entry, SimParam, Table, as_table, px4_table, stored_table
from paramclient.sim.vehicle import SIMULATED_COMMIT, Vehicle
from paramclient.wire import frames, messages

GENERAL_FILE: Final = "etc/extras/component_general.json.xz"
"""Path of PX4's general metadata file (COMPONENT_METADATA.hpp)."""
METADATA_FILE: Final = "etc/extras/parameters.json.xz"
"""Path of PX4's parameter metadata file (PX4's build)."""
LIMITS: Final[tuple[tuple[str, Callable[[float, float], float], str | float], ...]] = (
    ("MPC_TILTMAX_AIR", min, 89.0),
    ("MPC_TILTMAX_LND", min, "MPC_TILTMAX_AIR"),
    ("MPC_XY_CRUISE", min, "MPC_XY_VEL_MAX"),
    ("MPC_VEL_MANUAL", min, "MPC_XY_VEL_MAX"),
    ("MPC_THR_HOVER", min, "MPC_THR_MAX"),
    ("MPC_THR_HOVER", max, "MPC_THR_MIN"),
)
"""Some limits that PX4's position controller enforces: parameters, the choice of the lower or the higher
value, and the limit or the parameter that has it (measured with 1.17)."""
RESET_KEEPS: Final = (
    *("SYS_AUTOSTART", "SYS_PARAM_VER", "RC", "CAL_", "COM_FLTMODE", "LND_FLIGHT", "TC_", "COM_FLIGHT"),
)
"""Prefixes of names that SYS_AUTOCONFIG does not reset (the start script `rcS` of PX4 1.16)."""


@dataclass(kw_only=True, eq=False, repr=False)
class PX4Vehicle(Vehicle):
    """A PX4 autopilot, version 1.17, as measured; with `param_error` as newer versions.

    - PARAM_REQUEST_LIST: `_HASH_CHECK` first (type UINT32, index 65535), then all parameters in use, sorted
      by name, 20 messages every 20 ms. A request during the list restarts it without the hash, at the
      earliest 10 ms after the last 20.
    - A read of `_HASH_CHECK` returns only the hash; a set of it, to any value, stops the list.
    - A set with exactly the right type is acknowledged immediately, whatever the value. If it changed the
      value, PX4 sends that value again 10 ms later, and with it every other one that is not yet saved; both
      wait for the end of a list. These are sent in the order of the list, 20 every 20 ms. A change meanwhile
      does not start a second round: if its position has passed, it is not sent. After the values are saved,
      0.3 s after a change and 2 s after the last save, no value is sent any more. With many changes in a
      short time, some are therefore never announced.
    - Changes by `load`, and by MAV_CMD_PREFLIGHT_STORAGE with 2, which restores all values of the table, are
      never announced.
    - The position controller checks its parameters 0.4 s after one of them has changed, and sets those beyond
      their limit to the limit (see `LIMITS`); a real one takes 10 ms to 1.1 s. These changes are sent
      like any other.
    - A wrong type, an unknown name and an unknown index are not answered.
    - A parameter that is not in use can be read and set by name (index 65535) and is neither in the list
      nor in the hash.
    - With `metadata`, COMPONENT_METADATA names a general file among `files`, which names the file with the
      descriptions of the parameters.
    - MAVFTP serves `files` and, if `ftp` is on as in the newest versions, `@PARAM/param.pck` (see
      `FileServer`).
    - Only requests to its own system are answered, and to its own component or component 0.
    - The time since boot is in ATTITUDE, sent once a second and with `telemetry`. SYSTEM_TIME is not sent
      before the clock is set, which never happens. After a reboot MAV_STATE is UNINIT for 3 s.
    - A reboot command is acknowledged, and the vehicle switches off 0.4 s later; while armed it is denied.
      With the reboot, MAV_SYS_ID takes effect, and SYS_AUTOCONFIG above 0 resets parameters (see
      `RESET_KEEPS`) to the values of the table, MAV_SYS_ID to 1. Unsaved values are not lost, as they may be
      on a real one.

    Args:
        table: the parameters (see `Table`), in any order; None for those of a real quad, `px4_table()`, with
            some more that are not in use: from the second start on CAL_BARO1_ID to CAL_BARO3_ID, when the
            firmware has stored the sensors that it found at the first (a real one had 908 parameters, then
            905), and 16 of CAL_MAG2_* until CAL_MAG2_ID changes. MAV_SYS_ID, if the table has it, is set to
            `system`.
        uid: the reported hardware id; by default unique for every system.
        hash_check: whether the vehicle has `_HASH_CHECK`; the parameter MAV_HASH_CHK_EN at 0 also disables
            it.
        not_in_use: names in the table that the firmware has not used yet.
        late_use: by the name of one parameter, those that come into use 10 ms after it changes. Until then
            they are not in use.
        unsaved: names that the firmware has changed during boot and not saved.
        autosave: seconds from a change until all unsaved values are saved, if none were saved in the
            last 2 s. With 0, values are saved before they can be sent again.
        clamp_delay: seconds from a change until the position controller enforces its limits; None for never.
        burst, period: by default UDP and USB. A serial port has a burst of 3, the low-bandwidth mode 1
            every 0.125 s.
        ftp: whether there is a param.pck, as after 1.17; otherwise the response is file not found.
        ftp_rate: bytes per second of a burst of MAVFTP. By default UDP as measured.
        metadata: whether the vehicle serves descriptions of its parameters, as boards with enough memory do.

    Other arguments are those of every `Vehicle`. A list requested within `boot_time` starts after it.

    Raises:
        UsageError: an argument is invalid.
    """

    _ack_first: ClassVar = False
    _takes_broadcasts: ClassVar = False
    _shutdown_result: ClassVar = CommandResult.DENIED
    _restart_delay: ClassVar = 0.4
    _system_id: ClassVar = "MAV_SYS_ID"
    _reports_wrong_type: ClassVar = False
    _state_after_reboot = (0, 3.0)  # MAV_STATE_UNINIT
    _clock_lead: ClassVar = 0.3

    table: Table | None = None
    uid: int | None = None
    hash_check: bool = True
    not_in_use: Iterable[str] = ()
    late_use: Mapping[str, Iterable[str]] | None = None
    unsaved: Iterable[str] = ()
    autosave: float = 0.3
    clamp_delay: float | None = 0.4
    burst: int = 20
    period: float = 0.020
    ftp: bool = False
    ftp_rate: float = 1_500_000.0
    metadata: bool = False

    def __post_init__(self) -> None:
        is_built_in = self.table is None
        rows = px4_table() if self.table is None else as_table(self.table)
        content = repr([(row.name, int(row.type), row.bits) for row in rows]).encode()
        # metadata is stored by commit
        own = SIMULATED_COMMIT if is_built_in else f"{zlib.crc32(content):08x}"
        late_use = self.late_use
        if late_use is None:
            compass = stored_table("px4_compass.csv") if is_built_in else ()
            late_use = {"CAL_MAG2_ID": [row.name for row in compass]}
            rows += compass
        self._late_use = {name: frozenset(more) for name, more in late_use.items()}
        self._never_used = frozenset(self.not_in_use).union(*self._late_use.values())
        self._used_once = _FIRST_START_ONLY if is_built_in else frozenset()
        files = FileServer(self._packed_params if self.ftp else lambda: None, self.ftp_rate, is_px4=True)
        if self.metadata:
            files.files |= metadata_files(rows)
        self._set_up_table(
            sorted(rows, key=lambda row: row.name),
            _HEARTBEAT,
            messages.AutopilotVersion(
                59647,
                flight_sw_version=_MAIN if self.ftp else _RELEASE,
                git_hash=bytes.fromhex(SIMULATED_COMMIT + own)[::-1],
                board_version=1,
                uid=_UID + self.system - 1 if self.uid is None else self.uid,
            ),
            files,
        )

    def announced_hash(self) -> int | None:
        """Return the current hash of the table; None without `_HASH_CHECK`."""
        switch = self._find("MAV_HASH_CHK_EN")
        if not self.hash_check or (switch is not None and switch.bits == 0):
            return None
        return hash_bits({each.name: each.bits for each in self._listed if not each.row.volatile})

    def use(self, *names: str) -> None:
        """Mark parameters as in use: they join the list, and indices shift.

        Raises:
            UsageError: the vehicle has no parameter with such a name.
        """
        self._unused.difference_update([self._entry(name).name for name in names])
        self._relist()

    def _store(self, entry: Entry, bits: int) -> None:
        super()._store(entry, bits)
        self._unsaved.discard(entry)

    # Requests

    def _on_list(self) -> None:
        is_running = self._position is not None
        self._hash_next = not is_running and self.announced_hash() is not None
        soon = max(self._now + _TURN, self._due[self._send_list] - 0.5 * self.period)
        self._start_list(soon if is_running else self._now)

    def _on_command(self, request: messages.CommandLong, sender: frames.Frame) -> None:
        is_message = request.command == messages.MAV_CMD_REQUEST_MESSAGE
        if request.command == messages.MAV_CMD_PREFLIGHT_STORAGE and request.param1 == _RESET_ALL:
            for entry in self.entries:
                self._store(entry, entry.row.bits)
            self._acknowledge(request, sender)
        elif is_message and self.metadata and request.param1 == _METADATA:
            crc = crc32_px4(self.files[GENERAL_FILE])
            metadata = messages.ComponentMetadata(f"mftp://{GENERAL_FILE}", crc)
            self._acknowledge(request, sender, message=metadata)
        else:
            super()._on_command(request, sender)

    def _on_read(self, request: messages.ParamRequestRead, sender: frames.Frame) -> None:
        if request.param_index < 0 and request.param_id == messages.HASH_CHECK:
            self._send_hash()
        else:
            super()._on_read(request, sender)

    def _on_set(self, request: messages.ParamSet, sender: frames.Frame) -> None:
        if request.param_id != messages.HASH_CHECK:
            super()._on_set(request, sender)
        elif self.announced_hash() is not None:
            self._position = None
            self._hash_next = False

    # Changes

    def _write(self, entry: Entry, bits: int) -> None:
        if bits == entry.bits:
            return
        self._store(entry, bits)
        self._unsaved.add(entry)
        if late := self._late_use.get(entry.name):
            self._waking |= late
            self._sooner(self._wake, self._now + _PUSH_DELAY)
        if entry.name in _LIMITED and self.clamp_delay is not None:
            self._sooner(self._clamp, self._now + self.clamp_delay)
        if self._push_from is None:
            self._sooner(self._push, self._now + _PUSH_DELAY)
        self._sooner(self._save, max(self._now + self.autosave, self._save_from))

    def _is_listed(self, entry: Entry) -> bool:
        return entry.name not in self._unused

    def _end_all(self) -> None:
        super()._end_all()
        self._never_used |= self._used_once  # the sensors of the first start are stored
        autoconfig = self._find("SYS_AUTOCONFIG")
        if autoconfig is not None and autoconfig.bits != 0:
            for entry in self.entries:
                if not entry.name.startswith(RESET_KEEPS):
                    entry.store(1 if entry.name == self._system_id else entry.row.bits)
            autoconfig.store(0)

    def _switch_on(self, at: float) -> None:
        self._unused = set(self._never_used)
        self._unsaved = set(map(self._entry, self.unsaved))
        self._waking: frozenset[str] = frozenset()
        self._hash_next = False
        self._push_from: int | None = None
        self._save_from = -math.inf
        super()._switch_on(at)

    def _tasks(self) -> list[Callable[[float], None]]:
        return [self._clamp, self._wake, self._push, *super()._tasks(), self._save]

    def _clamp(self, at: float) -> None:
        """Set values beyond their limits to the limits."""
        for name, nearer, limit in LIMITS:
            entry = self._find(name)
            other = self._find(limit) if isinstance(limit, str) else None
            bound = limit if other is None else other.value
            if entry is not None and isinstance(bound, float) and isinstance(entry.value, float):
                self._write(entry, bits_of(nearer(entry.value, bound), entry.type))

    def _wake(self, at: float) -> None:
        self.use(*self._waking)

    def _push(self, at: float) -> None:
        self._push_from = 0
        self._sooner(self._send_list, at)

    def _save(self, at: float) -> None:
        self._save_from = self._now + _SAVE_INTERVAL if self.autosave else -math.inf
        self._unsaved.clear()

    # Sending

    def _send_clock(self, now: float) -> None:
        self._send_attitude()

    def _send_system_time(self, at: float) -> None:
        """Send nothing: the clock is never set."""

    def _send_next(self) -> bool:
        if self._hash_next:
            self._hash_next = False
            self._send_hash()
            return True
        return super()._send_next() or self._push_next()

    def _push_next(self) -> bool:
        """Send the next unsaved parameter; return False if there is none."""
        start, self._push_from = self._push_from, None
        for index in range(len(self._listed) if start is None else start, len(self._listed)):
            if self._listed[index] in self._unsaved:
                self._push_from = index + 1
                self._send_value(self._listed[index])
                return True
        return False

    def _send_hash(self) -> None:
        value = self.announced_hash()
        if value is not None:
            raw, place = value.to_bytes(4, "little"), (len(self._listed), messages.NO_INDEX)
            self.send(messages.ParamValue(messages.HASH_CHECK, raw, ParamType.UINT32, *place))


_LIMITED = frozenset(name for limit in LIMITS for name in limit if isinstance(name, str))
_FIRST_START_ONLY = frozenset({"CAL_BARO1_ID", "CAL_BARO2_ID", "CAL_BARO3_ID"})
_METADATA = messages.message_id(messages.ComponentMetadata)
_HEARTBEAT = messages.Heartbeat(2, messages.MAV_AUTOPILOT_PX4, 29, 50593792, system_status=3)
"""A quadrotor on standby."""
_RELEASE = 17891392
"""flight_sw_version of 1.17.0."""
_MAIN = 0x01120000
"""flight_sw_version of 1.18."""
_UID = 5283920058631409231
_PUSH_DELAY = 0.010
"""Seconds from a change until it is sent again."""
_TURN = 0.0002
"""Seconds in which received messages are processed."""
_SAVE_INTERVAL = 2.0
"""Seconds between two saves, at least."""
_RESET_ALL = 2.0
"""First parameter of MAV_CMD_PREFLIGHT_STORAGE that resets all parameters."""


@cache
def metadata_files(rows: tuple[SimParam, ...]) -> dict[str, bytes]:
    """Return the two packed files of a table, by path. Only a few parameters have more than a type."""
    path = resources.files(__package__).joinpath("tables", "px4_descriptions.json")
    known = json.loads(path.read_text(encoding="ascii"))
    described = [_described(row) | known.get(row.name, {}) for row in rows]
    parameters = _packed({"version": 1, "parameters": described})
    kinds = [{"type": 1, "uri": f"mftp://{METADATA_FILE}", "fileCrc": crc32_px4(parameters)}]
    return {
        GENERAL_FILE: _packed({"version": 1, "metadataTypes": kinds}),
        METADATA_FILE: parameters,
    }


def _packed(document: dict[str, Any]) -> bytes:
    return lzma.compress(json.dumps(document).encode(), preset=1)


def _described(row: SimParam) -> dict[str, Any]:
    described: dict[str, Any] = {
        "name": row.name,
        "type": "Float" if row.type == ParamType.REAL32 else ParamType(row.type).name.capitalize(),
        "shortDesc": f"{row.name} of the simulated vehicle",
        "group": row.name.partition("_")[0],
        "volatile": row.volatile,
    }
    value = row.value
    return described | ({"default": value} if isinstance(value, int | float) and math.isfinite(value) else {})
