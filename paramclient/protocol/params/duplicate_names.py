"""Parameters that share a name: which of them the component means by it."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping
from functools import partial
from typing import Final

from paramclient.protocol.params.reads import Read, Reads
from paramclient.protocol.params.table import Table
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.requests.retry import RetryPolicy

__all__ = ["DuplicateNameReads", "repeated_names"]

DUPLICATES_LISTED_MAX: Final = 5
"""Names that a note lists one by one."""
FIRST_READ_DELAY_MIN: Final = 0.3
"""Seconds without a PARAM_VALUE until the names are read, at least; the timeout of a read, if longer. Late
responses to reads by index carry the names too."""
FIRST_READ_DELAY_MAX: Final = 3.0
"""Seconds until the names are read, at most: another station may request one list after the other."""
RESPONSE_PAUSE: Final = 0.15
"""Seconds from a response until the name is read again. Several late values of the name may arrive at one
moment, and each would otherwise count as a response to the next read."""
EQUAL_RESPONSES_MIN: Final = 3
"""Equal responses in a row that are required: a list that another station has requested brings every value of
the name."""
RESPONSES_MAX: Final = 12
"""Responses after which the question is left open."""


def repeated_names(names: Mapping[int, str]) -> dict[str, tuple[int, ...]]:
    """Return the names with more than one index, each with its indices, rising."""
    if len(set(names.values())) == len(names):
        return {}
    indices: dict[str, list[int]] = defaultdict(list)
    for index in sorted(names):
        indices[names[index]].append(index)
    return {name: tuple(places) for name, places in indices.items() if len(places) > 1}


class DuplicateNameReads(Operation[None]):
    """Reads each repeated name, so that the table holds the value that the component means by it.

    Values at the other indices are then ignored: each would replace that value on arrival. A component whose
    response by name has no index (ArduPilot) means none of them; one that does not answer leaves the last
    received value.

    Names whose values were ignored before and that are no longer repeated are read too: their value may have
    been missed.

    Args:
        names: as of `repeated_names`.
        policy, reads, table: the component's.
        now: the time.
    """

    def __init__(
        self,
        names: Mapping[str, tuple[int, ...]],
        policy: RetryPolicy,
        reads: Reads,
        table: Table,
        now: float,
    ) -> None:
        super().__init__(now)
        self.names = names
        self._reads = reads
        self._table = table
        self._open: dict[str, Read] = {}
        self._answers: dict[str, list[int]] = {}
        self._policy = policy
        self._names = sorted(names.keys() | table.duplicate_indices.keys())
        self._ask_at: dict[str, float] = {}
        self._is_reading = False
        self._postpone(now)
        table.duplicate_indices.clear()

    def receive(self, now: float) -> None:
        """Process a PARAM_VALUE of the component: until the first read, it may be a late response."""
        if not self._is_reading:
            self._postpone(now)

    def tick(self, now: float) -> None:
        """Read, once earlier reads are over."""
        for name in [name for name, at in self._ask_at.items() if at <= now]:
            del self._ask_at[name]
            self._is_reading = True
            self._ask(name, now)

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity. The reads have deadlines of their own."""
        return min(self._ask_at.values(), default=math.inf)

    @property
    def note(self) -> str:
        """A note for the user."""
        listed = [
            f"{name} (indices {', '.join(map(str, places))})"
            for name, places in list(self.names.items())[:DUPLICATES_LISTED_MAX]
        ]
        more = (
            f" and {len(self.names) - DUPLICATES_LISTED_MAX} more"
            if len(self.names) > DUPLICATES_LISTED_MAX
            else ""
        )
        return (
            f"Several parameters have one name, such as one cut to 16 bytes: {', '.join(listed)}{more}. "
            "The table has the one that the vehicle returns for a read by name; "
            "the others can only be read by index."
        )

    def cancel(self) -> None:
        """Cancel the reads."""
        self._ask_at.clear()
        reads, self._open = self._open, {}
        for read in reads.values():
            self._reads.release(read)

    def _postpone(self, now: float) -> None:
        at = min(now + max(self._policy.timeout, FIRST_READ_DELAY_MIN), self.begun_at + FIRST_READ_DELAY_MAX)
        self._ask_at = dict.fromkeys(self._names, at)

    def _ask(self, name: str, now: float) -> None:
        read = self._open[name] = self._reads.ask(name, now, urgent=False)
        read.on_done.append(partial(self._one_ended, name, read))

    def _one_ended(self, name: str, read: Read) -> None:
        if self._open.pop(name, None) is None:
            return
        if read.result is not None and name in self.names:
            answers = self._answers.setdefault(name, [])
            answers.append(read.result.param_index)
            if answers[-EQUAL_RESPONSES_MIN:] == [read.result.param_index] * EQUAL_RESPONSES_MIN:
                self._table.duplicate_indices[name] = frozenset(self.names[name]) - {read.result.param_index}
            elif len(answers) < RESPONSES_MAX:
                self._ask_at[name] = read.ended_at + RESPONSE_PAUSE
        if not self._open and not self._ask_at:
            self.finish(None, read.ended_at)
