"""Slots of connections: their number, their assignment, and which connection is closed when none is free."""

from __future__ import annotations

import sys
from collections.abc import Callable
from enum import IntEnum
from typing import Final

from paramclient.service.client_address import client_network, is_loopback

if sys.platform != "win32":
    import resource

__all__ = ["ConnectionSlot", "ConnectionSlots", "ConnectionStage", "connection_limit"]

SERVICE_CONNECTIONS_MAX: Final = 512
"""Maximum number of connections: some hundred event listeners, and half of the 1,024 files that a process may
open."""
ADDRESS_CONNECTIONS_MAX: Final = 128
"""Maximum number of connections from one address, or one IPv6 network of 64 bits. Loopback addresses and
trusted proxies are limited only by the total, because many clients share the address of a proxy."""
LOOPBACK_RESERVED: Final = 32
"""Number of connections reserved for this computer, so that an administrator can always connect."""


class ConnectionStage(IntEnum):
    """Progress of a connection. If no slot is free, a connection of the lowest stage is closed first."""

    SILENT = 0
    """The client has sent nothing."""
    STARTED = 1
    """The client has sent a part of a TLS handshake or of the head of a request."""
    IDLE = 2
    """All requests have responses."""
    ACTIVE = 3
    """A request is in progress. The connection keeps its slot."""


class ConnectionSlot:
    """Slot of one connection.

    Attributes:
        client: address or network that it counts for.
        is_reserved: whether it may be one of the reserved slots.
        close: closes the connection; set by the current owner of the connection.
    """

    def __init__(self, slots: ConnectionSlots, client: str, *, is_reserved: bool) -> None:
        self.client = client
        self.is_reserved = is_reserved
        self.close: Callable[[], object] = _nothing
        self._slots = slots
        self._stage = ConnectionStage.SILENT
        self._is_released = False

    @property
    def stage(self) -> ConnectionStage:
        """Return the progress of the connection."""
        return self._stage

    @stage.setter
    def stage(self, stage: ConnectionStage) -> None:
        if stage is not self._stage and not self._is_released:
            del self._slots.at[self._stage][self]
            self._stage = stage
            self._slots.at[stage][self] = None

    def release(self) -> None:
        """Free the slot after the end of the connection. A second call does nothing."""
        if not self._is_released:
            self._is_released = True
            self._slots.remove(self)


class ConnectionSlots:
    """All slots.

    Args:
        most: maximum number of connections; None for `connection_limit()`.
        is_local: returns whether an address belongs to this computer; None for `is_loopback`.
        is_proxy: returns whether an address belongs to a trusted proxy.

    Attributes:
        at: slots by stage, the oldest first.
    """

    def __init__(
        self,
        most: int | None = None,
        *,
        is_local: Callable[[str], bool] | None = None,
        is_proxy: Callable[[str], bool] = lambda _: False,
    ) -> None:
        self.at: dict[ConnectionStage, dict[ConnectionSlot, None]] = {stage: {} for stage in ConnectionStage}
        self._most = connection_limit() if most is None else most
        self._remote_max = self._most - min(LOOPBACK_RESERVED, self._most // 4)
        self._is_local = is_loopback if is_local is None else is_local
        self._is_proxy = is_proxy
        self._counts: dict[str, int] = {}
        self._remote_count = 0

    def __len__(self) -> int:
        return sum(map(len, self.at.values()))

    def take(self, address: str) -> ConnectionSlot | None:
        """Return a slot for a connection from this address, or None.

        If no slot is free, a connection without a request in progress is closed: one of the same address if
        that has its maximum, else any.
        """
        is_local = self._is_local(address)
        client = client_network(address)
        is_one = not (is_local or self._is_proxy(address))
        if is_one and self._counts.get(client, 0) >= ADDRESS_CONNECTIONS_MAX and not self._close_one(client):
            return None
        is_full = len(self) >= self._most or (not is_local and self._remote_count >= self._remote_max)
        if is_full and not self._close_one(None, spare_local=not is_local):
            return None
        slot = ConnectionSlot(self, client, is_reserved=is_local)
        self.at[ConnectionStage.SILENT][slot] = None
        self._counts[client] = self._counts.get(client, 0) + 1
        self._remote_count += not is_local
        return slot

    def remove(self, slot: ConnectionSlot) -> None:
        """Remove a slot; see `ConnectionSlot.release`."""
        del self.at[slot.stage][slot]
        self._remote_count -= not slot.is_reserved
        self._counts[slot.client] -= 1
        if not self._counts[slot.client]:
            del self._counts[slot.client]

    def close_idle(self) -> None:
        """Close all connections without a request in progress."""
        while self._close_one(None):
            pass

    def _close_one(self, client: str | None, *, spare_local: bool = False) -> bool:
        """Close the oldest connection of the lowest stage. Return False if all have requests in progress."""
        for stage in (ConnectionStage.SILENT, ConnectionStage.STARTED, ConnectionStage.IDLE):
            for slot in self.at[stage]:
                if client in (None, slot.client) and not (spare_local and slot.is_reserved):
                    slot.release()
                    slot.close()
                    return True
        return False


def connection_limit() -> int:
    """Return the maximum number of connections: half of the files that this process may open, and at most
    `SERVICE_CONNECTIONS_MAX`."""
    return (
        SERVICE_CONNECTIONS_MAX
        if (files := _most_files()) is None
        else min(SERVICE_CONNECTIONS_MAX, files // 2)
    )


if sys.platform == "win32":

    def _most_files() -> int | None:
        return None

else:

    def _most_files() -> int | None:
        limit, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        return None if limit == resource.RLIM_INFINITY else limit


def _nothing() -> None:
    return
