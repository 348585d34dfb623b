"""The only vehicle on a link, for a write without a full address, and what to say where none was heard.

Every autopilot sends a heartbeat once a second (MAVLink's heartbeat protocol). A vehicle is the only one when
no other was heard for `HEARTBEAT_WAIT` after it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

from paramclient.errors import AmbiguousVehicle
from paramclient.model.names import counted, first_of
from paramclient.protocol.addresses import peer_in_words
from paramclient.protocol.identity import HEARTBEAT_WAIT, kind_in_words
from paramclient.protocol.node import Node
from paramclient.protocol.station import Station
from paramclient.wire.messages import AUTOPILOT_COMPONENT, MAV_AUTOPILOT_INVALID, MAV_TYPE_GCS

LISTED_MAX: Final = 8
"""Components that a hint names, so that it stays readable; it gives the number of further ones."""
_PERIPHERALS: Final = frozenset({18, 26, 27, *range(30, 35), *range(36, 43), 44, 48, 49})
"""MAV_TYPE of the parts of a vehicle: computers, gimbals, cameras, batteries, GPS receivers, radios. Some of
them name an autopilot in their heartbeat, where they should name none."""
PERIPHERAL_IDS_MIN: Final = 100
"""The first component id that MAVLink gives to parts of a vehicle: MAV_COMP_ID_CAMERA."""
_CAUSES: Final = {
    "udpin": " Is the vehicle sending to this port?",
    "udpout": " Is the address right, and does the vehicle listen there?",
    "tcp": " Does the other end send MAVLink?",
    "tcpin": " Has the vehicle connected?",
    "serial": " Check the cable and the baud rate.",
}
"""Likely causes of a silent link, by the first part of its name."""


def find(nodes: Iterable[Node], system: int | None, component: int | None, peer: str | None) -> Node | None:
    """Return the first component that an address fits: without a component the autopilot; None before one."""
    fitting = [each for each in nodes if system in (None, each.system) and _is_at(each, peer)]
    if component is not None:
        return next((each for each in fitting if each.component == component), None)
    found = autopilots_of(fitting)
    return found[0] if found else None


def autopilots_of(nodes: Iterable[Node]) -> list[Node]:
    """Return the autopilot of each vehicle, component 1 before others, in the order of their first messages.

    Lost ones are left out while another autopilot is heard. Peripherals that claim to be one are none. A
    component 1 that claims to be none is one in a system without another.
    """
    first: dict[object, Node] = {}
    for each in _autopilots(nodes):
        key = (each.system, each.peer if each.is_split else None)
        if key not in first or each.component == AUTOPILOT_COMPONENT != first[key].component:
            first[key] = each
    return list(first.values())


def vehicle_of(nodes: Iterable[Node], node: Node) -> Node:
    """Return the autopilot of a component's vehicle, whose identity is the vehicle's; without one, itself."""
    same = [each for each in nodes if each.system == node.system]
    near = [each for each in same if each.peer == node.peer] if node.is_split else same
    return next(iter(autopilots_of(near)), node)


def only_vehicle(
    nodes: Iterable[Node], system: int | None, component: int | None, now: float, *, listening_since: float
) -> Node | float | None:
    """Return the only component that an address fits, or when that may be certain; None before one is heard.

    Lost components do not count. With a system id, component 1 is the autopilot if it is one. With both ids,
    the component is certain after its first message.

    Raises:
        AmbiguousVehicle: the address fits several vehicles.
    """
    fitting = [each for each in nodes if system in (None, each.system) and not each.presence.is_lost]
    vehicles = autopilots_of(fitting)
    if component is None:
        found = _autopilots(fitting)
        if system is not None:
            found = [each for each in found if each.component == AUTOPILOT_COMPONENT] or found
    else:
        found = [each for each in fitting if each.component == component]
        by_system = {each.system: each for each in [*found, *vehicles]}
        vehicles = [*by_system.values()] if system is None else found
    if len(vehicles) > 1 or len(found) > 1:
        raise _ambiguous(vehicles if len(vehicles) > 1 else found)
    if not found:
        return None
    is_usual = system is not None and (component is not None or found[0].component == AUTOPILOT_COMPONENT)
    due = max(min(each.since for each in vehicles), listening_since) + HEARTBEAT_WAIT
    if now >= due or (is_usual and not found[0].is_split):
        return found[0]
    return due


def node_in_words(node: Node) -> str:
    """Return address, autopilot and kind of vehicle: `1/1 PX4 quadrotor`."""
    kind = kind_in_words(node.identification.autopilot, node.identification.vehicle_type)
    return f"{node.channel} {kind}".rstrip()


def hint_of_link(station: Station, bytes_received: int) -> str:
    """Return what was received on a link so far, where an awaited component was not."""
    link = station.link
    cause = _CAUSES.get(link.partition(":")[0], "")
    if not station.gate.is_open:
        return f"{link} is down at present."
    nodes = sorted(station.nodes.values(), key=lambda each: (each.system, each.component))
    if (beat := station.broadcaster) is not None and beat.type not in (MAV_TYPE_GCS, *_PERIPHERALS):
        words = kind_in_words(beat.autopilot, beat.type)
        return (
            f"A vehicle with system id 0 is heard on {link} ({words or 'of no kind'}): 0 addresses all. "
            "Give it an id from 1 to 255 (MAV_SYS_ID of PX4, SYSID_THISMAV of ArduPilot)."
        )
    if nodes:
        listed = first_of([node_in_words(each) for each in nodes], LISTED_MAX)
        if all(each.identification.vehicle_type == MAV_TYPE_GCS for each in nodes):
            return f"Heard on {link} so far: only {listed}, and no vehicle.{cause}"
        unnamed = "" if _autopilots(nodes) else " None is an autopilot: name one by system and component id."
        return f"Heard on {link} so far: {listed}.{unnamed}"
    if station.frames:
        return f"{counted(station.frames, 'MAVLink frame')} arrived on {link}, but no heartbeat."
    if bytes_received:
        return f"{bytes_received:,} bytes arrived on {link}, but no valid MAVLink frame."
    return f"Nothing was received on {link}.{cause}"


def hint_of_node(station: Station, node: Node, now: float) -> str:
    """Return what was received while a component did not answer requests; "" where none are sent."""
    if station.listens_only:
        return ""
    if not station.gate.is_open:
        return f"{station.link} is down at present."
    label, silence = str(node.channel), now - node.presence.received_at
    if node.presence.is_lost or silence > HEARTBEAT_WAIT:
        return f"Nothing was received of {label} for {silence:.1f} s."
    does = f"{label} sends messages (the last one {silence:.1f} s ago)"
    others = [
        str(each.channel)
        for each in station.nodes.values()
        if each.system == node.system and each.plain.table.moments and not each.presence.has_beaten
    ]
    if others and not node.plain.table.moments:
        return f"{does}, but no values; values came from {first_of(others, LISTED_MAX)}, which may be meant."
    if node.channel.timing.round_trip is not None:
        return f"{does} and answered other requests: it may not support this one, or packets may be lost."
    hint = "Check the link towards the vehicle, and whether the vehicle requires signed messages."
    return f"{does} and answers no request: requests do not reach it, or it ignores them. {hint}"


def _autopilots(nodes: Iterable[Node]) -> list[Node]:
    """Return all autopilots; lost ones only if there is no other."""
    vehicles = [each for each in nodes if not _is_peripheral(each)]
    found = [each for each in vehicles if each.identification.is_autopilot]
    systems = {each.system for each in found}
    found += [
        each
        for each in vehicles
        if each.system not in systems
        and (each.component, each.identification.autopilot) == (AUTOPILOT_COMPONENT, MAV_AUTOPILOT_INVALID)
        and each.identification.has_parameters
    ]
    return [each for each in found if not each.presence.is_lost] or found


def _ambiguous(nodes: Sequence[Node]) -> AmbiguousVehicle:
    splits = len({each.system for each in nodes}) < len(nodes)
    words = [
        node_in_words(each) + (f" at {peer_in_words(each.peer)}" if each.is_split else "")
        for each in sorted(nodes, key=lambda each: (each.system, each.component))
    ]
    choose_by = "system" if not splits else "peer" if nodes[0].is_split else "component"
    kind = f"autopilots in system {nodes[0].system}" if choose_by == "component" else "vehicles"
    what = f"{len(nodes)} {kind} on this link: {', '.join(words)}."
    return AmbiguousVehicle(what, vehicles=words, choose_by=choose_by)


def _is_at(node: Node, peer: str | None) -> bool:
    words = peer_in_words(node.peer)
    return peer in (None, words, words.rpartition(":")[0])


def _is_peripheral(node: Node) -> bool:
    return node.component >= PERIPHERAL_IDS_MIN or node.identification.vehicle_type in _PERIPHERALS


def address_in_words(system: int | None, component: int | None, peer: str | None = None) -> str:
    """Return the component that a call waits for, for messages."""
    at = "" if peer is None else f" at {peer}"
    if component is None:
        return f"an autopilot{at}" if system is None else f"an autopilot with system id {system}{at}"
    return f"component {'*' if system is None else system}/{component}{at}"
