"""How long a component's list would take, by what a few single reads show of the link."""

from __future__ import annotations

import math
from functools import partial
from typing import Final

from paramclient.protocol.params.reads import Read, Reads
from paramclient.protocol.requests.operation import Operation

__all__ = ["ListPace"]

READS: Final = 5
"""Reads that ArduPilot answers at once: the gaps between the answers are the link's doing."""
ENOUGH_ANSWERS: Final = 3
"""Answers that tell enough when the rest is lost."""
BATCH: Final = 0.05
"""Seconds by which two answers of one batch are apart at most, on links of 740 bytes/s and more."""
LONGEST: Final = 0.6
"""Seconds after which the pace is judged by what has come: two batches, and a round trip of 0.4 s."""
LIST_SHARE: Final = 0.3
"""The share of the link that ArduPilot's list takes (measured: 34.6 s for 1382 values at 57600 baud)."""
QUICKEST_GAP: Final = 1 / 1680
"""Seconds from one value of the list to the next on a link that is no limit (measured)."""


class ListPace(Operation[float]):
    """Seconds that the whole list would take; infinity where too little has come to tell.

    The reads are those of the first indices, which any download needs.

    Args:
        reads: the component's.
        now: the time.
    """

    def __init__(self, reads: Reads, now: float) -> None:
        super().__init__(now)
        self._reads = reads
        self._count = 0
        self._came: list[float] = []
        self._judged_at = now + LONGEST
        self._open = [reads.ask(index, now) for index in range(READS)]
        for read in list(self._open):
            read.on_done.append(partial(self._ended, read))

    def tick(self, now: float) -> None:
        """Judge when it is time."""
        if not self.done and self._judged_at <= now:
            self._judge(now)

    def next_deadline(self) -> float:
        """When `tick` has something to do, or infinity."""
        return math.inf if self.done else self._judged_at

    def cancel(self) -> None:
        """Nobody wants to know any more."""
        open_reads, self._open = self._open, []
        for read in open_reads:
            self._reads.release(read)

    def _ended(self, read: Read) -> None:
        if read not in self._open:
            return
        self._open.remove(read)
        if read.result is not None:
            self._count = read.result.param_count
            self._came.append(read.ended_at)
        if not self._open:
            self._judge(read.ended_at)
        elif len(self._came) >= ENOUGH_ANSWERS:
            self._judged_at = min(self._judged_at, read.ended_at + BATCH)

    def _judge(self, now: float) -> None:
        self.cancel()
        gaps = [after - before for before, after in zip(self._came, self._came[1:], strict=False)]
        gaps = sorted(gap for gap in gaps if gap <= BATCH)
        if not gaps:
            self.finish(math.inf, now)
            return
        self.finish(self._count * max(gaps[len(gaps) // 2] / LIST_SHARE, QUICKEST_GAP), now)
