"""Where a vehicle is that was given another system id."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from paramclient.errors import AnotherVehicle
from paramclient.protocol.component import ComponentMachine

__all__ = ["SEARCH_PACE", "Succession"]

SEARCH_PACE: Final = 0.5
"""Seconds after which it is looked again where nothing has come."""
ASKING_PACE: Final = 2.0
"""Seconds between two rounds of questions to a candidate that does not say who it is."""
HUSH: Final = 3.0
"""Seconds by which a vehicle without a hardware id of its own was heard longer under the new system id than
under the old one when it has moved: two heartbeats did not come. Whoever was not heard for so long is not
there to be judged."""


class Succession:
    """The search for a component that is to speak under another address.

    Args:
        before: what it was; who it is counts as of now.
        address: where it is looked for.

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
        """What is looked for, in words."""
        old, new = self._before, "/".join(map(str, self.address))
        return f"{old.system}/{old.component} ({self._identity}) as {new}"

    def look(self, components: Mapping[tuple[int, int], ComponentMachine], now: float) -> bool:
        """Whether the vehicle is there and is the same.

        Raises:
            AnotherVehicle: another one is.
        """
        if self._identity.uid is None:  # it may just be saying it
            self._identity = self._before.identity
        found = components.get(self.address)
        if found is None or now - found.presence.heard_at > HUSH or not found.presence.has_beaten:
            return False
        identity = found.identity
        if found.who.was_away or (self._identity.uid is not None and identity.uid is None):
            self._ask_again(found, now)
            return False
        if not self._identity.is_same_vehicle(identity):
            raise AnotherVehicle(*self.address, str(self._identity), str(identity))
        hush = found.presence.heard_at - self._before.presence.heard_at
        return hush > 0.0 if self._identity.has_own_uid else hush >= HUSH

    def _ask_again(self, found: ComponentMachine, now: float) -> None:
        if now >= self._ask_at:
            self._ask_at = now + ASKING_PACE
            found.who.doubt(now)
