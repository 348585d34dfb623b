"""Bytes of request bodies that are in memory: of all requests together, and of each holder."""

from __future__ import annotations

from collections import Counter
from types import TracebackType
from typing import Final

from paramclient.service.request import Denied

__all__ = ["MAX_BODIES", "MAX_BODIES_OF_ONE", "HeldBodies", "HeldBody"]

MAX_BODIES: Final = 64 * 1024 * 1024
"""Bytes of the bodies of all requests that are being read or answered."""
MAX_BODIES_OF_ONE: Final = 16 * 1024 * 1024
"""Bytes of the bodies of one holder's requests that are being read or answered: four holders fill the memory
that is there for all."""


class HeldBodies:
    """Counts the bytes of bodies from the moment at which they come until their requests are answered."""

    def __init__(self) -> None:
        self._held: Counter[str] = Counter()
        self._total = 0

    def hold(self, holder: str) -> HeldBody:
        """Count a body of this holder, as a context manager; at its end its bytes count no more."""
        return HeldBody(self, holder)

    def add(self, holder: str, size: int) -> None:
        """Count further bytes.

        Raises:
            Denied: 429, the holder has too many; 503, all together have. They count all the same.
        """
        self._held[holder] += size
        self._total += size
        if self._held[holder] > MAX_BODIES_OF_ONE:
            what = f"The bodies of your requests may have {MAX_BODIES_OF_ONE} bytes at once, until answered."
            raise Denied(429, "too-many", what, _SOON)
        if self._total > MAX_BODIES:
            raise Denied(503, "busy", "Too much is being sent to this service at once.", _SOON)

    def remove(self, holder: str, size: int) -> None:
        """Count bytes no more."""
        self._total -= size
        self._held[holder] -= size
        if self._held[holder] <= 0:
            del self._held[holder]


class HeldBody:
    """The bytes of one body; see `HeldBodies.hold`."""

    def __init__(self, bodies: HeldBodies, holder: str) -> None:
        self._bodies = bodies
        self._holder = holder
        self._size = 0

    def add(self, size: int) -> None:
        """Count further bytes.

        Raises:
            Denied: as `HeldBodies.add`.
        """
        self._size += size
        self._bodies.add(self._holder, size)

    def __enter__(self) -> HeldBody:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bodies.remove(self._holder, self._size)
        self._size = 0


_SOON: Final = [(b"retry-after", b"1")]
