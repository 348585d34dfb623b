"""Places for connections: how many there are, who gets one, and who loses one when there is none left."""

from __future__ import annotations

import sys
from collections.abc import Callable
from enum import IntEnum
from typing import Final

from paramclient.service.client_address import is_loopback, network_of

if sys.platform != "win32":
    import resource

__all__ = ["Place", "Places", "Stage", "most_connections"]

MOST_CONNECTIONS: Final = 512
"""Connections at once: some hundred listeners, and half of the 1,024 files that a process may open."""
MOST_FROM_ONE: Final = 128
"""Of them from one address, or from one network of IPv6. Those of this computer and of a trusted proxy count
in all alone, as the latter are many clients."""
KEPT_FOR_LOOPBACK: Final = 32
"""Of them those that only this computer gets: whoever looks after the service can always reach it."""


class Stage(IntEnum):
    """How far a connection has come. When there is no place left, the lowest stage loses one first."""

    SILENT = 0
    """It has sent nothing."""
    BEGUN = 1
    """It has sent something: of a TLS handshake, or of the head of a request."""
    IDLE = 2
    """It was answered, and asks nothing more at present."""
    ASKING = 3
    """It is being answered; it keeps its place."""


class Place:
    """The place of one connection.

    Attributes:
        client: the address that it counts for.
        is_kept: whether it may have one of the places that are kept for this computer.
        leave: ends the connection; whoever has the connection at present sets it.
    """

    def __init__(self, places: Places, client: str, *, is_kept: bool) -> None:
        self.client = client
        self.is_kept = is_kept
        self.leave: Callable[[], object] = _nothing
        self._places = places
        self._stage = Stage.SILENT
        self._is_free = False

    @property
    def stage(self) -> Stage:
        """How far the connection has come."""
        return self._stage

    @stage.setter
    def stage(self, stage: Stage) -> None:
        if stage is not self._stage and not self._is_free:
            del self._places.at[self._stage][self]
            self._stage = stage
            self._places.at[stage][self] = None

    def free(self) -> None:
        """The connection is over. Nothing happens the second time."""
        if not self._is_free:
            self._is_free = True
            self._places.remove(self)


class Places:
    """All places.

    Args:
        most: connections at once; None for `most_connections()`.
        is_here: whether an address is one of this computer's; None for `is_loopback`.
        is_proxy: whether an address is that of a proxy that is trusted.

    Attributes:
        at: the connections at each stage, the longest there first.
    """

    def __init__(
        self,
        most: int | None = None,
        *,
        is_here: Callable[[str], bool] | None = None,
        is_proxy: Callable[[str], bool] = lambda _: False,
    ) -> None:
        self.at: dict[Stage, dict[Place, None]] = {stage: {} for stage in Stage}
        self._most = most_connections() if most is None else most
        self._most_beyond = self._most - min(KEPT_FOR_LOOPBACK, self._most // 4)
        self._is_here = is_loopback if is_here is None else is_here
        self._is_proxy = is_proxy
        self._counts: dict[str, int] = {}
        self._beyond = 0

    def __len__(self) -> int:
        return sum(map(len, self.at.values()))

    def take(self, address: str) -> Place | None:
        """A place for a connection from this address; None where there is none.

        Where there would be none, a connection that is not being answered is ended for it: of the same
        address where that has as many as it may have, else of anyone.
        """
        is_here = self._is_here(address)
        client = network_of(address)
        is_one = not (is_here or self._is_proxy(address))
        if is_one and self._counts.get(client, 0) >= MOST_FROM_ONE and not self._end_one(client):
            return None
        is_full = len(self) >= self._most or (not is_here and self._beyond >= self._most_beyond)
        if is_full and not self._end_one(None, spares_here=not is_here):
            return None
        place = Place(self, client, is_kept=is_here)
        self.at[Stage.SILENT][place] = None
        self._counts[client] = self._counts.get(client, 0) + 1
        self._beyond += not is_here
        return place

    def remove(self, place: Place) -> None:
        """Let others have it; `Place.free` does that."""
        del self.at[place.stage][place]
        self._beyond -= not place.is_kept
        self._counts[place.client] -= 1
        if not self._counts[place.client]:
            del self._counts[place.client]

    def end_all(self) -> None:
        """End every connection that is not being answered."""
        while self._end_one(None):
            pass

    def _end_one(self, client: str | None, *, spares_here: bool = False) -> bool:
        """End the first connection of the lowest stage; false where all are being answered."""
        for stage in (Stage.SILENT, Stage.BEGUN, Stage.IDLE):
            for place in self.at[stage]:
                if client in (None, place.client) and not (spares_here and place.is_kept):
                    place.free()
                    place.leave()
                    return True
        return False


def most_connections() -> int:
    """How many connections there may be: half of the files that this process may open, and no more than
    `MOST_CONNECTIONS`."""
    return MOST_CONNECTIONS if (files := _most_files()) is None else min(MOST_CONNECTIONS, files // 2)


if sys.platform == "win32":

    def _most_files() -> int | None:
        return None

else:

    def _most_files() -> int | None:
        limit, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        return None if limit == resource.RLIM_INFINITY else limit


def _nothing() -> None:
    return
