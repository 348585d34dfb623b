"""Addresses: system and component, and the peer where components are distinguished by peer."""

from __future__ import annotations

from collections.abc import Hashable
from itertools import pairwise
from typing import TypeAlias

Address: TypeAlias = tuple[int, int]
"""System and component."""
Peer: TypeAlias = Hashable
"""The sender of received bytes, as the link distinguishes senders."""


class PeerAddress(tuple[int, int]):
    """A component's address behind one peer: not equal to that behind another peer, nor to the bare ids.

    Attributes:
        peer: the peer.
    """

    peer: Peer

    def __new__(cls, system: int, component: int, peer: Peer) -> PeerAddress:
        address = super().__new__(cls, (system, component))
        address.peer = peer
        return address

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PeerAddress) and tuple.__eq__(self, other) and self.peer == other.peer

    def __ne__(self, other: object) -> bool:
        return not self == other

    def __hash__(self) -> int:
        return hash((*self, self.peer))

    def __repr__(self) -> str:
        return f"{self[0]}/{self[1]} at {peer_in_words(self.peer)}"


def peer_in_words(peer: Peer) -> str:
    """Return a peer as text: `127.0.0.1:14550` for an address of a link."""
    if isinstance(peer, tuple):
        for host, port in pairwise(peer):
            if isinstance(host, str) and isinstance(port, int):
                return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
    return str(peer)
