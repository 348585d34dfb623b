"""PX4's ULog files (.ulg): initial parameters, changes, defaults, and the vehicle that wrote them.

The format is documented in the PX4 guide, "ULog File Format"; pyulog parses it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from pyulog import ULog
from pyulog.exceptions import ULogException

from paramclient.errors import FileError
from paramclient.files.formats import LogFormat
from paramclient.logs.logged_params import OnboardLog, log_link
from paramclient.model.identity import Identity
from paramclient.model.paramset import WrittenParam
from paramclient.model.values import ParamType, is_portable_name
from paramclient.wire.messages import MAV_AUTOPILOT_PX4

ID_NAMES: Final = ("MAV_SYS_ID", "MAV_TYPE")
"""The parameters that contain the system id and the MAV_TYPE of the heartbeat."""
CURRENT_DEFAULTS: Final = 1
"""Defaults of the airframe that is set up, in pyulog's numbering of the default types."""
FIRMWARE_DEFAULTS: Final = 0
"""Defaults of the firmware, likewise."""
GIT_HASH_DIGITS: Final = 16
"""Digits of the commit in AUTOPILOT_VERSION, which is what an `Identity` contains."""
GPS_FIX_MIN: Final = 3
"""`fix_type` from which the time is valid: a 3D fix."""
GPS_TOPICS: Final = ("vehicle_gps_position", "sensor_gps")
"""Topics with the UTC time; the second in newer versions, if the first is not logged."""
CLOCK_TOPICS: Final = ("vehicle_attitude", "vehicle_status", "cpuload")
"""Topics that every flight has; vehicle_attitude is logged at 20 Hz or more. A change has no time of its own
in the file, and takes that of the last data before it. The other topics take as much memory as the file."""

_GUID: Final = re.compile(r"[0-9a-f]{36}")


def read_ulog(path: str) -> OnboardLog:
    """Read the parameters of a ULog file.

    Args:
        path: the file.

    Raises:
        FileError: the file cannot be read, or has no parameters.
    """
    try:
        with Path(path).open("rb") as file:  # ULog closes none of its own if it fails
            log = ULog(file, [*GPS_TOPICS, *CLOCK_TOPICS])
    except ULogException as error:
        raise FileError(f"cannot be read as a ULog file: {error}", source=path) from error
    params, changes = _valid(log.initial_parameters.items()), log.changed_parameters
    defaults = _defaults(log, params)
    initial = {name: _param(name, value, defaults) for name, value in params.items()}
    if not initial:
        raise FileError("the log has no parameters", source=path)
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
        link=log_link(path),
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
