"""The search for a vehicle under the system id that it was given."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from paramclient.errors import AnotherVehicle
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.requests.retry import SUCCESSOR_REQUESTS

__all__ = ["SEARCH_INTERVAL", "SystemIdSearch"]

SEARCH_INTERVAL: Final = 0.5
"""Seconds until the next look when no message was received."""
OLD_ID_SILENCE_MIN: Final = 3.0
"""Seconds by which a vehicle without a hardware id of its own must have been silent under the old system id,
while it is heard under the new one: two heartbeats were not received."""


class SystemIdSearch:
    """The search for a component under another address.

    Args:
        before: the component before; its present identity is the reference.
        address: the address to look at.

    Attributes:
        address: the same.
    """

    def __init__(self, before: ComponentMachine, address: tuple[int, int]) -> None:
        self.address = address
        self._before = before
        self._identity = before.identity
        self._ask_at = -math.inf

    @property
    def awaited(self) -> str:
        """The searched component as text."""
        old, new = self._before, "/".join(map(str, self.address))
        return f"{old.system}/{old.component} ({self._identity}) as {new}"

    def look(self, components: Mapping[tuple[int, int], ComponentMachine], now: float) -> bool:
        """Return whether the vehicle is there and is the same one.

        Raises:
            AnotherVehicle: another vehicle uses the address.
        """
        if self._identity.uid is None:  # its identity may be in flight
            self._identity = self._before.identity
        found = components.get(self.address)
        if (
            found is None
            or now - found.presence.received_at > OLD_ID_SILENCE_MIN
            or not found.presence.has_beaten
        ):
            return False
        identity = found.identity
        if found.context.may_be_another or (self._identity.uid is not None and identity.uid is None):
            self._ask_again(found, now)
            return False
        if not self._identity.is_same_vehicle(identity):
            raise AnotherVehicle(*self.address, str(self._identity), str(identity))
        hush = found.presence.received_at - self._before.presence.received_at
        return hush > 0.0 if self._identity.has_own_uid else hush >= OLD_ID_SILENCE_MIN

    def _ask_again(self, found: ComponentMachine, now: float) -> None:
        if now >= self._ask_at:
            self._ask_at = now + SUCCESSOR_REQUESTS.later
            found.identification.doubt(now)
