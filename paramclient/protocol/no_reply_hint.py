"""The hint of a `NoReply`: what was heard on a link meanwhile, in sentences for users."""

from __future__ import annotations

import math
from typing import Final

from paramclient.model.wording import counted, first_of
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.station import Station
from paramclient.protocol.vehicle.kinds import kind_in_words
from paramclient.protocol.wire import MAV_TYPE_GCS

__all__ = ["hint_of_component", "hint_of_link"]

LISTED_MAX: Final = 5
"""Components that a message lists; it gives the number of further ones."""

_CAUSES: Final = {
    "udpin": " Is the vehicle sending to this port?",
    "udpout": " Is the vehicle listening at this address?",
    "tcp": " Does the vehicle send MAVLink on this port?",
    "tcpin": " Has the vehicle connected to this port?",
    "serial": " Check the cable and the baud rate.",
}
"""Likely causes of a silent link, by the first part of its name."""


def hint_of_link(station: Station, link: str) -> str:
    """Return what was received on a link so far, where an awaited component was not.

    Args:
        station: the station of the link.
        link: name of the link.
    """
    cause = _CAUSES.get(link.partition(":")[0], "")
    if station.listening_since == math.inf:
        return f"{link} is down at present."
    machines = list(station.components.values())
    known = {(machine.system, machine.component) for machine in machines}
    words = [_in_words(machine) for machine in sorted(machines, key=_order)]
    for system, component in sorted(station.senders - known):
        is_ours = (system, component) == station.own_address
        what = "with the ids of this client" if is_ours else "without heartbeat"
        words.append(f"{system}/{component} {what}")
    if words:
        listed = first_of(words, LISTED_MAX)
        if station.senders <= {*known, station.own_address} and all(map(_is_ground_station, machines)):
            return f"Heard on {link} so far: only {listed}, and no vehicle.{cause}"
        return f"Heard on {link} so far: {listed}."
    frames = station.framing[0]
    if frames:
        were = "was" if frames == 1 else "were"
        return f"{counted(frames, 'MAVLink frame')} {were} received on {link}, but no heartbeat."
    if station.bytes_received:
        cause = cause if link.startswith("serial:") else ""
        return f"{station.bytes_received:,} bytes were received on {link}, but no valid MAVLink frame.{cause}"
    return f"Nothing was received on {link}.{cause}"


def hint_of_component(station: Station, machine: ComponentMachine, since: float, now: float) -> str:
    """Return what was received while a component did not answer requests; "" for a client that sends none.

    Args:
        station: the station of the link.
        machine: the component.
        since: when the first request was sent.
        now: the time.
    """
    if station.listens_only:
        return ""
    label, presence = f"{machine.system}/{machine.component}", machine.presence
    if station.listening_since == math.inf:
        return f"{station.link} is down at present."
    is_silent = presence.is_lost or presence.is_overdue(now)
    if is_silent or (not presence.has_beaten and presence.received_at < since):
        silence = f"for {now - presence.received_at:.1f} s"
        others = [
            each
            for each in station.components.values()
            if each is not machine and each.presence.received_at > max(since, presence.received_at)
        ]
        if not others:
            return f"Nothing was received on {station.link} {silence}."
        words = [_in_words(each) for each in sorted(others, key=_order)]
        return (
            f"{label} has sent nothing {silence}; heard meanwhile on {station.link}: only "
            f"{first_of(words, LISTED_MAX)}."
        )
    if presence.has_beaten:
        does = f"{label} sends heartbeats (the last one {now - presence.beat_at:.1f} s ago)"
    else:
        does = f"{label} sends messages (the last one {now - presence.received_at:.1f} s ago)"
    if machine.round_trip.smoothed is not None:
        return f"{does} and answered other requests: the link may lose packets, or the vehicle is busy."
    return (
        f"{does} and answers no request: requests do not reach it, or it ignores them. Check the link "
        "towards the vehicle, and whether the vehicle requires signed messages."
    )


def _in_words(machine: ComponentMachine) -> str:
    """Return address and kind of a component: `255/190 ground station`."""
    kind = kind_in_words(machine.identification.autopilot, machine.identification.vehicle_type)
    return f"{machine.system}/{machine.component} {kind}".rstrip()


def _is_ground_station(machine: ComponentMachine) -> bool:
    return machine.identification.vehicle_type == MAV_TYPE_GCS


def _order(machine: ComponentMachine) -> tuple[int, int]:
    return machine.system, machine.component
