"""Changes that are too small for PX4 to save."""

from __future__ import annotations

import math
from typing import Final

from paramclient.model.values import Param, ParamType, format_value

__all__ = ["note_on_small_change"]

CHANGE_MIN: Final = 2.0**-23
"""FLT_EPSILON, about 1.19e-07: PX4 treats two floats that differ by this or less as equal
(parameters.cpp)."""


def note_on_small_change(before: Param, after: Param) -> str:
    """Return a note on a small change of a float on PX4; "" where it is saved as any other.

    Args:
        before: the parameter before it was set.
        after: the parameter as the vehicle has acknowledged it.
    """
    value, old, default = after.value, before.value, after.default
    if after.type != ParamType.REAL32 or before.type != after.type or before.same_value(after):
        return ""
    if not isinstance(value, float) or not isinstance(old, float) or not math.isfinite(value - old):
        return ""
    about = f"{CHANGE_MIN:.3g}"
    if isinstance(default, float) and 0.0 < abs(value - default) <= CHANGE_MIN:
        again = format_value(default, ParamType.REAL32)
        return f"PX4 saves no value within {about} of the default: with its next start it is {again} again"
    if abs(value - old) <= CHANGE_MIN:
        again = format_value(old, ParamType.REAL32)
        return f"PX4 takes a change of at most {about} for none: its next start may bring {again} back"
    return ""
