"""Which peers speak for a component: paths to one vehicle, or several vehicles that contest its address."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import Final, Protocol

from paramclient.errors import ContestedAddress
from paramclient.protocol.addresses import Peer
from paramclient.protocol.vehicle.claims import Claim, Verdict, compare, compare_in_turn
from paramclient.protocol.vehicle.presence import LOST_AFTER, Presence
from paramclient.protocol.wire import (
    AUTOPILOT_VERSION_ID,
    MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES,
    MAV_CMD_REQUEST_MESSAGE,
    SYSTEM_TIME_ID,
    CommandLong,
    Message,
)

__all__ = ["NO_PEER", "ComponentPeers", "Contest", "Host"]

CLAIMS_MAX: Final = 8
"""Further peers that are followed for one component. Those above it are not heard until one of these has been
silent for the heartbeat timeout."""
ASKS_MAX: Final = 4
ASK_PAUSES: Final = (0.5, 1.0, 1.5, 2.0)
"""How often a further peer is asked who it is, and the seconds after each time: 5 s in all, in which a radio
with a round trip of 1 s that loses every second message answers three times out of four."""
LATER_PAUSE: Final = 5.0
"""Seconds between further questions to a peer that contests the address and has told nothing that differs:
its radio may have been deaf. No more often than that, as it may also be a stranger."""
JUDGING_TIME: Final = sum(ASK_PAUSES)
"""Seconds until a further peer must have shown who it is where nothing can be asked."""
LOOK_PACE: Final = 0.25
"""Seconds between two looks at the peers of a component that has several."""
RECHECK_PACE: Final = 1.0
"""Seconds between two requests for the hardware id of a peer that has just given two different ones."""
FIRST_GRACE: Final = 0.25
"""Seconds for which the peer with the address may still give its hardware id where another one was quicker:
over two paths to one vehicle the same message comes twice."""
PATH_SILENCE: Final = 1.5
"""Seconds of silence after which requests go to another path to the same vehicle: a heartbeat was lost."""
RESTART_SILENCE: Final = 1.5
"""Seconds of silence after which a peer gets the address that gives the same hardware id and has started
since: a vehicle that comes back from another port."""
COMMANDED_SILENCE: Final = 0.5
"""The same while a restart on command is awaited, which itself makes sure that it is the same vehicle."""
RESTART_SLACK: Final = 1.0
"""Seconds by which a start may seem to lie before the last word of the run before."""
NO_PEER: Final = object()
"""A peer that nothing comes from."""


@dataclass(frozen=True, slots=True)
class Contest:
    """Why it is open which vehicle a component belongs to.

    Attributes:
        system, component: its address.
        claimants: the peers with the address, in words, and what each says.
        difference: what tells them apart, in words.
    """

    system: int
    component: int
    claimants: tuple[str, ...]
    difference: str

    @property
    def error(self) -> ContestedAddress:
        """The error of what is asked of the component meanwhile; another object each time."""
        return ContestedAddress(self.system, self.component, self.claimants, self.difference)


class Host(Protocol):
    """The component that the peers speak for, as `ComponentPeers` needs it."""

    @property
    def presence(self) -> Presence:
        """Whether it is there."""

    @property
    def is_restarting(self) -> bool:
        """Whether it was told to start again, and that is awaited."""

    @abstractmethod
    def send_to(self, message: Message, peer: Peer) -> None:
        """Send a message to one of the peers."""

    @property
    def is_identified(self) -> bool:
        """Whether it is settled who it is, and that is not being asked for."""

    @abstractmethod
    def read_clock(self, now: float) -> None:
        """Have clocks in telemetry read for a while."""

    @abstractmethod
    def peer_moved(self, claim: Claim, now: float, verdict: Verdict) -> None:
        """Another peer has the address now; the verdict is that of `compare_in_turn`."""

    @abstractmethod
    def contest_began(self, contest: Contest, now: float) -> None:
        """Several vehicles have the address."""

    @abstractmethod
    def contest_ended(self, claim: Claim, now: float, *, is_same: bool) -> None:
        """One vehicle has the address; `is_same` where it is the one of before, by peer and kind or by id."""


class ComponentPeers:
    """Judges whose messages are taken for a component, and where requests for it go.

    The first peer that was heard has the address, until another one gives a hardware id first. Messages of a
    further peer are not taken before it is proven to be a path to the same vehicle: by autopilot, vehicle
    type, hardware id and boot time, for which it is asked. A peer that has fallen silent loses the address to
    one that speaks: to the same vehicle by its hardware id, or, where it does not give that when it is asked,
    to another one. Two peers that speak and are not proven to be one vehicle contest it, and so do several
    vehicles that speak through one peer.

    Args:
        target: the component.
        host: the component.
        may_ask: whether anything may be sent.

    Attributes:
        home: the peer that has the address; NO_PEER before one was heard, or after its connection has ended.
        has_left: whether that has ended: nothing may be sent until another one has the address.
        speaker: the peer whose messages may be taken without another look: `home`, but for a contest.
        heard_at: when the home was heard last.
        contest: why the address is contested, or None.
        foreign: messages that were not taken, as they came from another peer.
    """

    def __init__(self, target: tuple[int, int], host: Host, *, may_ask: bool) -> None:
        self._target = target
        self._host = host
        self._may_ask = may_ask
        self.home: Peer = NO_PEER
        self.has_left = False
        self.speaker: Peer = NO_PEER
        self.heard_at = -math.inf
        self.contest: Contest | None = None
        self.foreign = 0
        self._mine: Claim | None = None
        self._others: dict[Peer, Claim] = {}
        self._look_at = math.inf
        self._began_as: tuple[Claim, tuple[int, int] | None] | None = None  # None where values are mixed

    @property
    def is_unclear(self) -> bool:
        """Whether it is open which vehicle speaks: nothing may be kept that came meanwhile."""
        mine = self._mine
        return self.contest is not None or (mine is not None and (mine.is_moving or mine.is_mixed))

    def is_rival(self, peer: Peer) -> bool:
        """Whether a peer speaks for the component too, and is not proven to be the same vehicle."""
        claim = self._others.get(peer)
        return claim is not None and claim.verdict is not Verdict.SAME

    def takes(self, peer: Peer, now: float) -> bool:
        """Whether a message without anything to tell vehicles apart may be taken, such as PARAM_VALUE."""
        self._mine_or(peer, now)
        if peer == self.home:
            self.heard_at = now
            return self.contest is None
        if self._look_at <= now:
            self._review(now)
        return self._is_path(self._claim_of(peer, now))

    def hears(self, message: Message, peer: Peer, now: float) -> bool:
        """Take note of a message that may tell vehicles apart; return whether it may be taken."""
        mine = self._mine_or(peer, now)
        claim = mine if peer == self.home else self._claim_of(peer, now)
        if claim is None:
            return self._is_path(None)
        claim.take(message, now, self._timeout)
        if claim is not mine:
            self._review(now)
            return self._is_path(claim)
        self.heard_at = claim.heard_at = now
        if claim.is_moving or claim.is_mixed:
            self._review(now)
        return self.contest is None

    def hears_clock(self, message_id: int, boot_ms: int, peer: Peer, now: float) -> bool:
        """Take note of the time since boot in telemetry; return whether it may be taken."""
        is_taken = self.takes(peer, now)
        claim = self._mine if peer == self.home else self._others.get(peer)
        if claim is not None:
            claim.take_clock(message_id, boot_ms, now)
            if claim is self._mine and claim.is_mixed and self.contest is None:
                self._review(now)
        return is_taken and self.contest is None

    @property
    def wants_clocks(self) -> bool:
        """Whether clocks in telemetry tell whether two peers are one vehicle."""
        return any(claim.verdict is Verdict.OPEN for claim in self._others.values())

    def follow(self, peer: Peer) -> None:
        """Take the messages of this peer whatever it is: those of ground stations are of no account."""
        self.home = self.speaker = peer
        self.has_left = False
        self._mine = None

    def left(self, peer: Peer, now: float) -> None:
        """The connection of a peer has ended."""
        self._others.pop(peer, None)
        if peer == self.home:
            self.home = self.speaker = NO_PEER
            self.has_left = True
            self._look_at = min(self._look_at, now)

    def forget(self) -> None:
        """The link is away: the one that comes back has others."""
        self._others.clear()
        self.home, self.speaker, self._mine = NO_PEER, NO_PEER, None
        self.has_left = False

    def age(self, seconds: float) -> None:
        """So much time has passed that the clock did not count."""
        self.heard_at -= seconds
        for claim in (self._mine, *self._others.values()):
            if claim is not None:
                claim.age(seconds)

    def tick(self, now: float) -> None:
        """Do what is due."""
        if self._look_at <= now:
            self._review(now)

    def next_deadline(self) -> float:
        """When `tick` has something to do, or infinity."""
        return self._look_at

    # private

    @property
    def _timeout(self) -> float:
        patience = self._host.presence.patience
        return patience if patience < math.inf else LOST_AFTER

    def _mine_or(self, peer: Peer, now: float) -> Claim:
        """What the peer with the address says; where none has had it yet, this one gets it."""
        if self._mine is None:
            self._settle_at(claim := self._others.pop(peer, None) or Claim(peer, now))
            return claim
        return self._mine

    def _claim_of(self, peer: Peer, now: float) -> Claim | None:
        """What a further peer says; None where there are too many of them."""
        claim = self._others.get(peer)
        if claim is None:
            if len(self._others) >= CLAIMS_MAX:
                return None
            claim = self._others[peer] = Claim(peer, now)
            self._look_at = now
        claim.heard_at = now
        return claim

    def _is_path(self, claim: Claim | None) -> bool:
        """Whether a message of a further peer may be taken; one that may not is counted."""
        is_known = claim is not None and (claim.verdict is Verdict.SAME or claim is self._mine)
        is_taken = is_known and self.contest is None
        self.foreign += not is_taken
        return is_taken

    def _review(self, now: float) -> None:
        """See who speaks, who is silent, and who is proven to be whom."""
        timeout = self._timeout
        self._others = {p: each for p, each in self._others.items() if now - each.heard_at < timeout}
        mine = self._mine
        if mine is not None:
            mine.settle(now, timeout)
            if mine.uid.is_moving:
                self._ask_again(mine, now)
        difference = ""
        for claim in list(self._others.values()):
            difference = self._judge(claim, now) or difference
        self._follow_id(now)
        self._move_on(now)
        self._decide(difference, now)
        is_settled = not self._others and not self.is_unclear
        self._look_at = math.inf if is_settled else now + LOOK_PACE

    def _judge(self, claim: Claim, now: float) -> str:
        """Compare a further peer with the one that has the address; in words what tells them apart."""
        mine = self._mine
        if mine is None:
            return ""
        is_over = claim.verdict is Verdict.OTHER or self._is_over(claim, now)
        claim.verdict, difference = compare(mine, claim, is_over=is_over, may_ask=self._may_ask)
        tells_nothing_else = claim.kind.current == mine.kind.current and claim.uid.current in (
            None,
            mine.uid.current,
        )
        is_unproven = claim.verdict is Verdict.OPEN or (claim.verdict is Verdict.OTHER and tells_nothing_else)
        if is_unproven and self._may_ask and now >= claim.asked_at + _pause_after(claim.asks):
            claim.asks += 1
            self._ask(claim, now)
            self._host.read_clock(now)
            is_here = self.home is not NO_PEER
            if is_here and self._host.is_identified:  # else an acknowledgement would be another request's
                self._request(mine, SYSTEM_TIME_ID)
        return difference if claim.verdict is Verdict.OTHER else ""

    def _is_over(self, claim: Claim, now: float) -> bool:
        """Whether everything was done to learn who a further peer is."""
        if not self._may_ask:
            return now >= claim.first_at + JUDGING_TIME
        has_had_all = claim.asks == ASKS_MAX and now >= claim.asked_at + ASK_PAUSES[-1]
        return claim.asks > ASKS_MAX or has_had_all

    def _decide(self, difference: str, now: float) -> None:
        """Begin a contest, or end it."""
        mine = self._mine
        is_mixed = mine is not None and mine.is_mixed
        is_here = mine is not None and not self.has_left and now - self.heard_at < self._timeout
        rivals = [
            each
            for each in self._others.values()
            if each.verdict is Verdict.OTHER
            and is_here
            and self.heard_at > each.first_at
            and not (each.is_by_satellite and mine is not None and each.kind.current == mine.kind.current)
        ]
        if self.contest is None and (is_mixed or rivals):
            assert mine is not None
            claimants = tuple(each.in_words() for each in (mine, *rivals))
            if is_mixed:
                difference = "one peer says both in turn"
            self.contest = Contest(*self._target, claimants, difference)
            self.speaker = NO_PEER
            self._began_as = None if is_mixed else (mine, mine.kind.current)
            self._host.contest_began(self.contest, now)
        elif self.contest is not None:
            if is_mixed:
                self._began_as = None
            elif not rivals and is_here:
                assert mine is not None
                self.contest = None
                self.speaker = self.home
                is_same = self._began_as is not None and (
                    (mine, mine.kind.current) == self._began_as
                    or self._in_turn(self._began_as[0], mine) is Verdict.SAME
                )
                self._host.contest_ended(mine, now, is_same=is_same)

    def _follow_id(self, now: float) -> None:
        """Give the address to a peer that has given a hardware id before the one that has it: to that go the
        requests.
        """
        mine = self._mine
        if mine is None or mine.uid.current or self._host.is_identified or self.contest is not None:
            return
        for claim in self._others.values():
            if claim.uid.current and now >= claim.version_at + FIRST_GRACE:
                self._swap(claim, now)
                return

    def _move_on(self, now: float) -> None:
        """Give the address to a peer that speaks, where the one that has it is silent."""
        mine = self._mine
        if mine is None:
            return
        silence = math.inf if self.has_left and self.contest is None else now - self.heard_at
        for claim in sorted(self._others.values(), key=_preference):
            if claim.heard_at < self.heard_at:
                continue
            if claim.verdict is Verdict.SAME and self.contest is None:
                if silence >= PATH_SILENCE:
                    self._swap(claim, now, is_proven=True)
                    return
            elif silence >= self._silence_before(claim) and not self._awaits_id(claim, now):
                self._swap(claim, now)
                return

    def _awaits_id(self, claim: Claim, now: float) -> bool:
        """Whether a further peer is still being asked for the hardware id of the vehicle that is silent."""
        mine = self._mine
        is_over = self._is_over(claim, now) and not self._host.is_restarting
        if mine is None or self.contest is not None or is_over:
            return False
        return self._hides_id(mine, claim) and self._in_turn(mine, claim) is Verdict.OPEN

    @staticmethod
    def _hides_id(before: Claim, claim: Claim) -> bool:
        """Whether a peer has not given a hardware id, and the one before it has."""
        return bool(before.uid.current) and claim.uid.current is None

    def _silence_before(self, claim: Claim) -> float:
        """Seconds for which the peer with the address must have been silent for this one to have it."""
        if self.contest is not None or self._mine is None:
            return self._timeout
        usual = self._host.presence.gap
        if claim.kind.current != self._mine.kind.current:
            return usual
        if self._host.is_restarting:
            return COMMANDED_SILENCE
        uids = {claim.uid.current, self._mine.uid.current}
        has_started = claim.started_at >= self.heard_at - RESTART_SLACK
        return RESTART_SILENCE if len(uids) == 1 and has_started and claim.uid.current else usual

    def _swap(self, claim: Claim, now: float, *, is_proven: bool = False) -> None:
        """Let a further peer have the address."""
        before = self._mine
        assert before is not None, "it has the address"
        del self._others[claim.peer]
        if is_proven and not self.has_left:
            before.heard_at, before.verdict = self.heard_at, Verdict.SAME
            self._others[before.peer] = before
        for each in self._others.values():
            each.verdict = each.verdict if is_proven else Verdict.OPEN
        self._settle_at(claim)
        if is_proven or self.contest is not None:
            return
        verdict = self._in_turn(before, claim)
        if verdict is Verdict.OPEN and self._hides_id(before, claim):
            verdict = Verdict.OTHER  # it was asked in vain
        self._host.peer_moved(claim, now, verdict)

    def _settle_at(self, claim: Claim) -> None:
        self.home, self._mine = claim.peer, claim
        self.has_left = False
        self.heard_at = claim.heard_at
        self.speaker = self.home if self.contest is None else NO_PEER

    def _in_turn(self, before: Claim, claim: Claim) -> Verdict:
        return compare_in_turn(before, claim, may_ask=self._may_ask)

    def _ask(self, claim: Claim, now: float) -> None:
        """Ask a peer who it is, and when it has started."""
        claim.asked_at = now
        if claim.uid.current is None:
            self._request(claim, AUTOPILOT_VERSION_ID)
            if claim.asks > 1:
                ask = CommandLong(*self._target, MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, (1.0, *[0.0] * 6))
                self._host.send_to(ask, claim.peer)
        self._request(claim, SYSTEM_TIME_ID)

    def _ask_again(self, claim: Claim, now: float) -> None:
        """Ask the peer that has the address for its hardware id, of which it has just given two."""
        if self._may_ask and now >= claim.asked_at + RECHECK_PACE:
            claim.asked_at = now
            self._request(claim, AUTOPILOT_VERSION_ID)

    def _request(self, claim: Claim, message_id: int) -> None:
        command = CommandLong(*self._target, MAV_CMD_REQUEST_MESSAGE, (float(message_id), *[0.0] * 6))
        self._host.send_to(command, claim.peer)


def _pause_after(asks: int) -> float:
    """Seconds from a question to the next one, by how many there were."""
    return 0.0 if not asks else ASK_PAUSES[asks - 1] if asks < ASKS_MAX else LATER_PAUSE


def _preference(claim: Claim) -> tuple[bool, float]:
    """Proven paths first, then whoever spoke last."""
    return claim.verdict is not Verdict.SAME, -claim.heard_at
