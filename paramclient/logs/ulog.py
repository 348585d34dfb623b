"""PX4's ULog files (.ulg): initial parameters, changes, defaults, and the vehicle that wrote them.

The format is documented in the PX4 guide, "ULog File Format"; pyulog parses it.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from pyulog import ULog
from pyulog.exceptions import ULogException

from paramclient.errors import FileError, UsageError
from paramclient.files.formats import LogFormat
from paramclient.logs.logged_params import LoggedChange, OnboardLog, log_link
from paramclient.model.identity import Identity
from paramclient.model.paramset import WrittenParam
from paramclient.model.values import ParamType, check_name
from paramclient.wire.messages import MAV_AUTOPILOT_PX4

__all__ = ["read_ulog"]

SYSTEM_ID_NAME: Final = "MAV_SYS_ID"
"""The parameter that contains the system id."""
VEHICLE_TYPE_NAME: Final = "MAV_TYPE"
"""The parameter that contains the MAV_TYPE of the heartbeat."""
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
FULLY_READ_SIZE_MAX: Final = 256 << 20
"""Bytes up to which all topics are read, which takes as much memory. A change has no time of its own in the
file, and takes that of the last data before it; of a larger file only `CLOCK_TOPICS` are read for that."""
CLOCK_TOPICS: Final = ("vehicle_attitude", "vehicle_status", "cpuload")
"""Topics that every flight has; vehicle_attitude is logged at 20 Hz or more."""

_GUID: Final = re.compile(r"[0-9a-f]{36}")


def read_ulog(path: str) -> OnboardLog:
    """Read the parameters of a ULog file.

    Args:
        path: the file.

    Raises:
        FileError: the file cannot be read, or has no parameters.
    """
    try:
        with Path(path).open("rb") as file:
            is_small = os.fstat(file.fileno()).st_size <= FULLY_READ_SIZE_MAX
            log = ULog(file, None if is_small else [*GPS_TOPICS, *CLOCK_TOPICS])
    except ULogException as error:
        raise FileError(f"cannot be read as a ULog file: {error}", source=path) from error
    initial, refused = _initial(log)
    if not initial:
        raise FileError("the log has no parameters", source=path)
    changes = []
    for micros, name, value in log.changed_parameters:
        if _type_of(value) is None or not _is_name(name):
            refused += 1
        else:
            changes.append(LoggedChange(micros / 1e6, name, value))
    notes = []
    if log.file_corruption:
        notes.append("the log is damaged; values and changes may be missing")
    if refused:
        notes.append(f"{refused} parameters are damaged and left out")
    return OnboardLog(
        path,
        LogFormat.ULOG,
        _identity(log.msg_info_dict, initial, path),
        initial,
        tuple(changes),
        log.start_timestamp / 1e6,
        log.last_timestamp / 1e6,
        _boot_time(log),
        tuple(notes),
    )


def _initial(log: Any) -> tuple[dict[str, WrittenParam], int]:
    """Return the initial parameters with their defaults, and the number of damaged ones.

    PX4 logs a default only where the value differs from it (PX4 guide); for the others, the value is the
    default. A log without that flag has no defaults.
    """
    defaults = {
        **log.get_default_parameters(FIRMWARE_DEFAULTS),
        **log.get_default_parameters(CURRENT_DEFAULTS),
    }
    has_defaults = bool(log.has_default_parameters)
    params = {}
    refused = 0
    for name, value in log.initial_parameters.items():
        number = _type_of(value)
        if number is None or not _is_name(name):
            refused += 1
            continue
        default = defaults.get(name, value) if has_defaults else None
        params[name] = WrittenParam(name, value, number, default)
    return params, refused


def _type_of(value: object) -> ParamType | None:
    """Return the type of a value: PX4 has int32 and float parameters only. None for anything else."""
    if isinstance(value, float):
        return ParamType.REAL32
    is_int32 = isinstance(value, int) and -(1 << 31) <= value < 1 << 31
    return ParamType.INT32 if is_int32 else None


def _is_name(name: str) -> bool:
    try:
        check_name(name)
    except UsageError:
        return False
    return True


def _identity(info: Mapping[str, Any], params: Mapping[str, WrittenParam], path: str) -> Identity:
    system = _integer(params, SYSTEM_ID_NAME)
    guid = _text(info, "sys_uuid").lower()
    return Identity(
        system=system if 0 < system < 256 else 0,
        link=log_link(path),
        uid=guid if _GUID.fullmatch(guid) else None,
        autopilot=MAV_AUTOPILOT_PX4,
        vehicle_type=_integer(params, VEHICLE_TYPE_NAME),
        firmware=_number(info, "ver_sw_release"),
        git_hash=_text(info, "ver_sw")[:GIT_HASH_DIGITS],
    )


def _integer(params: Mapping[str, WrittenParam], name: str) -> int:
    param = params.get(name)
    return param.value if param is not None and isinstance(param.value, int) else 0


def _text(info: Mapping[str, Any], name: str) -> str:
    value = info.get(name, "")
    return value.rstrip("\0") if isinstance(value, str) else ""


def _number(info: Mapping[str, Any], name: str) -> int:
    value = info.get(name, 0)
    return value if isinstance(value, int) else 0


def _boot_time(log: Any) -> float | None:
    """Return the Unix time of the boot, by the first fix of a GPS receiver; None without one."""
    for topic in GPS_TOPICS:
        for dataset in log.data_list:
            fields = dataset.data
            if dataset.name != topic or not {"timestamp", "time_utc_usec", "fix_type"} <= fields.keys():
                continue
            for micros, utc, fix in zip(
                fields["timestamp"], fields["time_utc_usec"], fields["fix_type"], strict=True
            ):
                if utc > 0 and fix >= GPS_FIX_MIN:
                    return float((int(utc) - int(micros)) / 1e6)
    return None
