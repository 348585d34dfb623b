"""Kinds of components: their names for users, and which usually have extended parameters."""

from __future__ import annotations

from typing import Final

from paramclient.wire.frames import enum_word
from paramclient.wire.messages import (
    MAV_AUTOPILOT_ARDUPILOTMEGA,
    MAV_AUTOPILOT_GENERIC,
    MAV_AUTOPILOT_INVALID,
    MAV_AUTOPILOT_PX4,
    MAV_TYPE_GCS,
    MAV_TYPE_GENERIC,
)

__all__ = ["expects_extended", "kind_in_words"]

_AUTOPILOTS: Final = {MAV_AUTOPILOT_ARDUPILOTMEGA: "ArduPilot", MAV_AUTOPILOT_PX4: "PX4"}
_VEHICLES: Final = {1: "plane", MAV_TYPE_GCS: "ground station", 10: "rover", 11: "boat"}
"""Names of MAV_TYPE for users, where they differ from those of the enumeration."""
_EXTENDED_TYPES: Final = frozenset({26, 30, 42, 44, 48})
"""MAV_TYPE of payloads: GIMBAL, CAMERA, WINCH, ILLUMINATOR, GRIPPER (MAVLink common message set)."""
_EXTENDED_COMPONENTS: Final = frozenset({*range(100, 106), 154, 159, 169, *range(171, 176), 243})
"""MAV_COMP_ID of payloads: CAMERA to CAMERA6, GIMBAL, QX1_GIMBAL, WINCH, GIMBAL2 to GIMBAL6, ILLUMINATOR."""


def kind_in_words(autopilot: int | None, kind: int | None) -> str:
    """Return autopilot and vehicle type as text, `PX4 quadrotor`; "" where neither is known or says
    anything.

    Args:
        autopilot: MAV_AUTOPILOT, or None.
        kind: MAV_TYPE, or None.
    """
    words = []
    if autopilot not in (None, MAV_AUTOPILOT_GENERIC, MAV_AUTOPILOT_INVALID):
        words.append(_AUTOPILOTS.get(autopilot) or _name_or_number("MAV_AUTOPILOT", "autopilot", autopilot))
    if kind is not None and (kind != MAV_TYPE_GENERIC or not words):
        words.append(_VEHICLES.get(kind) or _name_or_number("MAV_TYPE", "type", kind))
    return " ".join(words)


def expects_extended(vehicle_type: int | None, component: int) -> bool:
    """Return whether a component is of a kind that usually has extended parameters.

    Args:
        vehicle_type: MAV_TYPE of its heartbeat, or None before the first one.
        component: its component id.
    """
    return vehicle_type in _EXTENDED_TYPES or component in _EXTENDED_COMPONENTS


def _name_or_number(enum: str, what: str, number: int) -> str:
    """Return the name of a number, or the number with the kind of number."""
    word = enum_word(enum, number)
    return f"{what} {word}" if word.isdecimal() else word
