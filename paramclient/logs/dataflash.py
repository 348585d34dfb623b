"""ArduPilot's dataflash logs (.bin): PARM messages, and the vehicle that wrote them.

The format is documented in ArduPilot's "Log messages" pages; pymavlink's DFReader parses it. The messages
read here: PARM (name, value, from version 4.3 on also the default), VER and MSG (firmware, board, hardware
id), GPS (time).
"""

from __future__ import annotations

import math
import re
from contextlib import closing
from typing import Any, Final

from pymavlink.DFReader import DFReader_binary

from paramclient.errors import FileError, UsageError
from paramclient.files.formats import LogFormat
from paramclient.logs.logged_params import OnboardLog, log_link
from paramclient.metadata.store import ARDUPILOT, OLD_NAMES
from paramclient.model.identity import Identity
from paramclient.model.paramset import WrittenParam
from paramclient.model.values import Value, check_name, shortest_float
from paramclient.wire.messages import MAV_AUTOPILOT_ARDUPILOTMEGA

VEHICLE_TYPES: Final = {name: types[0] for name, types in ARDUPILOT.values()}
"""MAV_TYPE by the name of the firmware in MSG. A copter with other than four rotors reports another type in
its heartbeat."""
SYSTEM_ID_NAMES: Final = ("MAV_SYSID", "SYSID_THISMAV")
"""The parameters that contain the system id: from version 4.7 on, and before."""
GPS_EPOCH: Final = 315_964_800
"""Unix time of 1980-01-06."""
GPS_LEAP_SECONDS: Final = 18
"""Seconds between GPS time and UTC, since 2017."""
GPS_FIX_MIN: Final = 3
"""GPS.Status from which the time is valid: a 3D fix."""
UID_SIZE: Final = 18
"""Bytes of AUTOPILOT_VERSION.uid2; the hardware id of ArduPilot's boards has 12, zeros follow."""
INITIAL_GAP_MAX: Final = 2.0
"""Seconds without a PARM message after which further ones are changes: the logger writes the initial ones
in one run, a few in each of its loops."""

_FIRMWARE: Final = re.compile(r"^(\w+) V(\d+)\.(\d+)\.(\d+)[^(]*(?:\(([0-9a-f]{7,8})\))?")
"""MSG: `ArduCopter V4.6.0-dev (3fc7011a)`."""
_HARDWARE_ID: Final = re.compile(r" ([0-9A-F]{8}) ([0-9A-F]{8}) ([0-9A-F]{8})$")
"""MSG: `CubeOrange 00380043 31385115 32383033`, the board's name and three words of its hardware id."""


def read_dataflash(path: str) -> OnboardLog:
    """Read the parameters of a dataflash log.

    PARM contains no types: integers are numbers without a type, as in a list of Mission Planner.

    Args:
        path: the file.

    Raises:
        FileError: the file cannot be read, or has no PARM messages.
    """
    log = _Messages()
    with closing(_Reader(path)) as reader:
        while (message := reader.recv_match(type={"PARM", "GPS", "VER", "MSG"}, strict=True)) is not None:
            log.receive(message.get_type(), message.to_dict())
    if not log.initial:
        raise FileError("the log has no PARM messages", source=path)
    return log.finish(path)


class _Reader(DFReader_binary):  # type: ignore[misc]  # pymavlink has no types
    """A reader that closes its file if the file cannot be parsed."""

    def __init__(self, path: str) -> None:
        try:
            super().__init__(path, zero_time_base=True)
        except BaseException:
            file = vars(self).get("filehandle")  # absent if the file could not be opened
            if file is not None:
                file.close()
            raise


class _Messages:
    """Collects the messages of one log."""

    def __init__(self) -> None:
        self.initial: dict[str, WrittenParam] = {}
        self._changes: list[tuple[float, WrittenParam]] = []
        self._latest: dict[str, WrittenParam] = {}
        self._began = self._last = self._ended = 0.0  # of all PARM, and the last one of the initial run
        self._boot_time: float | None = None
        self._damaged = 0
        self._version: dict[str, Any] = {}  # fields of the identity
        self._texts: dict[str, Any] = {}  # the same, by text; VER counts before it

    def receive(self, kind: str, fields: dict[str, Any]) -> None:
        match kind:
            case "PARM":
                self._receive_param(fields)
            case "GPS" if self._boot_time is None:
                self._boot_time = _boot_time(fields)
            case "VER":
                numbers = bytes(fields.get(name, 0) & 0xFF for name in ("Maj", "Min", "Pat", "FWT"))
                self._version["firmware"] = int.from_bytes(numbers)
                self._version["git_hash"] = f"{fields.get('GH', 0):08x}"
            case "MSG":
                self._receive_text(str(fields.get("Message", "")))

    def finish(self, path: str) -> OnboardLog:
        ids = [each.value for name in SYSTEM_ID_NAMES if (each := self.initial.get(name)) is not None]
        system = next((each for each in ids if isinstance(each, int) and 0 < each < 256), 0)
        autopilot = MAV_AUTOPILOT_ARDUPILOTMEGA
        return OnboardLog(
            path,
            LogFormat.DATAFLASH,
            Identity(system, log_link(path), autopilot=autopilot, **self._texts | self._version),
            self.initial,
            tuple(self._changes),
            self._began,
            self._ended,
            self._boot_time,
            (f"{self._damaged} PARM messages are damaged and left out",) if self._damaged else (),
        )

    def _receive_param(self, fields: dict[str, Any]) -> None:
        try:
            name = check_name(fields["Name"])
            value = _number(fields["Value"])
            time = fields["TimeUS"] / 1e6
        except (UsageError, KeyError, TypeError):
            self._damaged += 1
            return
        if not self._latest:
            self._began = self._last = time
        self._ended = max(self._ended, time)
        known, default = self._latest.get(name), fields.get("Default", math.nan)
        has_default = not math.isnan(default)
        if known is None and (has_default or time - self._last <= INITIAL_GAP_MAX):
            known = WrittenParam(name, value, None, _number(default) if has_default else None)
            self.initial[name] = known
            self._last = time
        elif known is None or value != known.value:
            known = WrittenParam(name, value, None, None if known is None else known.default)
            self._changes.append((time, known))
        self._latest[name] = known

    def _receive_text(self, text: str) -> None:
        if (found := _FIRMWARE.match(text)) is not None:
            name, *numbers, commit = found.groups()
            self._texts["firmware"] = int.from_bytes(bytes(min(int(each), 255) for each in (*numbers, 0)))
            self._texts["git_hash"] = commit or ""
            if (kind := VEHICLE_TYPES.get(OLD_NAMES.get(name, name))) is not None:
                self._texts["vehicle_type"] = kind
        elif (found := _HARDWARE_ID.search(text)) is not None:
            words = (bytes.fromhex(word)[::-1] for word in found.groups())
            self._texts["uid"] = b"".join(words).ljust(UID_SIZE, b"\0").hex()


def _boot_time(fields: dict[str, Any]) -> float | None:
    """Return the Unix time of the boot, by a GPS message; None without a fix."""
    week, time, micros = (fields.get(name) for name in ("GWk", "GMS", "TimeUS"))
    if not week or time is None or micros is None or fields.get("Status", 0) < GPS_FIX_MIN:
        return None
    return float(GPS_EPOCH + week * 604800 + time / 1e3 - GPS_LEAP_SECONDS - micros / 1e6)


def _number(value: float) -> Value:
    """Return a float32 as the number that a person would write."""
    return int(value) if value.is_integer() else shortest_float(value)
