"""Keep a table in sync with the vehicle's: check it after signs of change, and at intervals."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import anyio

from paramclient.errors import LinkError, NoReply
from paramclient.model.values import Param, Trust
from paramclient.protocol.digest import ask, may_confirm
from paramclient.protocol.fetch import Policy, differing, fetch_all
from paramclient.protocol.presence import Presence
from paramclient.protocol.reads import is_stale, read_many
from paramclient.protocol.session import Session
from paramclient.wire.messages import MAV_MODE_FLAG_SAFETY_ARMED

INTERVAL_MIN: Final = 1.0
"""Shortest interval in seconds that a user may choose."""
INTERVAL_DEFAULT: Final = 30.0
"""Seconds between two checks of a vehicle that confirms tables: two small messages each."""
SETTLING_TIME: Final = 0.5
"""Seconds from a sign of change to the check: PX4 pushes what a change has caused within 25 ms, and while an
ArduPilot sends a list, the numbers of parameters before and after a change alternate."""
OUTSIDE_AGE: Final = 120.0
"""Seconds after which a check also reads the values that PX4's hash leaves out: their announcements may have
been lost."""
RETRY_INTERVAL: Final = 5.0
"""Seconds until the next check after one without an answer."""


class SyncState(StrEnum):
    """The relation of a component's table to the vehicle's."""

    UNSYNCED = "unsynced"
    """Never fetched on this link, or changed since by some sign."""
    SYNCED = "synced"
    """Fetched, without a sign of change since."""
    CHECKING = "checking"
    """The vehicle was lost or has restarted, or a sign of change was seen: the table is being checked."""
    LOST = "lost"
    """The component is lost."""


@dataclass(eq=False, repr=False)
class Watch:
    """Keeps one table in sync, once it was fetched.

    Args:
        session, presence: the component's.
        resynced: called with the names that had changed, after a check that a sign of change has caused, or
            that found one.
        interval: seconds between two checks of an idle table; None: 30 for a vehicle that confirms tables, no
            checks of others; 0 for none.
        policy: any but AUTO disables the checks.

    Attributes:
        confirmed_at: when the table was last known to be the vehicle's; minus infinity before.
    """

    session: Session
    presence: Presence
    resynced: Callable[[tuple[str, ...]], None]
    interval: float | None = None
    policy: Policy = Policy.AUTO

    def __post_init__(self) -> None:
        self.confirmed_at = -math.inf
        self._is_fetched = False
        self._is_doubted = False
        self._before: Mapping[str, Param] = {}  # the table at the first sign of change
        self._is_due = False  # a sign of change was seen since the last check began
        self._is_asked = False  # somebody wants to know
        self._signal = anyio.Event()
        self._holds = 0

    @property
    def state(self) -> SyncState:
        """The present state."""
        if self.presence.is_lost:
            return SyncState.LOST
        if not self._is_fetched:
            return SyncState.UNSYNCED
        return SyncState.CHECKING if self._is_doubted else SyncState.SYNCED

    def fetched(self) -> None:
        """Take note of a complete fetch."""
        self._is_fetched = True
        self._is_doubted = self._is_due = False
        self.confirmed_at = anyio.current_time()
        self._signal.set()

    def check(self, *, older_than: float) -> None:
        """Check soon whether the table is current, if the vehicle confirms tables and did not so recently."""
        is_old = anyio.current_time() - self.confirmed_at > older_than
        if is_old and self._is_fetched and may_confirm(self.session):
            self._is_due = self._is_asked = True
            self._signal.set()

    def unconfirmed(self) -> None:
        """Take note that the table is only what the cache has."""
        self._is_fetched = False

    @contextmanager
    def held(self) -> Iterator[None]:
        """Begin no check during the block: its owner reads the table itself."""
        self._holds += 1
        try:
            yield
        finally:
            self._holds -= 1

    def doubt(self) -> None:
        """Check the table soon, where the policy allows it: there is a sign of change."""
        if self._is_fetched and self.policy is not Policy.AUTO:
            self.session.table.doubt()
            self._is_fetched = False
        elif self._is_fetched:
            if not self._is_doubted:
                self._before = dict(self.session.table.params)
            self._is_doubted = self._is_due = True
            self._signal.set()

    async def run(self) -> None:
        """Check until cancelled.

        Raises:
            LinkError: the link is closed for good.
        """
        while True:
            self._signal = anyio.Event()
            if self._is_due:
                self._signal.set()
            with anyio.move_on_after(None if math.isinf(self._wait) else self._wait) as interval:
                await self._signal.wait()
                await anyio.sleep(SETTLING_TIME)
            if not self._is_due and not interval.cancelled_caught:
                continue
            self._is_due = not self._may_check  # it comes as soon as it may
            if self._is_due:
                await anyio.sleep(SETTLING_TIME)
                continue
            try:
                await self._check()
            except (NoReply, LinkError):
                with self.session.channel.gate.until_closed():
                    await anyio.sleep(RETRY_INTERVAL)
                self._is_due = True

    @property
    def _wait(self) -> float:
        """Seconds until the next check without a sign of change."""
        if self.interval is not None:
            return self.interval or math.inf
        return INTERVAL_DEFAULT if self.policy is Policy.AUTO and may_confirm(self.session) else math.inf

    @property
    def _may_check(self) -> bool:
        is_allowed = self.policy is Policy.AUTO and self._is_fetched and not self.presence.is_lost
        is_armed = (self.presence.base_mode or 0) & MAV_MODE_FLAG_SAFETY_ARMED
        is_wanted = self._is_doubted or self._is_asked or not is_armed
        session = self.session
        is_busy = session.fetching.is_running or session.channel.ftp.locked() or bool(session.writing)
        return is_allowed and is_wanted and not is_busy and not self._holds

    async def _check(self) -> None:
        """Ask whether the table is current, and fetch it where the vehicle does not say so."""
        session, table = self.session, self.session.table
        was_doubted, self._is_asked = self._is_doubted, False
        before = self._before if was_doubted else dict(table.params)
        answer = await ask(session)
        may_fetch = was_doubted or answer.is_other or (self.interval is not None and not may_confirm(session))
        if answer.reason and not may_fetch:
            return  # another station's file is open, for example
        if not answer.is_current:
            self._before, self._is_doubted = before, True
            if answer.is_other or answer.digest is not None:
                table.doubt(*table.names.values())
        is_open = not answer.is_current or any(each.trust is Trust.CACHED for each in table.params.values())
        if is_open and not (await fetch_all(session, refresh=not answer.is_current)).complete:
            return
        if answer.digest is not None:
            await read_many(session, [key for key in table.volatile if is_stale(session, key, OUTSIDE_AGE)])
        self._is_doubted = False
        self.confirmed_at = anyio.current_time()
        changed = differing(before, table.params)
        if was_doubted or changed:
            self.resynced(changed)
