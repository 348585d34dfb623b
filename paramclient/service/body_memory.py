"""Memory limits of request bodies, per holder and in total."""

from __future__ import annotations

from collections import Counter
from types import TracebackType
from typing import Final

from paramclient.service.body_limits import HOLDER_BODY_BYTES_MAX, TOTAL_BODY_BYTES_MAX
from paramclient.service.request import RequestDenied

__all__ = ["BodyMemory", "BodyReservation"]


class BodyMemory:
    """Counts the bytes of bodies from their receipt until the end of their requests."""

    def __init__(self) -> None:
        self._reserved: Counter[str] = Counter()
        self._total = 0

    def hold(self, holder: str) -> BodyReservation:
        """Return a context manager that counts a body of this holder until its end."""
        return BodyReservation(self, holder)

    def add(self, holder: str, size: int) -> None:
        """Count received bytes.

        Raises:
            RequestDenied: 429, the holder has too many; 503, all holders together have. The bytes are counted
                nevertheless.
        """
        self._reserved[holder] += size
        self._total += size
        if self._reserved[holder] > HOLDER_BODY_BYTES_MAX:
            what = f"All bodies of your requests may have {HOLDER_BODY_BYTES_MAX} bytes. Try again later."
            raise RequestDenied(429, "too-many", what, _SOON)
        if self._total > TOTAL_BODY_BYTES_MAX:
            raise RequestDenied(
                503,
                "busy",
                "The bodies of all requests in progress have too many bytes. Try again later.",
                _SOON,
            )

    def remove(self, holder: str, size: int) -> None:
        """Remove bytes from the count."""
        self._total -= size
        self._reserved[holder] -= size
        if self._reserved[holder] <= 0:
            del self._reserved[holder]


class BodyReservation:
    """The counted bytes of one body; see `BodyMemory.hold`."""

    def __init__(self, bodies: BodyMemory, holder: str) -> None:
        self._bodies = bodies
        self._holder = holder
        self._size = 0

    def add(self, size: int) -> None:
        """Count received bytes.

        Raises:
            RequestDenied: see `BodyMemory.add`.
        """
        self._size += size
        self._bodies.add(self._holder, size)

    def __enter__(self) -> BodyReservation:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bodies.remove(self._holder, self._size)
        self._size = 0


_SOON: Final = [(b"retry-after", b"1")]
