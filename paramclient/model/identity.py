"""Vehicle identity: hardware id, system id, link, firmware, and the cache key made of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from paramclient.errors import UsageError

PX4_SITL_UID: Final = "4954414c44494e4f"
"""The hardware id of PX4's SITL and of `sim:px4` with system id 1 (measured). With system id N, SITL adds
N - 1 to it and to the first byte of `uid2`, whose other bytes are zero (measured; AUTOPILOT_VERSION in PX4's
mavlink_main.cpp). It is not the id of any hardware: it follows the system id."""
_SITL_SYSTEMS_MAX = 255
_UID_DIGITS = 16
_UID2_DIGITS = 36

_AGAINST_NON_FINITE = {
    "px4": "PX4 cannot save NaN and infinity: its parameter file becomes invalid, it saves nothing any more, "
    "and it may stop, also after each restart, until the file is deleted",
    "ardupilot": "ArduPilot ignores NaN and infinity, and does not answer",
}
_NO_AUTOPILOT = 8
"""MAV_AUTOPILOT_INVALID, in the heartbeat of a camera, a gimbal or another payload."""
_AUTOPILOTS = {0: "generic", 3: "ardupilot", _NO_AUTOPILOT: "no autopilot", 12: "px4"}
_BRANDS = {3: "ArduPilot", 12: "PX4"}
_FIRMWARE_TYPES = ((255, ""), (192, "-rc"), (128, "-beta"), (64, "-alpha"), (0, "-dev"))
"""The types of a firmware by the lowest byte of flight_sw_version from which on they apply
(FIRMWARE_VERSION_TYPE in common.xml)."""
_HEX_DIGITS = frozenset(b"0123456789abcdefABCDEF")


@dataclass(frozen=True, slots=True)
class Identity:
    """One vehicle, as its heartbeat and AUTOPILOT_VERSION describe it.

    Attributes:
        system: system id, 1 to 255. Other vehicles may use the same system id.
        link: the canonical name of the link on which the vehicle was heard.
        uid: the hardware id in hexadecimal, or None while unknown.
        autopilot: MAV_AUTOPILOT of the heartbeat.
        vehicle_type: MAV_TYPE of the heartbeat.
        firmware: flight_sw_version; 0 while unknown, like the following attributes.
        git_hash: the commit of the firmware (see `commit_text`); "" while unknown.
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

    @property
    def key(self) -> str:
        """The key of the vehicle's tables in the cache.

        `uid:<hex>` with a hardware id, followed by the system id if several vehicles share the hardware id.
        Without a hardware id, `system:<n>@<link>`, which is unique only while no other vehicle uses the same
        system id on the same link.
        """
        if self.uid == PX4_SITL_UID:
            return f"uid:{self.uid}/{self.system}"
        if self.uid is not None:
            return f"uid:{self.uid}"
        return f"system:{self.system}@{self.link}"

    @property
    def has_own_uid(self) -> bool:
        """Whether the hardware id is known and unique to this vehicle, also under another system id."""
        return self.uid is not None and not is_sitl_uid(self.uid)

    def is_same_vehicle(self, other: Identity) -> bool:
        """Return whether `other`, with the same or another system id, is this vehicle.

        Compares the hardware ids. Without one, or with one of PX4's SITL, which follows the system id,
        compares link, autopilot and vehicle type as well.
        """
        if self.has_own_uid:
            return other.uid == self.uid
        mine, others = ((each.link, each.autopilot, each.vehicle_type) for each in (self, other))
        return mine == others and (self.uid is None or is_sitl_uid(other.uid))

    def __str__(self) -> str:
        if self.uid is not None:
            return f"the {autopilot_name(self.autopilot)} {self.uid}"
        return f"a vehicle of type {self.vehicle_type} with {autopilot_name(self.autopilot)}"


def check_ids(system: int | None, component: int | None, least: int = 0) -> None:
    """Raise UsageError for ids that no component has; `least` is the smallest component id."""
    for number, low in ((system, 1), (component, least)):
        if number is not None and number not in range(low, 256):
            raise UsageError(f"system ids are 1 to 255, component ids {least} to 255, not {number!r}")


def is_sitl_uid(uid: str | None) -> bool:
    """Return whether a hardware id is one that PX4's SITL makes of its system id; see `PX4_SITL_UID`."""
    if uid is None or len(uid) == _UID2_DIGITS:
        return uid is not None and uid[2:].count("0") == _UID2_DIGITS - 2
    return len(uid) == _UID_DIGITS and 0 <= int(uid, 16) - int(PX4_SITL_UID, 16) < _SITL_SYSTEMS_MAX


def hardware_id(uid: int, uid2: bytes) -> str | None:
    """Return the hardware id of an AUTOPILOT_VERSION in hexadecimal; None if the message has none.

    Args:
        uid: the older hardware id, 64 bits; used if `uid2` is all zero.
        uid2: the hardware id, 18 bytes.
    """
    return uid2.hex() if any(uid2) else f"{uid:016x}" if uid else None


def commit_text(git_hash: bytes) -> str:
    """Return flight_custom_version as the commit, with as many digits as the vehicle sends.

    ArduPilot writes the hash as text, PX4 as a little-endian number (both measured).
    """
    commit = git_hash.rstrip(b"\0")
    return commit.decode("ascii") if _HEX_DIGITS.issuperset(commit) else git_hash[::-1].hex()


def has_autopilot(autopilot: int) -> bool:
    """Return whether a MAV_AUTOPILOT names an autopilot, and not that there is none."""
    return autopilot != _NO_AUTOPILOT


def autopilot_name(number: int) -> str:
    """Return the name of a MAV_AUTOPILOT: px4, ardupilot, generic, …; others as `autopilot <number>`."""
    return _AUTOPILOTS.get(number, f"autopilot {number}")


def reason_against_non_finite(autopilot: str) -> str:
    """Return why NaN and infinity must not be sent to an autopilot, given by name; "" if they may be."""
    return _AGAINST_NON_FINITE.get(autopilot, "")


def version_text(firmware: int) -> str:
    """Return a flight_sw_version as text: `4.6.0`, or `4.6.0-beta` if it is no official release."""
    number = ".".join(str(firmware >> shift & 0xFF) for shift in (24, 16, 8))
    kind = next(name for lowest, name in _FIRMWARE_TYPES if firmware & 0xFF >= lowest)
    return f"{number}{kind}"


def version_difference(file: Identity, vehicle: Identity) -> str:
    """Return the sentence that names the firmware versions of a file and a vehicle, if both are known.

    "" if they are the same version, or one is unknown.
    """
    own, other = version_text(file.firmware), version_text(vehicle.firmware)
    if 0 in (file.firmware, vehicle.firmware) or own == other:
        return ""
    return f"the file is of {_BRANDS.get(file.autopilot, 'version')} {own}, the vehicle has {other}"
