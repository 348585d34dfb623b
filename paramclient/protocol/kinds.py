"""Names of autopilots and vehicle types for users."""

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

__all__ = ["kind_in_words"]

_AUTOPILOTS: Final = {MAV_AUTOPILOT_ARDUPILOTMEGA: "ArduPilot", MAV_AUTOPILOT_PX4: "PX4"}
_VEHICLES: Final = {1: "plane", MAV_TYPE_GCS: "ground station", 10: "rover", 11: "boat"}
"""Names of MAV_TYPE for users, where they differ from those of the enumeration."""


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


def _name_or_number(enum: str, what: str, number: int) -> str:
    """Return the name of a number, or the number with the kind of number."""
    word = enum_word(enum, number)
    return f"{what} {word}" if word.isdecimal() else word
