"""ImportedTable: the result of an import."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["ImportedTable"]


@dataclass(frozen=True, slots=True)
class ImportedTable:
    """The imported table of one component.

    Attributes:
        key: the key of the vehicle's tables in the cache.
        system, component: its address.
        autopilot: MAV_AUTOPILOT of its heartbeat, or None.
        params: the number of received parameters, plain and extended.
        complete: whether the plain table is complete; the extended one if there are no plain parameters.
        hash: the PX4 hash that confirms the table at the end of the log, or None.
        notes: parts that were skipped of files that a ground station read over MAVFTP, in sentences.
    """

    key: str
    system: int
    component: int
    autopilot: int | None
    params: int
    complete: bool
    hash: int | None
    notes: tuple[str, ...] = ()
