"""On-board logs: the parameters in ArduPilot's dataflash logs (.bin) and PX4's ULog files (.ulg).

ArduPilot documents its format in the "Log messages" pages; pymavlink's DFReader parses it. The messages read
here are PARM (name, value, from version 4.3 on also the default), VER and MSG (firmware, board, hardware id),
GPS (time). The PX4 guide documents ULog in "ULog File Format"; pyulog parses it.
"""

from __future__ import annotations

import io
import math
import os
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, Final

from paramclient.errors import FileError, UsageError
from paramclient.files.formats import AUTOPILOT
from paramclient.metadata.store import ARDUPILOT, OLD_NAMES
from paramclient.model.identity import Identity
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import ParamType, Value, check_name, is_portable_name, shortest_float
from paramclient.wire.messages import MAV_AUTOPILOT_ARDUPILOTMEGA, MAV_AUTOPILOT_PX4


class LogFormat(StrEnum):
    """Formats of on-board logs. None of them can be written."""

    DATAFLASH = "dataflash"
    """ArduPilot, `.bin`."""
    ULOG = "ulog"
    """PX4, `.ulg`."""


LOG_MAGICS: Final = {b"ULog\x01\x12\x35": LogFormat.ULOG, b"\xa3\x95": LogFormat.DATAFLASH}
"""The first bytes of a ULog file, and of each message of a dataflash log."""
GPS_FIX_MIN: Final = 3
"""Status of a GPS receiver from which its time is valid: a 3D fix."""


@dataclass(frozen=True, slots=True)
class OnboardLog:
    """The parameters of an on-board log.

    Attributes:
        source: the file's name, as given.
        file_format: the log format.
        identity: the vehicle, as far as the log describes it.
        initial: the parameters at the beginning of the log, by name.
        changes: the later values in the order of the log, each with its time in seconds since boot.
        began: when the initial parameters were recorded, in seconds since boot.
        ended: the last time that was read, in seconds since boot.
        boot_time: the Unix time of the boot in seconds, or None if the log has no time of a GPS receiver.
        notes: remarks for the user, in sentences: damaged parts.
    """

    source: str
    file_format: LogFormat
    identity: Identity
    initial: Mapping[str, WrittenParam]
    changes: tuple[tuple[float, WrittenParam], ...] = ()
    began: float = 0.0
    ended: float = 0.0
    boot_time: float | None = None
    notes: tuple[str, ...] = ()

    def at_start(self) -> ParamSet:
        """Return the parameters at the beginning of the log."""
        ids = AUTOPILOT, self.identity.system or None
        at = None if self.boot_time is None else self.boot_time + self.began
        return ParamSet(self.initial, *ids, self.identity, at, self.source)

    def at_end(self) -> ParamSet:
        """Return the parameters at the end of the log: the initial ones with all changes."""
        start = self.at_start()
        params = {**self.initial, **{each.name: each for _, each in self.changes}}
        at = None if self.boot_time is None else self.boot_time + self.ended
        return replace(start, params=params, at=at)


def is_onboard_log(path: str | os.PathLike[str]) -> bool:
    """Return whether a regular file begins as an on-board log. False if it cannot be read."""
    try:
        return _format_of(Path(path)) is not None
    except (OSError, ValueError):
        return False


def read_onboard_log(path: str | os.PathLike[str]) -> OnboardLog:
    """Read the parameters of an on-board log. Blocks: a log of 100 MB takes seconds.

    A dataflash log contains no types: integers are numbers without a type, as in a list of Mission Planner.

    Args:
        path: a dataflash log (`.bin`) or a ULog file (`.ulg`); the content decides.

    Raises:
        FileError: the file cannot be read, is neither, is damaged, or has no parameters.
        UsageError: a ULog file, and pyulog is not installed.
    """
    source = os.fspath(path)
    try:
        file_format = _format_of(Path(source))
        if file_format is None:
            raise FileError("neither a dataflash log nor a ULog file", source=source)
        # Both libraries print remarks on damaged parts, which would mix with the output of a program.
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            log = _read_ulog(source) if file_format is LogFormat.ULOG else _read_dataflash(source)
    except UsageError:
        raise
    except ImportError:
        raise UsageError(f"{source}: ULog files need pyulog: pip install 'paramclient[logs]'") from None
    except OSError as error:
        raise FileError(f"cannot be read: {error.strerror}", source=source) from error
    except Exception as error:  # the libraries do not state what they raise for damaged files
        raise FileError(f"the log is damaged: {error}", source=source) from error
    if not log.initial:
        raise FileError("the log has no parameters", source=source)
    return log


def _format_of(path: Path) -> LogFormat | None:
    """Return the format of a log; None if it is not a regular file of a known format."""
    if path.exists() and not path.is_file():
        return None
    with path.open("rb") as file:
        begin = file.read(max(map(len, LOG_MAGICS)))
    return next((each for magic, each in LOG_MAGICS.items() if begin.startswith(magic)), None)


def printable_path(path: str | os.PathLike[str]) -> str:
    """Return the absolute path of a file as text that a cache can store: its name may not be UTF-8."""
    return os.fsencode(os.path.realpath(path)).decode(errors="backslashreplace")


# Dataflash

VEHICLE_TYPES: Final = {name: types[0] for name, types in ARDUPILOT.values()}
"""MAV_TYPE by the name of the firmware in MSG. A copter with other than four rotors reports another type in
its heartbeat."""
SYSTEM_ID_NAMES: Final = ("MAV_SYSID", "SYSID_THISMAV")
"""The parameters that contain the system id: from version 4.7 on, and before."""
GPS_EPOCH: Final = 315_964_800
"""Unix time of 1980-01-06."""
GPS_LEAP_SECONDS: Final = 18
"""Seconds between GPS time and UTC, since 2017."""
UID_SIZE: Final = 18
"""Bytes of AUTOPILOT_VERSION.uid2; the hardware id of ArduPilot's boards has 12, zeros follow."""
INITIAL_GAP_MAX: Final = 2.0
"""Seconds without a PARM message after which further ones are changes: the logger writes the initial ones
in one run, a few in each of its loops."""

_FIRMWARE: Final = re.compile(r"^(\w+) V(\d+)\.(\d+)\.(\d+)[^(]*(?:\(([0-9a-f]{7,8})\))?")
"""MSG: `ArduCopter V4.6.0-dev (3fc7011a)`."""
_HARDWARE_ID: Final = re.compile(r" ([0-9A-F]{8}) ([0-9A-F]{8}) ([0-9A-F]{8})$")
"""MSG: `CubeOrange 00380043 31385115 32383033`, the board's name and three words of its hardware id."""


def _read_dataflash(path: str) -> OnboardLog:
    found, boot_time = _messages(path)
    initial: dict[str, WrittenParam] = {}
    latest: dict[str, WrittenParam] = {}
    changes: list[tuple[float, WrittenParam]] = []
    times: list[float] = []
    last_initial = math.inf
    for fields in found["PARM"]:
        try:
            name, value, time = check_name(fields["Name"]), _number(fields["Value"]), fields["TimeUS"] / 1e6
        except (UsageError, KeyError, TypeError):
            continue
        times.append(time)
        default = fields.get("Default", math.nan)
        default = None if math.isnan(default) else _number(default)
        known = latest.get(name)
        if known is None and (default is not None or time - last_initial <= INITIAL_GAP_MAX):
            latest[name] = initial[name] = WrittenParam(name, value, None, default)
            last_initial = time
        elif known is None or value != known.value:
            latest[name] = WrittenParam(name, value, None, None if known is None else known.default)
            changes.append((time, latest[name]))
    damaged = len(found["PARM"]) - len(times)
    ids = (initial[name].value for name in SYSTEM_ID_NAMES if name in initial)
    return OnboardLog(
        path,
        LogFormat.DATAFLASH,
        Identity(
            next((each for each in ids if isinstance(each, int) and 0 < each < 256), 0),
            f"log:{printable_path(path)}",
            autopilot=MAV_AUTOPILOT_ARDUPILOTMEGA,
            **_described(found["MSG"], found["VER"]),
        ),
        initial,
        tuple(changes),
        next(iter(times), 0.0),
        max(times, default=0.0),
        boot_time,
        (f"{damaged} PARM messages are damaged and left out",) if damaged else (),
    )


def _messages(path: str) -> tuple[Mapping[str, list[dict[str, Any]]], float | None]:
    """Return the messages of a log by their name, and the Unix time of the boot by the first GPS fix."""
    from pymavlink.DFReader import DFReader_binary  # imported here: takes long to load

    found = defaultdict[str, list[dict[str, Any]]](list)
    boot_time = None
    reader: Any = object.__new__(DFReader_binary)
    try:
        reader.__init__(path, zero_time_base=True)
        while (message := reader.recv_match(type={"PARM", "GPS", "VER", "MSG"}, strict=True)) is not None:
            kind, fields = message.get_type(), message.to_dict()
            if kind != "GPS":
                found[kind].append(fields)
            elif boot_time is None:
                boot_time = _boot_time_by_gps(fields)
    finally:
        with suppress(AttributeError):  # the file could not be opened
            reader.filehandle.close()  # a reader that cannot parse its file leaves it open
    return found, boot_time


def _described(texts: Iterable[Mapping[str, Any]], versions: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the fields of the identity. VER counts before MSG."""
    fields: dict[str, Any] = {}
    for text in (str(each.get("Message", "")) for each in texts):
        if (found := _FIRMWARE.match(text)) is not None:
            name, *numbers, commit = found.groups()
            fields["firmware"] = int.from_bytes(bytes(min(int(each), 255) for each in (*numbers, 0)))
            fields["git_hash"] = commit or ""
            if (kind := VEHICLE_TYPES.get(OLD_NAMES.get(name, name))) is not None:
                fields["vehicle_type"] = kind
        elif (found := _HARDWARE_ID.search(text)) is not None:
            words = (bytes.fromhex(word)[::-1] for word in found.groups())
            fields["uid"] = b"".join(words).ljust(UID_SIZE, b"\0").hex()
    for each in versions:
        parts = bytes(each.get(name, 0) & 0xFF for name in ("Maj", "Min", "Pat", "FWT"))
        fields |= {"firmware": int.from_bytes(parts), "git_hash": f"{each.get('GH', 0):08x}"}
    return fields


def _boot_time_by_gps(fields: dict[str, Any]) -> float | None:
    """Return the Unix time of the boot, by one GPS message; None without a fix."""
    week, time, micros = (fields.get(name) for name in ("GWk", "GMS", "TimeUS"))
    if not week or time is None or micros is None or fields.get("Status", 0) < GPS_FIX_MIN:
        return None
    return float(GPS_EPOCH + week * 604800 + time / 1e3 - GPS_LEAP_SECONDS - micros / 1e6)


def _number(value: float) -> Value:
    """Return a float32 as the number that a person would write."""
    return int(value) if value.is_integer() else shortest_float(value)


# ULog

ID_NAMES: Final = ("MAV_SYS_ID", "MAV_TYPE")
"""The parameters that contain the system id and the MAV_TYPE of the heartbeat."""
CURRENT_DEFAULTS: Final = 1
"""Defaults of the airframe that is set up, in pyulog's numbering of the default types."""
FIRMWARE_DEFAULTS: Final = 0
"""Defaults of the firmware, likewise."""
GIT_HASH_DIGITS: Final = 16
"""Digits of the commit in AUTOPILOT_VERSION, which is what an `Identity` contains."""
GPS_TOPICS: Final = ("vehicle_gps_position", "sensor_gps")
"""Topics with the UTC time; the second in newer versions, if the first is not logged."""
CLOCK_TOPICS: Final = ("vehicle_attitude", "vehicle_status", "cpuload")
"""Topics that every flight has; vehicle_attitude is logged at 20 Hz or more. A change has no time of its own
in the file, and takes that of the last data before it. The other topics take as much memory as the file."""

_GUID: Final = re.compile(r"[0-9a-f]{36}")


def _read_ulog(path: str) -> OnboardLog:
    from pyulog import ULog  # imported here: needs the extra, and takes long to load

    with Path(path).open("rb") as file:  # ULog closes none of its own if it fails
        log = ULog(file, [*GPS_TOPICS, *CLOCK_TOPICS])
    params, changes = _valid(log.initial_parameters.items()), log.changed_parameters
    defaults = _defaults(log, params)
    initial = {name: _param(name, value, defaults) for name, value in params.items()}
    valid = [change for change in changes if _valid([change[1:]])]
    damaged = len(log.initial_parameters) - len(params) + len(changes) - len(valid)
    notes = []
    if log.file_corruption:
        notes.append("the log is damaged; values and changes may be missing")
    if damaged:
        notes.append(f"{damaged} parameters are damaged and left out")
    return OnboardLog(
        path,
        LogFormat.ULOG,
        _identity(log.msg_info_dict, initial, path),
        initial,
        tuple((micros / 1e6, _param(name, value, defaults)) for micros, name, value in valid),
        log.start_timestamp / 1e6,
        log.last_timestamp / 1e6,
        _boot_time(log),
        tuple(notes),
    )


def _valid(params: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """Return the parameters that are not damaged. PX4 has int32 and float parameters only."""
    return {
        name: value
        for name, value in params
        if is_portable_name(name)
        and (isinstance(value, float) or (isinstance(value, int) and -(1 << 31) <= value < 1 << 31))
    }


def _defaults(log: Any, params: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the defaults of the parameters.

    PX4 logs a default only where the value differs from it (PX4 guide); for the others, the value is the
    default. A log without that flag has no defaults.
    """
    if not log.has_default_parameters:
        return {}
    firmware, current = map(log.get_default_parameters, (FIRMWARE_DEFAULTS, CURRENT_DEFAULTS))
    return {**params, **firmware, **current}


def _param(name: str, value: Any, defaults: Mapping[str, Any]) -> WrittenParam:
    kind = ParamType.REAL32 if isinstance(value, float) else ParamType.INT32
    return WrittenParam(name, value, kind, defaults.get(name))


def _identity(info: Mapping[str, Any], params: Mapping[str, WrittenParam], path: str) -> Identity:
    system, kind = (_integer(params[name].value) if name in params else 0 for name in ID_NAMES)
    guid = _text(info, "sys_uuid").lower()
    return Identity(
        system=system if 0 < system < 256 else 0,
        link=f"log:{printable_path(path)}",
        uid=guid if _GUID.fullmatch(guid) else None,
        autopilot=MAV_AUTOPILOT_PX4,
        vehicle_type=kind,
        firmware=_integer(info.get("ver_sw_release")),
        git_hash=_text(info, "ver_sw")[:GIT_HASH_DIGITS],
    )


def _integer(value: object) -> int:
    return value if isinstance(value, int) else 0


def _text(info: Mapping[str, Any], name: str) -> str:
    value = info.get(name, "")
    return value.rstrip("\0") if isinstance(value, str) else ""


def _boot_time(log: Any) -> float | None:
    """Return the Unix time of the boot, by the first fix of a GPS receiver; None without one."""
    for dataset in log.data_list:
        fields = dataset.data
        if dataset.name in GPS_TOPICS and {"time_utc_usec", "fix_type"} <= fields.keys():
            times = zip(fields["timestamp"], fields["time_utc_usec"], fields["fix_type"], strict=True)
            for micros, utc, fix in times:
                if utc > 0 and fix >= GPS_FIX_MIN:
                    return float((int(utc) - int(micros)) / 1e6)
    return None
