"""Addresses of clients: of this computer, of one network, and behind a proxy that is trusted."""

from __future__ import annotations

import re
from collections.abc import Iterable
from ipaddress import IPv4Address, IPv4Network, IPv6Address, IPv6Network, ip_address, ip_network
from typing import Final, TypeAlias

from paramclient.errors import UsageError

__all__ = [
    "Network",
    "first_beyond",
    "forwarded_for",
    "is_in",
    "is_loopback",
    "network",
    "network_of",
    "parsed",
]

Network: TypeAlias = IPv4Network | IPv6Network


def parsed(text: str) -> IPv4Address | IPv6Address | None:
    """The address that a text is, without its zone; one of IPv4 that is mapped into IPv6 is that of IPv4.

    None for anything else.
    """
    try:
        address = ip_address(text.partition("%")[0])
    except ValueError:
        return None
    mapped = address.ipv4_mapped if isinstance(address, IPv6Address) else None
    return mapped or address


def is_loopback(text: str) -> bool:
    """Whether an address is one of this computer's loopback addresses."""
    address = parsed(text)
    return address is not None and address.is_loopback


def network_of(text: str) -> str:
    """The client that an address stands for: an address of IPv4, and of IPv6 a network of 64 bits.

    One machine can have all addresses of such a network (RFC 4291, section 2.5.1).
    """
    address = parsed(text)
    if isinstance(address, IPv6Address) and not address.is_loopback:
        return f"{IPv6Address(address.packed[:8] + bytes(8))}/64"
    return text if address is None else str(address)


def network(text: str) -> Network:
    """The network that a text names: an address, or `10.0.0.0/8`.

    Raises:
        UsageError: it names none.
    """
    try:
        return ip_network(text)
    except ValueError as error:
        raise UsageError(f"{text!r:.100} is no address and no network such as 10.0.0.0/8: {error}") from None


def is_in(text: str, networks: Iterable[Network]) -> bool:
    """Whether an address belongs to one of the networks."""
    address = parsed(text)
    return address is not None and any(address in each for each in networks)


def forwarded_for(values: Iterable[str]) -> list[str]:
    """The addresses in X-Forwarded-For headers, or in Forwarded headers (RFC 7239), in their order.

    A comma always ends an entry, so a quotation mark that a client opens hides nothing that its proxy adds.
    """
    entries = [entry.strip() for value in values for entry in value.split(",")]
    return [_bare(entry) for entry in entries]


def first_beyond(proxies: Iterable[Network], peer: str, told: list[str]) -> str:
    """The client that proxies tell of: the last address that is not that of a trusted proxy.

    Args:
        proxies: those that are trusted.
        peer: whoever has connected, one of them.
        told: the addresses that were told, the last one by the peer.

    What is no address ends the search: the client is then the proxy that told it.
    """
    proxies = tuple(proxies)
    client = peer
    for entry in reversed(told):
        address = parsed(entry)
        if address is None:
            break
        client = str(address)
        if not is_in(client, proxies):
            break
    return client


def _bare(entry: str) -> str:
    """The address in an entry, without quotation marks, brackets and port."""
    found = _FOR.search(entry)
    text = (found[1] if found else entry).strip().strip('"')
    with_port = _WITH_PORT.fullmatch(text)
    return (with_port[1] or with_port[2]) if with_port else text


_FOR: Final = re.compile(r"(?:^|;)\s*for\s*=\s*([^;]*)", re.IGNORECASE)
_WITH_PORT: Final = re.compile(r"\[([^\]]*)\](?::[0-9]{1,5})?|([^:]*):[0-9]{1,5}")
