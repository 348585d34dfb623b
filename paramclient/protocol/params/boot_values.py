"""Values that a vehicle measures at each boot: read again after its measurements."""

from __future__ import annotations

import math
import re
from collections import deque
from functools import partial
from typing import Final

from paramclient.protocol.params.reads import Read, Reads
from paramclient.protocol.params.sync import Sync
from paramclient.protocol.params.table import Table
from paramclient.protocol.requests.context import Context
from paramclient.protocol.requests.machine import Machine

__all__ = ["BootValues"]

MEASURING_TIME: Final = 3.0
"""Seconds after a boot is detected, and after the vehicle's main loop runs, until its measurements are done.
ArduPilot 4.6-dev (SITL) has measured gyroscopes and barometers 2.7 s after it went off, at about the time of
its first clock message; Rover shows the group GPS1_* and loads the defaults of RC*_DZ only then
(measured)."""
MEASURING_UPTIME_MAX: Final = 5.0
"""Seconds of uptime up to which a newly found vehicle may still be measuring."""
BOOT_READS_MAX: Final = 5
"""Reads in flight: one batch of ArduPilot."""
FETCH_CHECK_INTERVAL: Final = 0.1
"""Seconds until the next look at whether a fetch or a set-up has ended."""

_MEASURED = re.compile(
    r"INS\d?_(ACC\d?_ID|GYR\d?_ID|ACC\d?_CALTEMP|GYR\d?_CALTEMP|GYR\d?OFFS_[XYZ]|GYROFFS_[XYZ])"
    r"|BARO\d?_(GND_PRESS|DEVID)|GND_ABS_PRESS\d?|ARSPD\d?_(OFFSET|DEVID)"
    r"|COMPASS_DEV_ID\d?|COMPASS_DEC|STAT_BOOTCNT|GPS\d?_TYPE|RC\d+_DZ"
)
"""ArduPilot's parameters that differed between 1.3 s and 9 s after a boot (measured on three vehicles, first
and later boots), and the corresponding ones of other sensors."""


class BootValues(Machine):
    """Reads again what a vehicle without a hash measures at each boot; see `MEASURING_TIME`.

    If the file of the whole table is fast, it is fetched instead. Neither is done during a set-up, which
    reads the table itself, nor where the table was fetched since the measurements. A vehicle with a hash
    needs neither: its hash shows the changes.

    Args:
        context, reads, table, sync: the component's.
    """

    def __init__(
        self,
        context: Context,
        reads: Reads,
        table: Table,
        sync: Sync,
    ) -> None:
        self._context = context
        self._reads = reads
        self._table = table
        self._sync = sync
        self._read_at = math.inf
        self._measured_at = math.inf  # when the measurements are done
        self._has_clock = False  # whether its clock was received since its boot, or since it was found
        self._waiting: deque[str] = deque()
        self._in_flight = 0

    def restarted(self, now: float, *, by_clock: bool) -> None:
        """Process a reboot of the vehicle; `by_clock` says that its clock has shown it."""
        self._measured_at = self._read_at = now + MEASURING_TIME
        self._has_clock = by_clock

    def receive_clock(self, uptime: float, now: float) -> None:
        """Process a clock message, which the vehicle sends once its main loop runs.

        Args:
            uptime: seconds since boot.
            now: the time.
        """
        is_first = not self._has_clock
        self._has_clock = True
        if is_first and (self._read_at < math.inf or uptime <= MEASURING_UPTIME_MAX):
            self._measured_at = self._read_at = now + MEASURING_TIME

    def tick(self, now: float) -> None:
        """Read the values that are due."""
        if self._read_at > now:
            return
        if self._context.is_fetching or self._sync.holds:
            self._read_at = now + FETCH_CHECK_INTERVAL
            return
        self._read_at = math.inf
        if self._sync.is_known_since(self._measured_at):
            return
        if self._sync.wants_boot_values and not self._sync.fetch_quick_file(now):
            self._waiting = deque(name for name in self._table.params if _MEASURED.fullmatch(name))
            self._ask(now)

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity."""
        return self._read_at

    def lose(self, now: float) -> None:
        """Read nothing any more."""
        self.stop()

    def fail_all(self, error: Exception, now: float) -> None:
        """Read nothing any more."""
        self.stop()

    def stop(self) -> None:
        """Read nothing any more."""
        self._read_at = math.inf
        self._waiting.clear()

    def _ask(self, now: float) -> None:
        while self._waiting and self._in_flight < BOOT_READS_MAX:
            self._in_flight += 1
            read = self._reads.ask(self._waiting.popleft(), now, urgent=False)
            read.on_done.append(partial(self._read_ended, read))

    def _read_ended(self, read: Read) -> None:
        self._in_flight -= 1
        if read.result is None:
            self._waiting.clear()  # the read, or the link, is lost: the next boot or check brings the values
        self._ask(read.ended_at)
