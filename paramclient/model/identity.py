"""Who a vehicle is: what tells it apart from others, today and in the next session."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

__all__ = ["SHARED_UIDS", "Identity", "autopilot_name", "hardware_id", "reason_against_non_finite"]

SHARED_UIDS: Final = frozenset({"4954414c44494e4f"})
"""Hardware ids that name no single vehicle: every simulated PX4 reports this one (measured). Their system ids
tell them apart, as PX4 numbers the simulated vehicles on one machine."""

_AGAINST_NON_FINITE = {
    "px4": "PX4 cannot save NaN and infinity: its parameter file becomes invalid, it saves nothing any more, "
    "and it may stop, also after each restart, until the file is deleted",
    "ardupilot": "ArduPilot ignores NaN and infinity, and does not answer",
}
_AUTOPILOTS = {0: "generic", 3: "ardupilot", 8: "no autopilot", 12: "px4"}
_HEX_DIGITS = frozenset(b"0123456789abcdefABCDEF")


@dataclass(frozen=True, slots=True)
class Identity:
    """One vehicle, as its heartbeat and AUTOPILOT_VERSION describe it.

    Attributes:
        system: system id, 1 to 255. Other vehicles use the same one all the time.
        link: the canonical name of the link it was heard on.
        uid: its hardware id in hexadecimal, or None while it has given none.
        autopilot: MAV_AUTOPILOT of its heartbeat.
        vehicle_type: MAV_TYPE of its heartbeat.
        firmware: flight_sw_version; 0 while unknown, as everything below.
        git_hash: the firmware's commit, as far as it is given; "" while unknown.
        board: board_version.
        vendor_id, product_id: of the board.
        capabilities: MAV_PROTOCOL_CAPABILITY bits.
    """

    system: int
    link: str
    uid: str | None = None
    autopilot: int = 0
    vehicle_type: int = 0
    firmware: int = 0
    git_hash: str = ""
    board: int = 0
    vendor_id: int = 0
    product_id: int = 0
    capabilities: int = 0

    @classmethod
    def from_version(
        cls,
        *,
        system: int,
        link: str,
        autopilot: int,
        vehicle_type: int,
        uid: int = 0,
        uid2: bytes = b"",
        firmware: int = 0,
        git_hash: bytes = b"",
        board: int = 0,
        vendor_id: int = 0,
        product_id: int = 0,
        capabilities: int = 0,
    ) -> Identity:
        """Build it from the fields of AUTOPILOT_VERSION as they stand in the message.

        Args:
            uid: the older hardware id, 64 bits; it counts where `uid2` is all zero.
            uid2: the hardware id, 18 bytes.
            git_hash: flight_custom_version, 8 bytes: ArduPilot writes the hash as text, PX4 as a
                little-endian number (both measured).
        """
        hardware = hardware_id(uid, uid2)
        commit = git_hash.rstrip(b"\0")
        if not _HEX_DIGITS.issuperset(commit):
            commit = git_hash[::-1].hex().encode()
        return cls(
            system=system,
            link=link,
            uid=hardware,
            autopilot=autopilot,
            vehicle_type=vehicle_type,
            firmware=firmware,
            git_hash=commit.decode("ascii"),
            board=board,
            vendor_id=vendor_id,
            product_id=product_id,
            capabilities=capabilities,
        )

    @property
    def key(self) -> str:
        """The name under which its tables are kept.

        `uid:<hex>` where there is a hardware id, with the system id behind it for one that many have; else
        `system:<n>@<link>`, which holds only as long as no other vehicle comes to the same link with the
        same system id.
        """
        if self.uid in SHARED_UIDS:
            return f"uid:{self.uid}/{self.system}"
        if self.uid is not None:
            return f"uid:{self.uid}"
        return f"system:{self.system}@{self.link}"

    @property
    def has_own_uid(self) -> bool:
        """Whether its hardware id names it alone."""
        return self.uid is not None and self.uid not in SHARED_UIDS

    def is_same_vehicle(self, other: Identity) -> bool:
        """Whether what was heard as `other`, under this or another system id, is this vehicle.

        The hardware id decides. Where there is none, or one that many have, as far as can be told: the same
        link, autopilot and vehicle type.
        """
        if self.has_own_uid:
            return other.uid == self.uid
        mine, others = ((each.link, each.autopilot, each.vehicle_type) for each in (self, other))
        return mine == others and (self.uid is None or other.uid == self.uid)

    def __str__(self) -> str:
        if self.uid is not None:
            return f"the {autopilot_name(self.autopilot)} {self.uid}"
        return f"a vehicle of type {self.vehicle_type} with {autopilot_name(self.autopilot)}"


def hardware_id(uid: int, uid2: bytes) -> str | None:
    """The hardware id of an AUTOPILOT_VERSION in hexadecimal; None where it gives none.

    Args:
        uid: the older one, 64 bits; it counts where `uid2` is all zero.
        uid2: the hardware id, 18 bytes.
    """
    return uid2.hex() if any(uid2) else f"{uid:016x}" if uid else None


def autopilot_name(number: int) -> str:
    """A MAV_AUTOPILOT in a word: px4, ardupilot, generic, …; others by their number."""
    return _AUTOPILOTS.get(number, f"autopilot {number}")


def reason_against_non_finite(autopilot: str) -> str:
    """Return why an autopilot, by its name, must not be sent NaN and infinity; "" where it may be."""
    return _AGAINST_NON_FINITE.get(autopilot, "")
