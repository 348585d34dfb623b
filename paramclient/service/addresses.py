"""Addresses of clients: which belong to this computer, and which belong together."""

from __future__ import annotations

from ipaddress import IPv4Address, IPv6Address, ip_address

__all__ = ["is_loopback", "network_of", "parsed"]


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
