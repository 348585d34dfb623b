"""Parameters that share a name: which of them the name means."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping
from functools import partial
from typing import Final

from paramclient.protocol.params.reads import Read, Reads
from paramclient.protocol.params.table import Table
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.requests.round_trip import RoundTrip

__all__ = ["Repeated", "repeated_names"]

MOST_TOLD: Final = 5
"""Names that a note gives one by one."""
SHORTEST_WAIT: Final = 0.3
"""Seconds until the names are asked for, at the least: late answers to reads by index carry them too."""
ANSWERS_PAUSE: Final = 0.15
"""Seconds from an answer until the name is asked for again. Several late values of the name may come in one
moment, and each would count as an answer to the next read otherwise."""
ENOUGH_ANSWERS: Final = 3
"""Answers in a row that must say the same: a list that another station has asked for brings every value of
the name."""
MOST_ANSWERS: Final = 12
"""Answers after which it is left open."""


def repeated_names(names: Mapping[int, str]) -> dict[str, tuple[int, ...]]:
    """The names that stand at more than one index, each with its indices, rising."""
    if len(set(names.values())) == len(names):
        return {}
    indices: dict[str, list[int]] = defaultdict(list)
    for index in sorted(names):
        indices[names[index]].append(index)
    return {name: tuple(places) for name, places in indices.items() if len(places) > 1}


class Repeated(Operation[None]):
    """Asks for each repeated name, so that the table holds what the component itself means by it.

    What stands at the other indices then counts no more: it would replace that value each time it passes by.
    A component that does not tell an index with a name (ArduPilot) means none of them by it; one that does
    not answer leaves the value that was heard last.

    What was passed over before and is repeated no longer is asked for too: its value may have been missed.

    Args:
        names: as of `repeated_names`.
        round_trip, reads, table: the component's.
        now: the time.
    """

    def __init__(
        self,
        names: Mapping[str, tuple[int, ...]],
        round_trip: RoundTrip,
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
        first_at = now + max(round_trip.timeout, SHORTEST_WAIT)
        self._ask_at = dict.fromkeys(sorted(names.keys() | table.passed_over.keys()), first_at)
        table.passed_over.clear()

    def tick(self, now: float) -> None:
        """Ask, once what was under way before is over."""
        for name in [name for name, at in self._ask_at.items() if at <= now]:
            del self._ask_at[name]
            self._ask(name, now)

    def next_deadline(self) -> float:
        """When `tick` has something to do, or infinity. The reads have deadlines of their own."""
        return min(self._ask_at.values(), default=math.inf)

    @property
    def note(self) -> str:
        """What a user should know of it."""
        told = [
            f"{name} (indices {', '.join(map(str, places))})"
            for name, places in list(self.names.items())[:MOST_TOLD]
        ]
        more = f" and {len(self.names) - MOST_TOLD} more" if len(self.names) > MOST_TOLD else ""
        return (
            f"Several parameters share a name, as where names are cut at 16 bytes: {', '.join(told)}{more}. "
            "The table holds the one that the vehicle answers with when it is asked by name; "
            "the others can be read by index only."
        )

    def cancel(self) -> None:
        """Nobody waits any more."""
        self._ask_at.clear()
        reads, self._open = self._open, {}
        for read in reads.values():
            self._reads.release(read)

    def _ask(self, name: str, now: float) -> None:
        read = self._open[name] = self._reads.ask(name, now, urgent=False)
        read.on_done.append(partial(self._one_ended, name, read))

    def _one_ended(self, name: str, read: Read) -> None:
        if self._open.pop(name, None) is None:
            return
        if read.result is not None and name in self.names:
            answers = self._answers.setdefault(name, [])
            answers.append(read.result.param_index)
            if answers[-ENOUGH_ANSWERS:] == [read.result.param_index] * ENOUGH_ANSWERS:
                self._table.passed_over[name] = frozenset(self.names[name]) - {read.result.param_index}
            elif len(answers) < MOST_ANSWERS:
                self._ask_at[name] = read.ended_at + ANSWERS_PAUSE
        if not self._open and not self._ask_at:
            self.finish(None, read.ended_at)
