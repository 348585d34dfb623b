"""Parameter metadata of a simulated vehicle: the files of the component metadata protocol."""

from __future__ import annotations

import json
import lzma
import math
from functools import cache
from typing import Any, Final

from paramclient.model.px4_hash import crc32_px4
from paramclient.model.values import TYPES_BY_NAME, ParamType
from paramclient.sim.param_table import SimParam

__all__ = ["GENERAL_FILE", "METADATA_FILE", "metadata_files"]

GENERAL_FILE: Final = "etc/extras/component_general.json.xz"
"""Path of PX4's general metadata file (COMPONENT_METADATA.hpp)."""
METADATA_FILE: Final = "etc/extras/parameters.json.xz"
"""Path of PX4's parameter metadata file (PX4's build)."""


@cache
def metadata_files(rows: tuple[SimParam, ...]) -> dict[str, bytes]:
    """Return the two packed files of a table, by path. Only a few parameters have more than a type."""
    parameters = _packed({"version": 1, "parameters": [_described(row) for row in rows]})
    kinds = [{"type": 1, "uri": f"mftp://{METADATA_FILE}", "fileCrc": crc32_px4(parameters)}]
    return {
        GENERAL_FILE: _packed({"version": 1, "metadataTypes": kinds}),
        METADATA_FILE: parameters,
    }


def _packed(document: dict[str, Any]) -> bytes:
    return lzma.compress(json.dumps(document).encode(), preset=1)


def _described(row: SimParam) -> dict[str, Any]:
    value = row.value
    described: dict[str, Any] = {
        "name": row.name,
        "group": row.name.partition("_")[0],
        "category": "Standard",
        "shortDesc": f"{row.name} of the simulated vehicle",
    }
    if row.type in _TYPES:
        described["type"] = _TYPES[row.type]
    if isinstance(value, int | float) and math.isfinite(value):
        described["default"] = value
    if row.volatile:
        described["volatile"] = True
    return described | _KNOWN.get(row.name, {})


def _values(named: dict[int, str]) -> list[dict[str, Any]]:
    return [{"value": value, "description": name} for value, name in named.items()]


def _bits(*names: str) -> list[dict[str, Any]]:
    return [{"index": index, "description": name} for index, name in enumerate(names)]


def _rate_limit(axis: str) -> dict[str, Any]:
    return {
        "shortDesc": f"Limit of the {axis} rate",
        "longDesc": f"The highest {axis} rate that the attitude controller requests, except in acro mode.",
        "units": "deg/s",
        "min": 0,
        "max": 1800,
        "increment": 5,
        "decimalPlaces": 1,
    }


_TYPES: Final[dict[int, str]] = {
    kind: "Float" if kind is ParamType.REAL32 else kind.name.capitalize()
    for kind in TYPES_BY_NAME.values()
    if kind.size <= 4
}
_KNOWN: Final[dict[str, dict[str, Any]]] = {
    "COM_FLTMODE1": {
        "shortDesc": "Mode at the first position of the switch",
        "values": _values(
            {
                -1: "Unassigned",
                0: "Manual",
                1: "Altitude",
                2: "Position",
                3: "Mission",
                4: "Hold",
                5: "Return",
            }
        ),
    },
    "EKF2_GPS_CTRL": {
        "shortDesc": "What the estimator takes from satellites",
        "bitmask": _bits("Position", "Altitude", "Velocity", "Heading"),
        "min": 0,
        "max": 15,
    },
    "MAV_SYS_ID": {
        "shortDesc": "System id of the vehicle",
        "min": 1,
        "max": 250,
        "rebootRequired": True,
        "category": "System",
    },
    "MC_PITCHRATE_MAX": _rate_limit("pitch"),
    "MC_ROLLRATE_MAX": _rate_limit("roll"),
    "MC_YAWRATE_MAX": _rate_limit("yaw"),
    "MC_ROLL_P": {
        "shortDesc": "Gain from the error of the roll angle to the roll rate",
        "longDesc": "The rate per unit of error. Higher reacts quicker and swings sooner.",
        "units": "1/s",
        "min": 0,
        "max": 12,
        "increment": 0.1,
        "decimalPlaces": 2,
    },
    "NAV_RCL_ACT": {
        "shortDesc": "What to do when the remote control is lost",
        "values": _values({1: "Hold", 2: "Return", 3: "Land", 5: "Terminate", 6: "Disarm"}),
    },
    "RTL_RETURN_ALT": {
        "shortDesc": "Height of the way back",
        "units": "m",
        "min": 0,
        "increment": 0.5,
        "decimalPlaces": 1,
    },
}
