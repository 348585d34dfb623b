"""Contents of logs: OnboardLog, the parameters of one flight; ImportedTable, the result of an import."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace

from paramclient.files.formats import AUTOPILOT, LogFormat
from paramclient.model.identity import Identity
from paramclient.model.paramset import ParamSet, WrittenParam


@dataclass(frozen=True, slots=True)
class OnboardLog:
    """The parameters of an on-board log.

    Attributes:
        source: the file's name, as given.
        file_format: the log format.
        identity: the vehicle, as far as the log describes it.
        initial: the parameters at the beginning of the log, by name.
        changes: the later values in the order of the log, each with its time in seconds since boot.
        began: when the initial parameters were recorded, in seconds since boot.
        ended: the last time that was read, in seconds since boot.
        boot_time: the Unix time of the boot in seconds, or None if the log has no time of a GPS receiver.
        notes: remarks for the user, in sentences: damaged parts.
    """

    source: str
    file_format: LogFormat
    identity: Identity
    initial: Mapping[str, WrittenParam]
    changes: tuple[tuple[float, WrittenParam], ...] = ()
    began: float = 0.0
    ended: float = 0.0
    boot_time: float | None = None
    notes: tuple[str, ...] = ()

    def at_start(self) -> ParamSet:
        """Return the parameters at the beginning of the log."""
        ids = AUTOPILOT, self.identity.system or None
        at = None if self.boot_time is None else self.boot_time + self.began
        return ParamSet(self.initial, *ids, self.identity, at, self.source)

    def at_end(self) -> ParamSet:
        """Return the parameters at the end of the log: the initial ones with all changes."""
        start = self.at_start()
        params = {**self.initial, **{each.name: each for _, each in self.changes}}
        at = None if self.boot_time is None else self.boot_time + self.ended
        return replace(start, params=params, at=at)


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
        notes: remarks for the user, in sentences: parts that were skipped, types that are unknown.
    """

    key: str
    system: int
    component: int
    autopilot: int | None
    params: int
    complete: bool = False
    hash: int | None = None
    notes: tuple[str, ...] = ()


def log_link(path: str) -> str:
    """Return the link name of a log, which is part of the identity of a vehicle without a hardware id."""
    return f"log:{os.path.realpath(path)}"
