"""ArduPilot's dataflash logs (.bin): PARM messages, and the vehicle that wrote them.

The format is documented in ArduPilot's "Log messages" pages; pymavlink's DFReader parses it. The messages
read here: PARM (name, value, from version 4.3 on also the default), VER and MSG (firmware, board, hardware
id), GPS (time).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from contextlib import closing
from typing import Any, Final

from pymavlink.DFReader import DFReader_binary

from paramclient.errors import FileError, UsageError
from paramclient.files.formats import LogFormat
from paramclient.logs.logged_params import LoggedChange, OnboardLog, log_link
from paramclient.model.identity import Identity
from paramclient.model.paramset import WrittenParam
from paramclient.model.values import WireValue, check_name, shortest_float
from paramclient.wire.messages import MAV_AUTOPILOT_ARDUPILOTMEGA

__all__ = ["read_dataflash"]

VEHICLE_TYPES: Final = {
    "ArduCopter": 2,
    "ArduPlane": 1,
    "ArduRover": 10,
    "ArduSub": 12,
    "Blimp": 7,
    "AntennaTracker": 5,
    "APMrover2": 10,
    "Rover": 10,
}
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
    with closing(_Reader(path)) as reader:
        boot_time = _boot_time(reader)
        log = _Messages()
        for message in _messages(reader, {"PARM", "VER", "MSG"}):
            log.receive(message)
    if not log.initial:
        raise FileError("the log has no PARM messages", source=path)
    return log.finish(path, boot_time)


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


def _messages(reader: Any, types: set[str]) -> Iterator[Any]:
    """Generate the messages of these types, in the order of the file."""
    reader.rewind()
    while (message := reader.recv_match(type=types, strict=True)) is not None:
        yield message


def _boot_time(reader: Any) -> float | None:
    """Return the Unix time of the boot, by the first GPS message with a fix; None without one."""
    for message in _messages(reader, {"GPS"}):
        fields = message.to_dict()
        week, time, micros = (fields.get(name) for name in ("GWk", "GMS", "TimeUS"))
        if week and time is not None and micros is not None and fields.get("Status", 0) >= GPS_FIX_MIN:
            at = GPS_EPOCH + week * 604800 + time / 1e3 - GPS_LEAP_SECONDS
            return float(at - micros / 1e6)
    return None


class _Messages:
    """Collects the messages of one log."""

    def __init__(self) -> None:
        self.initial: dict[str, WrittenParam] = {}
        self._changes: list[LoggedChange] = []
        self._values: dict[str, WireValue] = {}  # the latest, by name
        self._began: float | None = None
        self._last = 0.0  # time of the last PARM of the initial run
        self._ended = 0.0
        self._uid: str | None = None
        self._firmware = self._vehicle_type = self._refused = 0
        self._git_hash = ""

    def receive(self, message: Any) -> None:
        fields = message.to_dict()
        match message.get_type():
            case "PARM":
                self._receive_param(fields)
            case "VER":
                self._receive_version(fields)
            case "MSG":
                self._receive_text(str(fields.get("Message", "")))

    def finish(self, path: str, boot_time: float | None) -> OnboardLog:
        ids = (self.initial.get(name) for name in SYSTEM_ID_NAMES)
        system = next((int(each.settable) for each in ids if each is not None and _is_id(each.settable)), 0)
        refused = self._refused
        notes = (f"{refused} PARM messages are damaged and left out",) if refused else ()
        return OnboardLog(
            path,
            LogFormat.DATAFLASH,
            Identity(
                system=system,
                link=log_link(path),
                uid=self._uid,
                autopilot=MAV_AUTOPILOT_ARDUPILOTMEGA,
                vehicle_type=self._vehicle_type,
                firmware=self._firmware,
                git_hash=self._git_hash,
            ),
            self.initial,
            tuple(self._changes),
            self._began or 0.0,
            self._ended,
            boot_time,
            notes,
        )

    def _receive_param(self, fields: dict[str, Any]) -> None:
        try:
            name = check_name(fields["Name"])
            value = _number(fields["Value"])
            time = fields["TimeUS"] / 1e6
        except (UsageError, KeyError, TypeError):
            self._refused += 1
            return
        self._ended = max(self._ended, time)
        if self._began is None:
            self._began = self._last = time
        known = self._values.get(name)
        default = fields.get("Default", math.nan)
        is_of_initial_run = not math.isnan(default) or time - self._last <= INITIAL_GAP_MAX
        if known is None and is_of_initial_run:
            self.initial[name] = WrittenParam(
                name, value, default=None if math.isnan(default) else _number(default)
            )
            self._last = time
        elif value != known:
            self._changes.append(LoggedChange(time, name, value))
        self._values[name] = value

    def _receive_version(self, fields: dict[str, Any]) -> None:
        numbers = [fields.get(name, 0) for name in ("Maj", "Min", "Pat", "FWT")]
        self._firmware = int.from_bytes(bytes(each & 0xFF for each in numbers))
        self._git_hash = f"{fields.get('GH', 0):08x}"

    def _receive_text(self, text: str) -> None:
        if (found := _FIRMWARE.match(text)) is not None:
            name, *numbers, commit = found.groups()
            self._vehicle_type = VEHICLE_TYPES.get(name, self._vehicle_type)
            if not self._firmware:
                self._firmware = int.from_bytes(bytes(min(int(each), 255) for each in (*numbers, 0)))
                self._git_hash = commit or ""
        elif (found := _HARDWARE_ID.search(text)) is not None:
            words = (bytes.fromhex(word)[::-1] for word in found.groups())
            self._uid = b"".join(words).ljust(UID_SIZE, b"\0").hex()


def _number(value: float) -> WireValue:
    """Return a float32 as the number that a person would write."""
    return int(value) if value.is_integer() else shortest_float(value)


def _is_id(value: WireValue) -> bool:
    return isinstance(value, int) and 0 < value < 256
