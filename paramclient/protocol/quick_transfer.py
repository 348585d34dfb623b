"""Whether a file of 0.1 MB may be read from a vehicle without a request of the user."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from paramclient.protocol.params.fetch_result import Policy
from paramclient.protocol.wire import CAPABILITY_FTP, MAV_MODE_FLAG_SAFETY_ARMED

if TYPE_CHECKING:
    from paramclient.protocol.component import ComponentMachine
    from paramclient.protocol.station import Station

__all__ = ["obstacle_to_quick_transfer"]

QUICK_GAP_MAX: Final = 0.005
"""Seconds between two values of the list, above which the link is slow: PX4 sends one each 1 ms on UDP and
USB, and each 6.7 ms on a serial port; a 57600-baud radio carries one each 25 ms."""
QUICK_ROUND_TRIP_MAX: Final = 0.2
"""Seconds of the shortest round trip, above which the link is slow (a busy computer makes others longer): the
request, and opening and closing two files, take 7 round trips, which leave less than a third of 2 s."""


def obstacle_to_quick_transfer(station: Station, machine: ComponentMachine) -> str | None:
    """Return why no file of 0.1 MB is read from a component without a request of the user; None if it may be.

    The reason is half a sentence without measured values, such as `the vehicle is armed`. It may vanish.

    Args:
        station: the link.
        machine: the component.
    """
    presence, round_trip = machine.presence, machine.round_trip
    traffic = station.traffic
    if station.listens_only:
        return "the client only listens"
    if station.policy is not Policy.AUTO:
        return f"the policy is {station.policy}"
    if not machine.identity.capabilities:
        return "the vehicle has not reported its capabilities"
    if not machine.identity.capabilities & CAPABILITY_FTP:
        return "the vehicle does not announce MAVFTP"
    if presence.is_lost or machine.peers.contest is not None:
        return "the vehicle is lost" if presence.is_lost else "several vehicles use its address"
    if presence.base_mode is not None and presence.base_mode & MAV_MODE_FLAG_SAFETY_ARMED:
        return "the vehicle is armed"
    if presence.is_high_latency:
        return "the vehicle is in high-latency mode"
    if traffic is not None and traffic.has_radio:
        return "a telemetry radio is on the link"
    if machine.reads.pace.gap > QUICK_GAP_MAX:
        return f"the link is slow: its list arrived at less than {1.0 / QUICK_GAP_MAX:.0f} values/s"
    if round_trip.samples and round_trip.shortest > QUICK_ROUND_TRIP_MAX:
        return f"the link is slow: a round trip takes more than {QUICK_ROUND_TRIP_MAX:g} s"
    return None
