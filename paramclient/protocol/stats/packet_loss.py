"""How many frames of one sender were lost, by the gaps in their sequence numbers."""

from __future__ import annotations

from typing import Final

__all__ = ["SequenceCheck"]

LONGEST_GAP: Final = 100
"""Frames lost in a row that are believed: the numbers go round at 256, so a longer jump may be anything."""
REORDER_DEPTH: Final = 16
"""How far a frame may come behind its turn. One further back belongs to another numbering."""
SURE_GAP: Final = 8
SILENCE: Final = 5.0
"""Seconds after which only a gap of `SURE_GAP` is believed: who was silent so long may have started anew, as
after a reboot, or may have sent the numbers round and round."""
PROBATION: Final = 32
"""Numbers after which the numbering before a jump counts as over, if nothing has continued it."""
MOST_NUMBERINGS: Final = 4
"""Numberings side by side: a vehicle counts for each of its own links, and a router may join those."""


class _Numbering:
    """One run of sequence numbers, each the successor of the one before but for what was lost."""

    __slots__ = ("before", "gap", "last", "missing", "span")

    def __init__(self, last: int, before: _Numbering | None, gap: int) -> None:
        self.last = last
        self.missing = 0  # bit n: the number n + 1 before the last has not come
        self.before = before  # what it may be the continuation of, as long as that is open
        self.gap = gap  # what is counted as lost between the two
        self.span = 0  # numbers since the first
        self.skip(gap)

    def skip(self, gap: int) -> None:
        """Remember that so many numbers before the last one have not come."""
        self.missing = ((self.missing << (gap + 1)) | ((1 << gap) - 1)) & _REMEMBERED


class SequenceCheck:
    """Follows the sequence numbers of one (system, component) as they come from one peer.

    A frame whose number is up to `LONGEST_GAP` + 1 ahead of the last one tells of what is lost between. One
    that is up to `REORDER_DEPTH` behind has come late, which makes a loss undone, or twice. Any other number
    begins a numbering of its own and tells of no loss: so it is after a reboot, and so it is where a router
    joins several links of one vehicle, each with its own numbers. The numbering before the jump is kept for a
    while: if it goes on, both run side by side, and what had been counted as lost between them was not.

    A reboot whose first number happens to lie ahead within `LONGEST_GAP`, and that takes less than `SILENCE`,
    cannot be told from a loss. Nor can frames that a router leaves out on purpose.

    Attributes:
        lost: frames that have not come.
        repeated: frames that have come before.
        late: frames that have come after a later one.
    """

    def __init__(self) -> None:
        self.lost = 0
        self.repeated = 0
        self.late = 0
        self._numberings: list[_Numbering] = []  # the one that was used last comes first
        self._heard_at = 0.0

    def heard(self, sequence: int, now: float) -> None:
        """Take the number of a frame."""
        silence = now - self._heard_at
        self._heard_at = now
        gap, nearest = min(
            (((sequence - each.last - 1) % 256, index) for index, each in enumerate(self._numberings)),
            default=(255, 0),
        )
        if gap <= SURE_GAP:
            self._continue(nearest, sequence, gap)
        elif not self._came_late(sequence):
            self._begin(sequence, silence)

    def _continue(self, index: int, sequence: int, gap: int) -> None:
        numbering = self._numberings.pop(index)
        numbering.last = sequence
        numbering.span += gap + 1
        numbering.skip(gap)
        self.lost += gap
        for other in self._numberings:
            if other.before is numbering:  # both go on: nothing was lost between them
                other.before = None
                other.missing &= (1 << other.span) - 1
                self.lost -= other.gap
                other.gap = 0
        over = set()
        if numbering.span >= PROBATION:
            before, numbering.before = numbering.before, None
            while before is not None:
                over.add(before)
                before = before.before
        self._numberings = [numbering, *(other for other in self._numberings if other not in over)]

    def _came_late(self, sequence: int) -> bool:
        for each in self._numberings:
            behind = (each.last - sequence) % 256
            if behind <= REORDER_DEPTH:
                bit = 1 << (behind - 1) if behind else 0
                if each.missing & bit:
                    each.missing ^= bit
                    self.lost -= 1
                    self.late += 1
                    if behind > each.span and each.gap:
                        each.gap -= 1
                else:
                    self.repeated += 1
                return True
        return False

    def _begin(self, sequence: int, silence: float) -> None:
        before = self._numberings[0] if self._numberings else None
        gap = 0 if before is None else (sequence - before.last) % 256 - 1
        if gap > LONGEST_GAP or silence >= SILENCE:
            gap = 0
        self.lost += gap
        self._numberings.insert(0, _Numbering(sequence, before, gap))
        del self._numberings[MOST_NUMBERINGS:]


_REMEMBERED = (1 << REORDER_DEPTH) - 1
