"""Parameters that show or hide a group of other parameters, or bring one into use."""

from __future__ import annotations

from typing import Final

from paramclient.model.patterns import NameChoice

__all__ = ["ARDUPILOT_SWITCHES", "PX4_SWITCHES", "is_group_switch"]

PX4_SWITCHES: Final = ("*_EN", "*_ENABLE", "CA_ROTOR_COUNT", "CA_SV_CS_COUNT", "CAL_*_ID", "UAVCAN_ENABLE")
"""Patterns of parameters of PX4 that bring others into use: PX4 then lists them."""
ARDUPILOT_SWITCHES: Final = (
    *("*_ENABLE", "*_ENABLED", "*_TYPE", "*_MONITOR", "CAN_P?_DRIVER", "CAN_D?_PROTOCOL"),
    *("COMPASS_PMOT_EN", "RELAY?_FUNCTION"),
)
"""Patterns of parameters of ArduPilot that show a group of others."""

_CHOICES: Final = {"px4": NameChoice(PX4_SWITCHES), "ardupilot": NameChoice(ARDUPILOT_SWITCHES)}
_OF_BOTH: Final = NameChoice((*PX4_SWITCHES, *ARDUPILOT_SWITCHES))


def is_group_switch(name: str, autopilot: str) -> bool:
    """Return whether a change of the parameter may show or hide other parameters.

    Args:
        name: param_id.
        autopilot: "px4" or "ardupilot"; for any other one, the parameters of both count.
    """
    return _CHOICES.get(autopilot, _OF_BOTH).has(name)
