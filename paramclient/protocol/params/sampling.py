"""Whether a cached table is still the vehicle's, judged by a sample of it: for vehicles without a hash."""

from __future__ import annotations

import math
import random
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Final

from paramclient.model.values import Encoding, Param, as_sent
from paramclient.protocol.params.reads import Read, Reads
from paramclient.protocol.requests.operation import Operation

__all__ = ["SAMPLE_SIZE", "Sample", "Sampling"]

SAMPLE_SIZE: Final = 30
"""Parameters in a sample, unless the caller says otherwise: ArduPilot serves them in 0.6 s, and of a table of
1,400 in which one in ten differs, 96 samples in 100 show it."""


@dataclass(frozen=True, slots=True)
class Sample:
    """What a sample of a table has shown.

    Attributes:
        size: parameters that were read.
        count: those that the table has.
        differing: what did not agree, in words; empty where everything did.
    """

    size: int
    count: int
    differing: tuple[str, ...] = ()

    @property
    def agrees(self) -> bool:
        """Whether name, value and count were the cached ones for each."""
        return not self.differing

    def confidence(self, changed: int = 1) -> float:
        """The chance with which such a sample shows it when so many parameters have changed, 0 to 1.

        It says nothing of which ones may have: of a single changed parameter a sample of 30 in 1,400 mostly
        knows nothing.
        """
        left = self.count - changed
        if left < self.size:
            return 1.0
        missed = math.comb(left, self.size) / math.comb(self.count, self.size)
        return 1.0 - missed


class Sampling(Operation[Sample]):
    """Reads of some indices, drawn with a seed. It ends with the sample, or with the error of a read.

    It ends at the first that does not agree.

    Args:
        reads: the component's.
        params: the table, which the answers go into before they come here.
        encoding: how the component writes values.
        count: parameters that the table has.
        size: how many to read.
        seed: of the draw.
        now: the time.
    """

    def __init__(
        self,
        reads: Reads,
        params: Mapping[str, Param],
        encoding: Encoding,
        count: int,
        now: float,
        *,
        size: int,
        seed: int,
    ) -> None:
        super().__init__(now)
        self._reads = reads
        self._encoding = encoding
        self._count = count
        by_index = {param.index: param for param in params.values() if param.index is not None}
        drawn = random.Random(seed).sample(range(count), min(size, count))
        # the answers change the table, so what is expected is taken down before
        self._expected = {index: by_index.get(index) for index in sorted(drawn)}
        self._size = len(drawn)
        self._open = {index: reads.ask(index, now, urgent=False) for index in self._expected}
        for index, read in self._open.items():
            read.on_done.append(partial(self._came, index, read))

    def cancel(self) -> None:
        """Nobody wants it any more."""
        left, self._open = self._open, {}
        for read in left.values():
            self._reads.release(read)

    def _came(self, index: int, read: Read) -> None:
        if self._open.pop(index, None) is None:
            return
        now = read.ended_at
        if read.result is None:
            assert read.error is not None
            self.cancel()
            self.fail(read.error, now)
            return
        name, raw, number, count, _ = read.result
        known = self._expected[index]
        words = ""
        if count != self._count:
            words = f"the vehicle has {count} parameters, and not {self._count}"
        elif known is None or known.name != name:
            words = f"parameter {index} is {name}"
        elif known.type != number or as_sent(known.bits, number, self._encoding) != raw:
            words = f"{name} has another value"
        if words:
            self.cancel()
            self.finish(Sample(self._size, self._count, (words,)), now)
        elif not self._open:
            self.finish(Sample(self._size, self._count), now)
