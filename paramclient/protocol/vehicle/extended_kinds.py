"""Kinds of components that usually speak the extended parameter protocol."""

from __future__ import annotations

from typing import Final

__all__ = ["expects_extended"]

EXTENDED_TYPES: Final = frozenset({26, 30, 42, 44, 48})
"""MAV_TYPE of payloads: GIMBAL, CAMERA, WINCH, ILLUMINATOR, GRIPPER (MAVLink common message set)."""
EXTENDED_COMPONENTS: Final = frozenset({*range(100, 106), 154, 159, 169, *range(171, 176), 243})
"""MAV_COMP_ID of payloads: CAMERA to CAMERA6, GIMBAL, QX1_GIMBAL, WINCH, GIMBAL2 to GIMBAL6, ILLUMINATOR."""


def expects_extended(vehicle_type: int | None, component: int) -> bool:
    """Return whether a component is of a kind that usually has extended parameters.

    Args:
        vehicle_type: MAV_TYPE of its heartbeat, or None before the first one.
        component: its component id.
    """
    return vehicle_type in EXTENDED_TYPES or component in EXTENDED_COMPONENTS
