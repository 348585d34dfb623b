"""The only vehicle on the links, for a write without a full address.

Every autopilot sends a heartbeat once a second (MAVLink's heartbeat protocol). A vehicle is the only one when
no other was heard for `LOOK_TIME` after it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Final

from paramclient.errors import AmbiguousVehicle
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.vehicle.kinds import kind_in_words
from paramclient.protocol.wire import AUTOPILOT_COMPONENT, MAV_AUTOPILOT_GENERIC

__all__ = ["LOOK_TIME", "VehicleChoice", "vehicle_in_words"]

LOOK_TIME: Final = 1.2
"""Seconds after the first autopilot in which a second one is looked for: the interval of heartbeats, and a
fifth of it for jitter."""

_PERIPHERALS: Final = frozenset({18, 26, 27, *range(30, 35), *range(36, 43), 44, 48})
"""MAV_TYPE of the parts of a vehicle: onboard computers, gimbals, cameras, batteries, GPS receivers. Some of
them name the generic autopilot in their heartbeat, where they should name none."""


class VehicleChoice:
    """Finds the only vehicle that an incomplete address fits.

    Lost components do not count. With a system id, component 1 is the autopilot if it is one: MAVLink's
    address of the autopilot.

    Args:
        system, component: the given parts of the address.
        spans_links: whether the components are those of several links, which may have equal addresses.
        splits_peers: whether they are those of several peers, which may have equal addresses too.

    Attributes:
        due: when to look again, also if nothing was received; infinity before the first vehicle.
    """

    def __init__(
        self,
        system: int | None,
        component: int | None,
        *,
        spans_links: bool = False,
        splits_peers: bool = False,
    ) -> None:
        self.due = math.inf
        self._system = system
        self._component = component
        self._spans_links = spans_links
        self._splits_peers = splits_peers
        self._is_spread = spans_links or splits_peers

    def look(
        self, machines: Iterable[ComponentMachine], now: float, *, listening_since: float
    ) -> ComponentMachine | None:
        """Return the component once it is certain that the address fits no other; None before.

        Args:
            machines: every known component.
            now: the time.
            listening_since: since when everything on the links was received; infinity while one is down.

        Raises:
            AmbiguousVehicle: the address fits several vehicles.
        """
        machines = list(machines)
        self.due = math.inf
        if self._system is not None and self._component is not None:
            address = (self._system, self._component)
            found = [each for each in machines if (each.system, each.component) == address]
            found = [each for each in found if each.identification.has_response]
            return self._decided(found, found, now, listening_since, needs_look=self._is_spread)
        autopilots = _autopilots(machines)
        if self._system is not None:
            found = [each for each in autopilots if each.system == self._system]
            usual = [each for each in found if each.component == AUTOPILOT_COMPONENT]
            needs_look = self._is_spread or not usual
            return self._decided(usual or found, found, now, listening_since, needs_look=needs_look)
        if self._component is None:
            return self._decided(autopilots, autopilots, now, listening_since)
        found = [each for each in machines if each.component == self._component]
        found = [each for each in found if each.identification.has_response and not each.presence.is_lost]
        return self._decided(found, [*autopilots, *found], now, listening_since)

    def _decided(
        self,
        found: Sequence[ComponentMachine],
        received: Sequence[ComponentMachine],
        now: float,
        listening_since: float,
        *,
        needs_look: bool = True,
    ) -> ComponentMachine | None:
        """Return the only component found, once it is certain that there is no other.

        Args:
            found: the components that fit the address.
            received: the components of every vehicle that the address fits.
        """
        one_of_each = _one_of_each(received)
        if len(one_of_each) > 1:
            raise self._ambiguous(one_of_each, "vehicles")
        if len(found) > 1:
            raise self._ambiguous(found, f"autopilots in system {found[0].system}")
        if not found:
            return None
        if needs_look:
            first_received_at = min(each.presence.since for each in received)
            self.due = max(first_received_at, listening_since) + LOOK_TIME
        return found[0] if not needs_look or now >= self.due else None

    def _ambiguous(self, machines: Sequence[ComponentMachine], what: str) -> AmbiguousVehicle:
        """Return the error that lists the vehicles."""
        places = {_place(each, splits_peers=self._splits_peers) for each in machines}
        words = [
            vehicle_in_words(each)
            + (f" {_place(each, splits_peers=self._splits_peers)}" if len(places) > 1 else "")
            for each in sorted(machines, key=lambda each: (each.system, each.component))
        ]
        systems = {each.system for each in machines}
        way_within = "component" if len(places) == 1 else "peer" if self._splits_peers else "link"
        choose_by = "system" if len(systems) == len(machines) else way_within
        where = "on the links of this service" if self._spans_links else "on this link"
        return AmbiguousVehicle(
            f"{len(machines)} {what} {where}: {', '.join(words)}.", vehicles=words, choose_by=choose_by
        )


def vehicle_in_words(machine: ComponentMachine) -> str:
    """Return address, autopilot and kind of vehicle: `1/1 PX4 quadrotor`."""
    kind = kind_in_words(machine.identification.autopilot, machine.identification.vehicle_type)
    return f"{machine.system}/{machine.component} {kind}".rstrip()


def _autopilots(machines: Iterable[ComponentMachine]) -> list[ComponentMachine]:
    """Return the autopilots that are not lost, without peripherals that claim to be one."""
    found = [each for each in machines if each.identification.is_autopilot and not each.presence.is_lost]
    return [each for each in found if not _is_peripheral(each)] or found


def _is_peripheral(machine: ComponentMachine) -> bool:
    return (
        machine.identification.autopilot == MAV_AUTOPILOT_GENERIC
        and machine.identification.vehicle_type in _PERIPHERALS
    )


def _one_of_each(machines: Iterable[ComponentMachine]) -> list[ComponentMachine]:
    """Return one component of each vehicle: its autopilot if known, component 1 before others."""
    first: dict[tuple[str, int], ComponentMachine] = {}
    for each in sorted(machines, key=lambda each: (not each.identification.is_autopilot, each.component)):
        first.setdefault((each.identity.link, each.system), each)
    return list(first.values())


def _place(machine: ComponentMachine, *, splits_peers: bool) -> str:
    """Return the location of a component as text."""
    return f"at {machine.peer_in_words}" if splits_peers else f"on {machine.identity.link}"
