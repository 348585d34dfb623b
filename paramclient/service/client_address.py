"""IP addresses of clients: loopback, networks, and clients behind trusted proxies."""

from __future__ import annotations

import re
from collections.abc import Iterable
from ipaddress import IPv4Address, IPv4Network, IPv6Address, IPv6Network, ip_address, ip_network
from typing import Final, TypeAlias

from paramclient.errors import UsageError

__all__ = [
    "Network",
    "client_behind",
    "parse_forwarded",
    "is_in_networks",
    "is_loopback",
    "parse_network",
    "client_network",
    "parse_address",
]

Network: TypeAlias = IPv4Network | IPv6Network


def parse_address(text: str) -> IPv4Address | IPv6Address | None:
    """Parse an IP address without its zone; None for any other text.

    An IPv4-mapped IPv6 address is returned as the IPv4 address.
    """
    try:
        address = ip_address(text.partition("%")[0])
    except ValueError:
        return None
    mapped = address.ipv4_mapped if isinstance(address, IPv6Address) else None
    return mapped or address


def is_loopback(text: str) -> bool:
    """Return whether an address is a loopback address."""
    address = parse_address(text)
    return address is not None and address.is_loopback


def client_network(text: str) -> str:
    """Return the network that counts as one client: an IPv4 address, or the 64-bit network of an IPv6
    address.

    One computer can have all addresses of such a network (RFC 4291, section 2.5.1).
    """
    address = parse_address(text)
    if isinstance(address, IPv6Address) and not address.is_loopback:
        return f"{IPv6Address(address.packed[:8] + bytes(8))}/64"
    return text if address is None else str(address)


def parse_network(text: str) -> Network:
    """Parse an address or a network such as `10.0.0.0/8`.

    Raises:
        UsageError: the text is neither.
    """
    try:
        return ip_network(text)
    except ValueError as error:
        raise UsageError(
            f"{text!r:.100} is not an address or a network such as 10.0.0.0/8: {error}"
        ) from None


def is_in_networks(text: str, networks: Iterable[Network]) -> bool:
    """Return whether an address belongs to one of the networks."""
    address = parse_address(text)
    return address is not None and any(address in each for each in networks)


def parse_forwarded(values: Iterable[str]) -> list[str]:
    """Return the addresses in X-Forwarded-For or Forwarded headers (RFC 7239), in their order.

    A comma always ends an entry, so that a quotation mark sent by a client hides nothing that its proxy
    adds.
    """
    entries = [entry.strip() for value in values for entry in value.split(",")]
    return [_bare(entry) for entry in entries]


def client_behind(proxies: Iterable[Network], peer: str, forwarded: list[str]) -> str:
    """Return the client behind proxies: the last address that is not a trusted proxy.

    Args:
        proxies: the trusted proxies.
        peer: address of the connection, a trusted proxy.
        forwarded: the forwarded addresses, the last one added by the peer.

    An invalid address ends the search: the client is then the proxy that added it.
    """
    proxies = tuple(proxies)
    client = peer
    for entry in reversed(forwarded):
        address = parse_address(entry)
        if address is None:
            break
        client = str(address)
        if not is_in_networks(client, proxies):
            break
    return client


def _bare(entry: str) -> str:
    """Return the address in an entry, without quotation marks, brackets and port."""
    found = _FOR.search(entry)
    text = (found[1] if found else entry).strip().strip('"')
    with_port = _WITH_PORT.fullmatch(text)
    return (with_port[1] or with_port[2]) if with_port else text


_FOR: Final = re.compile(r"(?:^|;)\s*for\s*=\s*([^;]*)", re.IGNORECASE)
_WITH_PORT: Final = re.compile(r"\[([^\]]*)\](?::[0-9]{1,5})?|([^:]*):[0-9]{1,5}")
