"""The peers of a component: several paths to one vehicle, or several vehicles that contest its address.

The text of the warning is `errors.ContestedAddress`; `client.event_dispatch` logs it. `protocol.component`
refuses requests while an address is contested.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import Final, Protocol

from paramclient.errors import ContestedAddress
from paramclient.protocol.addresses import Peer
from paramclient.protocol.requests.retry import PEER_RECHECKS, PEER_REQUESTS
from paramclient.protocol.vehicle.commands import message_requests
from paramclient.protocol.vehicle.peer_claims import Claim, PeerRelation, compare, compare_in_turn
from paramclient.protocol.vehicle.presence import LOST_AFTER, Presence
from paramclient.protocol.wire import (
    AUTOPILOT_VERSION_ID,
    SYSTEM_TIME_ID,
    Message,
)

__all__ = ["NO_PEER", "ComponentPeers", "Contest", "PeersHost"]

CLAIMS_MAX: Final = 8
"""Further peers that are followed for one component. Others are ignored until one of these has been silent
for the heartbeat timeout."""
REVIEW_INTERVAL: Final = 0.25
"""Seconds between two reviews of the peers of a component with several."""
UID_GRACE: Final = 0.25
"""Seconds in which the peer with the address may still send its hardware id after another one was faster:
over two paths to one vehicle the same message arrives twice."""
PATH_SILENCE: Final = 1.5
"""Seconds of silence after which requests use another path to the same vehicle: a heartbeat was lost."""
RESTART_SILENCE: Final = 1.5
"""Seconds of silence after which the address goes to a peer with the same hardware id and a later boot: a
vehicle that returns from another port."""
COMMANDED_SILENCE: Final = 0.5
"""The same while a reboot on command is awaited, which verifies the vehicle anyway."""
RESTART_SLACK: Final = 1.0
"""Seconds by which a boot may seem earlier than the last message of the run before."""
NO_PEER: Final = object()
"""A peer that sends nothing."""


@dataclass(frozen=True, slots=True)
class Contest:
    """Why it is open which vehicle a component belongs to.

    Attributes:
        system, component: its address.
        claimants: the peers with the address and their vehicles, as text.
        difference: the difference between them, as text.
    """

    system: int
    component: int
    claimants: tuple[str, ...]
    difference: str

    @property
    def error(self) -> ContestedAddress:
        """The error of requests to the component meanwhile; a new object each time."""
        return ContestedAddress(self.system, self.component, self.claimants, self.difference)


class PeersHost(Protocol):
    """The part of a component that `ComponentPeers` uses."""

    @property
    def presence(self) -> Presence:
        """Its presence."""

    @property
    def is_rebooting(self) -> bool:
        """Whether a reboot on command is in progress."""

    @abstractmethod
    def send_to(self, message: Message, peer: Peer) -> None:
        """Send a message to one of the peers."""

    @property
    def is_identified(self) -> bool:
        """Whether its identity is settled and not being requested."""

    @abstractmethod
    def reschedule(self) -> None:
        """Take that `next_deadline` has changed."""

    @abstractmethod
    def read_clock(self, now: float) -> None:
        """Have clocks in telemetry read for a while."""

    @abstractmethod
    def home_changed(self, claim: Claim, now: float, verdict: PeerRelation) -> None:
        """Take another peer as the one with the address; the verdict is that of `compare_in_turn`."""

    @abstractmethod
    def contest_began(self, contest: Contest, now: float) -> None:
        """Take that several vehicles use the address."""

    @abstractmethod
    def contest_ended(self, claim: Claim, now: float, *, is_same: bool) -> None:
        """Take that one vehicle uses the address; `is_same` for the one before the contest, by peer and kind
        or by id."""


class ComponentPeers:
    """Decides whose messages count for a component, and to which peer its requests go.

    The first peer has the address, until another one sends a hardware id first. Messages of a further peer
    count only once it is proven to be a path to the same vehicle: by autopilot, vehicle type, hardware id and
    boot time, which are requested from it. A silent peer loses the address to an active one: to the same
    vehicle by its hardware id, or, if that is requested without success, to another vehicle. Two active peers
    that are not proven to be one vehicle contest the address, and so do several vehicles that send through
    one peer.

    Args:
        target: the component.
        host: the component.
        may_ask: whether requests may be sent.

    Attributes:
        home: the peer with the address; NO_PEER before the first, or after the end of its connection.
        has_left: whether that connection has ended: nothing may be sent until another peer has the address.
        speaker: the peer whose messages count without a check: `home`, except during a contest.
        received_at: when the last message of `home` was received.
        contest: why the address is contested, or None.
        ignored_messages: messages of other peers that were ignored.
    """

    def __init__(self, target: tuple[int, int], host: PeersHost, *, may_ask: bool) -> None:
        self._target = target
        self._host = host
        self._may_ask = may_ask
        self.home: Peer = NO_PEER
        self.has_left = False
        self.speaker: Peer = NO_PEER
        self.received_at = -math.inf
        self.contest: Contest | None = None
        self.ignored_messages = 0
        self._home_claim: Claim | None = None
        self._others: dict[Peer, Claim] = {}
        self._look_at = math.inf
        self._began_as: tuple[Claim, tuple[int, int] | None] | None = None  # None where values are mixed

    @property
    def is_unclear(self) -> bool:
        """Whether it is open which vehicle is active: nothing received meanwhile may be kept."""
        home_claim = self._home_claim
        return (
            self.contest is not None
            or (home_claim is not None and (home_claim.is_unsettled or home_claim.is_mixed))
            or self.is_home_unproven
        )

    @property
    def is_home_unproven(self) -> bool:
        """Whether the peer with the address has sent no hardware id, and a further peer may be the vehicle.

        Another program may have been received first, and pretend to be the vehicle. Nothing is written to it
        until the further peer is proven to be a path to the same vehicle, or contests the address.
        """
        home_claim = self._home_claim
        return (
            home_claim is not None
            and not home_claim.uid.current
            and any(
                claim.verdict is PeerRelation.OPEN and not claim.is_by_satellite
                for claim in self._others.values()
            )
        )

    def is_rival(self, peer: Peer) -> bool:
        """Return whether a peer also sends for the component without being proven the same vehicle."""
        claim = self._others.get(peer)
        return claim is not None and claim.verdict is not PeerRelation.SAME

    def accepts(self, peer: Peer, now: float) -> bool:
        """Return whether to accept a message that cannot distinguish vehicles, such as PARAM_VALUE."""
        self._home_claim_or(peer, now)
        if peer == self.home:
            self.received_at = now
            return self.contest is None
        if self._look_at <= now:
            self._review(now)
        return self._is_path(self._claim_of(peer, now))

    def accepts_identifying(self, message: Message, peer: Peer, now: float) -> bool:
        """Record a message that may distinguish vehicles; return whether to accept it."""
        home_claim = self._home_claim_or(peer, now)
        claim = home_claim if peer == self.home else self._claim_of(peer, now)
        if claim is None:
            return self._is_path(None)
        claim.take(message, now, self._heartbeat_timeout)
        if claim is not home_claim:
            self._review(now)
            return self._is_path(claim)
        self.received_at = claim.received_at = now
        if claim.is_unsettled or claim.is_mixed:
            self._review(now)
        return self.contest is None

    def accepts_clock(self, message_id: int, boot_ms: int, peer: Peer, now: float) -> bool:
        """Record the time since boot in telemetry; return whether to accept it."""
        is_taken = self.accepts(peer, now)
        claim = self._home_claim if peer == self.home else self._others.get(peer)
        if claim is not None:
            claim.take_clock(message_id, boot_ms, now)
            if claim is self._home_claim and claim.is_mixed and self.contest is None:
                self._review(now)
        return is_taken and self.contest is None

    @property
    def wants_clocks(self) -> bool:
        """Whether clocks in telemetry may show that two peers are one vehicle."""
        return any(claim.verdict is PeerRelation.OPEN for claim in self._others.values())

    def follow(self, peer: Peer) -> None:
        """Accept the messages of this peer in any case: those of ground stations do not matter."""
        self.home = self.speaker = peer
        self.has_left = False
        self._home_claim = None

    def left(self, peer: Peer, now: float) -> None:
        """Process the end of a peer's connection."""
        self._others.pop(peer, None)
        if peer == self.home:
            self.home = self.speaker = NO_PEER
            self.has_left = True
            self._look_at = min(self._look_at, now)
            self._host.reschedule()

    def forget(self) -> None:
        """Forget all peers: the link is down, and has other peers after the reconnection."""
        self._others.clear()
        self.home, self.speaker, self._home_claim = NO_PEER, NO_PEER, None
        self.has_left = False

    def age(self, seconds: float) -> None:
        """Move all moments back by time that the clock left out."""
        self.received_at -= seconds
        for claim in (self._home_claim, *self._others.values()):
            if claim is not None:
                claim.age(seconds)

    def tick(self, now: float) -> None:
        """Do what is due."""
        if self._look_at <= now:
            self._review(now)

    def next_deadline(self) -> float:
        """Return when `tick` is due, or infinity."""
        return self._look_at

    # private

    @property
    def _heartbeat_timeout(self) -> float:
        timeout = self._host.presence.heartbeat_timeout
        return timeout if timeout < math.inf else LOST_AFTER

    def _home_claim_or(self, peer: Peer, now: float) -> Claim:
        """Return the claim of the peer with the address; the first peer gets the address."""
        if self._home_claim is None:
            self._settle_at(claim := self._others.pop(peer, None) or Claim(peer, now))
            return claim
        return self._home_claim

    def _claim_of(self, peer: Peer, now: float) -> Claim | None:
        """Return the claim of a further peer; None where there are too many."""
        claim = self._others.get(peer)
        if claim is None:
            if len(self._others) >= CLAIMS_MAX:
                return None
            claim = self._others[peer] = Claim(peer, now)
            self._look_at = now
            self._host.reschedule()
        claim.received_at = now
        return claim

    def _is_path(self, claim: Claim | None) -> bool:
        """Return whether to accept a message of a further peer; count it otherwise."""
        is_known = claim is not None and (claim.verdict is PeerRelation.SAME or claim is self._home_claim)
        is_taken = is_known and self.contest is None
        self.ignored_messages += not is_taken
        return is_taken

    def _review(self, now: float) -> None:
        """Review the peers: active and silent ones, proven paths, contests."""
        timeout = self._heartbeat_timeout
        self._others = {p: each for p, each in self._others.items() if now - each.received_at < timeout}
        home_claim = self._home_claim
        if home_claim is not None:
            home_claim.settle(now, timeout)
            if home_claim.uid.is_unsettled:
                self._ask_again(home_claim, now)
        difference = ""
        for claim in list(self._others.values()):
            difference = self._judge(claim, now) or difference
        self._follow_id(now)
        self._move_on(now)
        self._decide(difference, now)
        is_settled = not self._others and not self.is_unclear
        self._look_at = math.inf if is_settled else now + REVIEW_INTERVAL
        self._host.reschedule()

    def _judge(self, claim: Claim, now: float) -> str:
        """Compare a further peer with the one that has the address; return the difference as text."""
        home_claim = self._home_claim
        if home_claim is None:
            return ""
        is_over = claim.verdict is PeerRelation.OTHER or self._is_over(claim, now)
        claim.verdict, difference = compare(home_claim, claim, is_over=is_over, may_ask=self._may_ask)
        is_otherwise_equal = claim.kind.current == home_claim.kind.current and claim.uid.current in (
            None,
            home_claim.uid.current,
        )
        is_unproven = claim.verdict is PeerRelation.OPEN or (
            claim.verdict is PeerRelation.OTHER and is_otherwise_equal
        )
        if (
            is_unproven
            and self._may_ask
            and now >= claim.requested_at + PEER_REQUESTS.pause_after(claim.requests)
        ):
            claim.requests += 1
            self._ask(claim, now)
            self._host.read_clock(now)
            is_here = self.home is not NO_PEER
            if is_here and self._host.is_identified:  # otherwise ambiguous acknowledgements
                self._request(home_claim, SYSTEM_TIME_ID)
                if claim.uid.current and home_claim.uid.current is None:  # its responses may have been lost
                    self._request(home_claim, AUTOPILOT_VERSION_ID)
        return difference if claim.verdict is PeerRelation.OTHER else ""

    def _is_over(self, claim: Claim, now: float) -> bool:
        """Return whether everything was done to identify a further peer."""
        if not self._may_ask:
            return now >= claim.first_at + PEER_REQUESTS.duration
        return PEER_REQUESTS.is_over(claim.requests, claim.requested_at, now)

    def _decide(self, difference: str, now: float) -> None:
        """Begin a contest, or end it."""
        home_claim = self._home_claim
        is_mixed = home_claim is not None and home_claim.is_mixed
        is_here = (
            home_claim is not None and not self.has_left and now - self.received_at < self._heartbeat_timeout
        )
        rivals = [
            each
            for each in self._others.values()
            if each.verdict is PeerRelation.OTHER
            and is_here
            and self.received_at > each.first_at
            and not (
                each.is_by_satellite
                and home_claim is not None
                and each.kind.current == home_claim.kind.current
            )
        ]
        if self.contest is None and (is_mixed or rivals):
            assert home_claim is not None
            claimants = tuple(each.in_words() for each in (home_claim, *rivals))
            if is_mixed:
                difference = "one peer says both in turn"
            self.contest = Contest(*self._target, claimants, difference)
            self.speaker = NO_PEER
            self._began_as = None if is_mixed else (home_claim, home_claim.kind.current)
            self._host.contest_began(self.contest, now)
        elif self.contest is not None:
            if is_mixed:
                self._began_as = None
            elif not rivals and is_here:
                assert home_claim is not None
                self.contest = None
                self.speaker = self.home
                is_same = self._began_as is not None and (
                    (home_claim, home_claim.kind.current) == self._began_as
                    or self._in_turn(self._began_as[0], home_claim) is PeerRelation.SAME
                )
                self._host.contest_ended(home_claim, now, is_same=is_same)

    def _follow_id(self, now: float) -> None:
        """Give the address to a peer that has sent a hardware id first: requests go to it."""
        home_claim = self._home_claim
        if (
            home_claim is None
            or home_claim.uid.current
            or self._host.is_identified
            or self.contest is not None
        ):
            return
        for claim in self._others.values():
            if claim.uid.current and now >= claim.version_at + UID_GRACE:
                self._swap(claim, now)
                return

    def _move_on(self, now: float) -> None:
        """Give the address to an active peer, where the one that has it is silent."""
        home_claim = self._home_claim
        if home_claim is None:
            return
        silence = math.inf if self.has_left and self.contest is None else now - self.received_at
        for claim in sorted(self._others.values(), key=_preference):
            if claim.received_at < self.received_at:
                continue
            if claim.verdict is PeerRelation.SAME and self.contest is None:
                if silence >= PATH_SILENCE:
                    self._swap(claim, now, is_proven=True)
                    return
            elif silence >= self._silence_before(claim) and not self._awaits_id(claim, now):
                self._swap(claim, now)
                return

    def _awaits_id(self, claim: Claim, now: float) -> bool:
        """Return whether the hardware id of the silent vehicle is still being requested from a further
        peer."""
        home_claim = self._home_claim
        is_over = self._is_over(claim, now) and not self._host.is_rebooting
        if home_claim is None or self.contest is not None or is_over:
            return False
        return self._hides_id(home_claim, claim) and self._in_turn(home_claim, claim) is PeerRelation.OPEN

    @staticmethod
    def _hides_id(before: Claim, claim: Claim) -> bool:
        """Return whether a peer has sent no hardware id, unlike the one before it."""
        return bool(before.uid.current) and claim.uid.current is None

    def _silence_before(self, claim: Claim) -> float:
        """Return the seconds of silence of the peer with the address after which this one gets it."""
        if self.contest is not None or self._home_claim is None:
            return self._heartbeat_timeout
        usual = self._host.presence.gap
        if claim.kind.current != self._home_claim.kind.current:
            return usual
        if self._host.is_rebooting:
            return COMMANDED_SILENCE
        uids = {claim.uid.current, self._home_claim.uid.current}
        has_started = claim.started_at >= self.received_at - RESTART_SLACK
        return RESTART_SILENCE if len(uids) == 1 and has_started and claim.uid.current else usual

    def _swap(self, claim: Claim, now: float, *, is_proven: bool = False) -> None:
        """Give the address to a further peer."""
        before = self._home_claim
        assert before is not None, "it has the address"
        del self._others[claim.peer]
        if is_proven and not self.has_left:
            before.received_at, before.verdict = self.received_at, PeerRelation.SAME
            self._others[before.peer] = before
        for each in self._others.values():
            each.verdict = each.verdict if is_proven else PeerRelation.OPEN
        self._settle_at(claim)
        if is_proven or self.contest is not None:
            return
        verdict = self._in_turn(before, claim)
        if verdict is PeerRelation.OPEN and self._hides_id(before, claim):
            verdict = PeerRelation.OTHER  # requested without success
        self._host.home_changed(claim, now, verdict)

    def _settle_at(self, claim: Claim) -> None:
        self.home, self._home_claim = claim.peer, claim
        self.has_left = False
        self.received_at = claim.received_at
        self.speaker = self.home if self.contest is None else NO_PEER

    def _in_turn(self, before: Claim, claim: Claim) -> PeerRelation:
        return compare_in_turn(before, claim, may_ask=self._may_ask)

    def _ask(self, claim: Claim, now: float) -> None:
        """Request identity and boot time from a peer."""
        claim.requested_at = now
        if claim.uid.current is None:
            self._request(claim, AUTOPILOT_VERSION_ID, also_otherwise=claim.requests > 1)
        self._request(claim, SYSTEM_TIME_ID)

    def _ask_again(self, claim: Claim, now: float) -> None:
        """Request the hardware id of the peer with the address, which has just sent two."""
        if self._may_ask and now >= claim.requested_at + PEER_RECHECKS.later:
            claim.requested_at = now
            self._request(claim, AUTOPILOT_VERSION_ID)

    def _request(self, claim: Claim, message_id: int, *, also_otherwise: bool = False) -> None:
        """Request a message from a peer, also with the other commands for it if requested."""
        ways = message_requests(self._target, message_id)
        for message in ways if also_otherwise else ways[:1]:
            self._host.send_to(message, claim.peer)


def _preference(claim: Claim) -> tuple[bool, float]:
    """Return the sort key: proven paths first, then the latest message."""
    return claim.verdict is not PeerRelation.SAME, -claim.received_at
