"""Lost frames of one sender, by the gaps in its sequence numbers."""

from __future__ import annotations

from typing import Final

GAP_MAX: Final = 100
"""Frames lost in a row, at most: the numbers wrap at 256, so a longer jump may have any cause."""
REORDER_DEPTH: Final = 16
"""Frames by which a late one may be behind. A frame further behind belongs to another numbering."""
CERTAIN_GAP: Final = 8
"""The shortest gap that counts as loss after a silence of `NUMBERING_TIMEOUT` seconds."""
NUMBERING_TIMEOUT: Final = 5.0
"""Seconds of silence after which only a gap of `CERTAIN_GAP` counts: the sender may have started a new
numbering, as after a reboot, or its numbers may have wrapped several times."""
NUMBERING_CONFIRMATION_FRAMES: Final = 32
"""Numbers without a continuation after which the numbering before a jump counts as ended."""
NUMBERINGS_MAX: Final = 4
"""Parallel numberings: a vehicle numbers each of its links separately, and a router may merge them."""


class _Numbering:
    """One run of sequence numbers, each the successor of the one before except for losses."""

    __slots__ = ("before", "gap", "last", "missing", "span")

    def __init__(self, last: int, before: _Numbering | None, gap: int) -> None:
        self.last = last
        self.missing = 0  # bit n: the number n + 1 before the last was not received
        self.before = before  # the numbering that it may continue, while that is open
        self.gap = gap  # counted as lost between the two
        self.span = 0  # numbers since the first
        self.skip(gap)

    def skip(self, gap: int) -> None:
        """Record numbers before the last one that were not received."""
        self.missing = ((self.missing << (gap + 1)) | ((1 << gap) - 1)) & _REMEMBERED


class SequenceCheck:
    """Follows the sequence numbers of one (system, component) from one peer.

    A frame whose number is up to `GAP_MAX` + 1 ahead of the last one shows the losses between. A frame up
    to `REORDER_DEPTH` behind is late, which corrects a loss, or a duplicate. Any other number begins a
    numbering of its own and shows no loss, as after a reboot, or where a router merges several links of one
    vehicle, each with its own numbers. The numbering before the jump is kept for a while: if it continues,
    both run in parallel, and the losses counted between them are corrected.

    A reboot within less than `NUMBERING_TIMEOUT`, whose first number happens to be ahead within `GAP_MAX`,
    cannot be distinguished from a loss. Nor can frames that a router filters out.

    Attributes:
        lost: frames not received.
        repeated: frames received before.
        late: frames received after a later one.
    """

    def __init__(self) -> None:
        self.lost = 0
        self.repeated = 0
        self.late = 0
        self._numberings: list[_Numbering] = []  # the most recently used one first
        self._received_at = 0.0

    def receive(self, sequence: int, now: float) -> None:
        """Record the number of a frame."""
        silence = now - self._received_at
        self._received_at = now
        gap, nearest = min(
            (((sequence - each.last - 1) % 256, index) for index, each in enumerate(self._numberings)),
            default=(255, 0),
        )
        if gap <= CERTAIN_GAP:
            self._continue(nearest, sequence, gap)
        elif not self._is_late(sequence):
            self._begin(sequence, silence)

    def _continue(self, index: int, sequence: int, gap: int) -> None:
        numbering = self._numberings.pop(index)
        numbering.last = sequence
        numbering.span += gap + 1
        numbering.skip(gap)
        self.lost += gap
        for other in self._numberings:
            if other.before is numbering:  # both continue: nothing was lost between them
                other.before = None
                other.missing &= (1 << other.span) - 1
                self.lost -= other.gap
                other.gap = 0
        over = set()
        if numbering.span >= NUMBERING_CONFIRMATION_FRAMES:
            before, numbering.before = numbering.before, None
            while before is not None:
                over.add(before)
                before = before.before
        self._numberings = [numbering, *(other for other in self._numberings if other not in over)]

    def _is_late(self, sequence: int) -> bool:
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
        if gap > GAP_MAX or silence >= NUMBERING_TIMEOUT:
            gap = 0
        self.lost += gap
        self._numberings.insert(0, _Numbering(sequence, before, gap))
        del self._numberings[NUMBERINGS_MAX:]


_REMEMBERED = (1 << REORDER_DEPTH) - 1
