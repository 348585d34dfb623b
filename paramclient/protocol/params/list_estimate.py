"""The expected duration of a component's list, estimated from a few single reads."""

from __future__ import annotations

import math
from functools import partial
from typing import Final

from paramclient.protocol.params.reads import Read, Reads
from paramclient.protocol.requests.operation import Operation

__all__ = ["ListPace"]

ESTIMATE_READS: Final = 5
"""Reads that ArduPilot answers at once: the gaps between the responses are due to the link."""
RESPONSES_MIN: Final = 3
"""Responses that are enough when the others are lost."""
BATCH_SPREAD: Final = 0.05
"""Seconds between two responses of one batch, at most, on links of 740 bytes/s and more."""
ESTIMATE_TIMEOUT: Final = 0.6
"""Seconds after which the pace is estimated from the responses so far: two batches, and a round trip of 0.4
s."""
LIST_SHARE: Final = 0.3
"""The share of the link's bandwidth that ArduPilot's list uses (measured: 34.6 s for 1382 values at 57600
baud)."""
LIST_GAP_MIN: Final = 1 / 1680
"""Seconds between two values of the list on a link that is no bottleneck (measured)."""


class ListPace(Operation[float]):
    """The expected seconds of the whole list; infinity after too few responses.

    It reads the first indices, which any download needs.

    Args:
        reads: the component's.
        now: the time.
    """

    def __init__(self, reads: Reads, now: float) -> None:
        super().__init__(now)
        self._reads = reads
        self._count = 0
        self._arrivals: list[float] = []
        self._judged_at = now + ESTIMATE_TIMEOUT
        self._open = [reads.ask(index, now) for index in range(ESTIMATE_READS)]
        for read in list(self._open):
            read.on_done.append(partial(self._ended, read))

    def tick(self, now: float) -> None:
        """Estimate when it is due."""
        if not self.done and self._judged_at <= now:
            self._judge(now)

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity."""
        return math.inf if self.done else self._judged_at

    def cancel(self) -> None:
        """Cancel the reads."""
        open_reads, self._open = self._open, []
        for read in open_reads:
            self._reads.release(read)

    def _ended(self, read: Read) -> None:
        if read not in self._open:
            return
        self._open.remove(read)
        if read.result is not None:
            self._count = read.result.param_count
            self._arrivals.append(read.ended_at)
        if not self._open:
            self._judge(read.ended_at)
        elif len(self._arrivals) >= RESPONSES_MIN:
            self._judged_at = min(self._judged_at, read.ended_at + BATCH_SPREAD)

    def _judge(self, now: float) -> None:
        self.cancel()
        gaps = [after - before for before, after in zip(self._arrivals, self._arrivals[1:], strict=False)]
        gaps = sorted(gap for gap in gaps if gap <= BATCH_SPREAD)
        if not gaps:
            self.finish(math.inf, now)
            return
        self.finish(self._count * max(gaps[len(gaps) // 2] / LIST_SHARE, LIST_GAP_MIN), now)
