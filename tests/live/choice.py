"""Which parameters the suite may change: harmless ones, by autopilot, among those it has.

Harmless means that another value for a few seconds, on a disarmed vehicle, moves nothing and ends nothing:
a serial number that the user defines, limits of radio channels that nothing uses, options of features that
are off. No parameter of control, failsafe, sensors, identity or link is in these lists.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from paramclient.model.values import Param, ParamType, bits_of, from_bits

MANY: Final = 30
"""Parameters that the check of many sets changes, where the vehicle has as many harmless ones."""
FIRST_SPARE_CHANNEL: Final = 9
"""The first radio channel that is taken for the spare ones, if nothing is mapped to it."""

HARMLESS: Final[Mapping[str, Mapping[ParamType, tuple[str, ...]]]] = {
    "ardupilot": {
        ParamType.INT32: ("BRD_SERIAL_NUM", "BATT_SERIAL_NUM"),
        ParamType.REAL32: ("RALLY_LIMIT_KM", "TERRAIN_MARGIN", "TERRAIN_OFS_MAX"),
        ParamType.INT16: ("LOG_FILE_MB_FREE", "LOG_MAX_FILES"),
        ParamType.INT8: ("NTF_LED_BRIGHT", "LOG_MAV_BUFSIZE"),
    },
    "px4": {
        ParamType.INT32: ("SDLOG_DIRS_MAX", "MIS_LND_ABRT_ALT", "RTL_TIME_MARGIN"),
        ParamType.REAL32: ("RTL_TIME_FACTOR", "PLD_SRCH_TOUT", "FLW_TGT_DST"),
    },
}
"""By autopilot and type, in the order of preference. Spare radio channels arrive after them."""

READ_ONLY: Final = ("BARO1_DEVID", "BARO2_DEVID", "BARO1_GND_PRESS", "FORMAT_VERSION")
"""Parameters that some versions of ArduPilot refuse to change, the least harmful first."""
GROUPS: Final = ("GRIP_ENABLE", "FOLL_ENABLE", "BTN_ENABLE", "FENCE_ENABLE", "SCR_ENABLE", "EK2_ENABLE")
"""Switches of ArduPilot that show a group of parameters, the least intrusive first."""

_CHANNEL = re.compile(r"RC(\d+)_(DZ|TRIM|MIN|MAX)")


@dataclass(frozen=True)
class Choice:
    """What the suite will change on one vehicle.

    Attributes:
        by_type: one parameter of each type that has a harmless one.
        many: the parameters for the check of many sets.
        read_only: a parameter that the vehicle is likely to refuse to change, or None.
        groups: switches of groups that are off, in the order in which they are tried.
    """

    by_type: Mapping[ParamType, str]
    many: tuple[str, ...]
    read_only: str | None
    groups: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Every name, each once."""
        only = () if self.read_only is None else (self.read_only,)
        return tuple(dict.fromkeys((*self.by_type.values(), *self.many, *only, *self.groups)))


def choose(kind: str, table: Mapping[str, Param]) -> Choice:
    """Choose among the parameters of a table.

    Args:
        kind: "px4" or "ardupilot"; for any other autopilot nothing is known to be harmless.
        table: the vehicle's parameters.
    """
    if kind not in HARMLESS:
        return Choice({}, (), None, ())
    channels = list(_spare_channels(kind, table))
    by_type: dict[ParamType, str] = {}
    for number, names in HARMLESS[kind].items():
        found = next((name for name in (*names, *channels) if _has(table, name, number)), None)
        if found is not None:
            by_type[number] = found
    many = [name for name in channels if name not in by_type.values()]
    for names in HARMLESS[kind].values():
        many += [name for name in names if name in table and name not in by_type.values()]
    is_ardupilot = kind == "ardupilot"
    return Choice(
        by_type,
        tuple(many[:MANY]),
        next((name for name in READ_ONLY if is_ardupilot and name in table), None),
        tuple(name for name in GROUPS if is_ardupilot and name in table and not table[name].value),
    )


def another_value(param: Param) -> int | float:
    """Return a harmless value near the present one, as the type holds it."""
    value = param.value
    assert isinstance(value, int | float)
    assert not param.is_raw
    is_upper_bound = param.name.endswith(("_MAX", "_BRIGHT", "_BUFSIZE")) and value >= 1
    other = from_bits(bits_of(value - 1 if is_upper_bound else value + 1, param.type), param.type)
    assert isinstance(other, int | float)
    return other


def _has(table: Mapping[str, Param], name: str, number: ParamType) -> bool:
    return name in table and table[name].type == number and not table[name].is_raw


def _spare_channels(kind: str, table: Mapping[str, Param]) -> Iterator[str]:
    """Give DZ, TRIM, MIN and MAX of the radio channels that nothing uses, the last channel first."""
    mapped = set(_mapped_channels(kind, table))
    channels = {int(found[1]) for name in table if (found := _CHANNEL.fullmatch(name))}
    for channel in sorted(channels, reverse=True):
        option = table.get(f"RC{channel}_OPTION")
        is_used = channel in mapped or (option is not None and option.value != 0)
        if channel >= FIRST_SPARE_CHANNEL and not is_used:
            for what in ("DZ", "TRIM", "MIN", "MAX"):
                if (name := f"RC{channel}_{what}") in table and not table[name].is_raw:
                    yield name


def _mapped_channels(kind: str, table: Mapping[str, Param]) -> Iterable[int]:
    prefix = "RCMAP_" if kind == "ardupilot" else "RC_MAP_"
    named = {"FLTMODE_CH", "MODE_CH"} & table.keys()
    for name, param in table.items():
        if (name.startswith(prefix) or name in named) and isinstance(param.value, int):
            yield param.value
