"""The vehicle that --vehicle names: by address, kind, hardware id or key."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Final

import anyio

from paramclient.cache import ParamCache
from paramclient.cache.lookup import KINDS, address_of, find_vehicle
from paramclient.client.client import ParamClient
from paramclient.client.component import Component
from paramclient.errors import AmbiguousVehicle, AnotherVehicle, NoReply, UsageError
from paramclient.protocol.selection import LOOK_TIME

__all__ = ["VehicleName", "check_kind", "check_uid", "wait_for_kind"]

KIND_POLL_INTERVAL: Final = 0.05
"""Seconds between two checks whether a vehicle of a kind was heard."""
UID_TIMEOUT: Final = 5.0
"""Seconds to wait for the hardware id of a vehicle that is named by its hardware id: several attempts
of the request on a link that loses half of the packets."""

_SYSTEM_ID: Final = re.compile(r"[0-9]{1,3}")


@dataclass(frozen=True, slots=True)
class VehicleName:
    """The parts of a vehicle's name.

    Attributes:
        system, component: its ids, or None.
        kind: `px4` or `ardupilot`, or None.
        uid: its hardware id, or None.
    """

    system: int | None = None
    component: int | None = None
    kind: str | None = None
    uid: str | None = None

    @classmethod
    def parse(cls, text: str, cache: str | None, *, uses_cache: bool) -> VehicleName:
        """Parse the name of a vehicle. Nicknames, hardware ids and keys are looked up in the cache.

        Args:
            text: the name.
            cache: the option --cache.
            uses_cache: whether the cache may be read.

        Raises:
            UsageError: an id is out of range, or the name needs the cache.
            UnknownVehicle: no vehicle in the cache has this name.
            AmbiguousVehicle: several have it.
            CacheError: the cache cannot be read.
        """
        text = text.removeprefix("cache:")
        address = address_of(text) or ((int(text), None) if _SYSTEM_ID.fullmatch(text) else None)
        if address is not None:
            if not all(1 <= number <= 255 for number in address if number is not None):
                raise UsageError(f"--vehicle {text}: system and component ids are 1 to 255")
            return cls(*address)
        if text.lower() in KINDS:
            return cls(kind=text.lower())
        if not uses_cache:
            raise UsageError(
                f"--vehicle {text} is neither an address, such as 4 or 4/1, nor px4 or ardupilot; "
                "hardware ids are looked up in the cache, which is not used"
            )
        with ParamCache(cache) as opened:
            found = find_vehicle(opened.vehicles(), text, place=opened.place).identity
        return cls(system=found.system, uid=found.uid)

    @classmethod
    def chosen(
        cls,
        vehicle: str | None,
        system: int | None,
        component: int | None,
        *,
        cache: str | None = None,
        uses_cache: bool = True,
    ) -> VehicleName:
        """Return the vehicle that the options --vehicle, --system and --component name together.

        Raises:
            UsageError: the options exclude each other.
            ParamClientError: as from `parse`.
        """
        if vehicle is None:
            return cls(system, component)
        if system is not None:
            raise UsageError("--vehicle and --system exclude each other")
        named = cls.parse(vehicle, cache, uses_cache=uses_cache)
        if component is not None and (named.kind is not None or named.component not in (None, component)):
            raise UsageError(f"--vehicle {vehicle} and --component {component} exclude each other")
        return named if component is None else replace(named, component=component)


async def wait_for_kind(client: ParamClient, kind: str, timeout: float | None) -> Component | None:
    """Wait for the only vehicle with an autopilot of this kind; None after the timeout.

    Looks for others for `LOOK_TIME` after the first one.

    Raises:
        AmbiguousVehicle: there are several.
        LinkError: the link failed.
    """
    with anyio.move_on_after(timeout):
        while not (found := _of_kind(client, kind)):
            client.core.check_open()
            await anyio.sleep(KIND_POLL_INTERVAL)
        await anyio.sleep(LOOK_TIME)
    return check_kind(client, kind) if found else None


def check_kind(client: ParamClient, kind: str) -> Component | None:
    """Return the only vehicle with an autopilot of this kind that is heard; None if there is none.

    Raises:
        AmbiguousVehicle: there are several.
    """
    found = _of_kind(client, kind)
    if len(found) > 1:
        words = [f"{each.system}/{each.component} {each.autopilot}" for each in found]
        raise AmbiguousVehicle(
            f"{len(found)} vehicles on this link are {kind}: {', '.join(words)}.",
            vehicles=words,
            choose_by="system",
        )
    return found[0] if found else None


async def check_uid(client: ParamClient, component: Component, uid: str | None) -> None:
    """Check that a vehicle has the hardware id of the named one, if that is known.

    The hardware id may be that of the component, or of the autopilot with its system id: a camera reports its
    own or none.

    Raises:
        AnotherVehicle: it has another one.
        NoReply: it does not report one.
    """
    if uid is None:
        return
    began = anyio.current_time()
    reported = _reported_uids(client, component)
    with anyio.move_on_after(UID_TIMEOUT):
        while uid not in reported and None in reported:
            await anyio.sleep(KIND_POLL_INTERVAL)
            reported = _reported_uids(client, component)
    if uid in reported:
        return
    system, number = component.system, component.component
    found = next((each for each in reversed(reported) if each is not None), None)
    if found is not None:
        raise AnotherVehicle(system, number, f"the hardware id {uid}", f"the hardware id {found}")
    raise NoReply(
        f"the hardware id of {system}/{number}",
        attempts=0,
        waited=anyio.current_time() - began,
        hint=f"The named vehicle has the hardware id {uid}, and another one may be on this link with its "
        f"system id. --vehicle {system}/{number} chooses by address alone.",
    )


def _reported_uids(client: ParamClient, component: Component) -> list[str | None]:
    """Return the hardware ids of a component and the autopilot of its system; None for one not yet known."""
    autopilots = [each for each in client.autopilots if each.system == component.system]
    if any(each is component for each in autopilots):
        return [component.identity.uid]
    return [component.identity.uid, *([each.identity.uid for each in autopilots] or [None])]


def _of_kind(client: ParamClient, kind: str) -> list[Component]:
    return [each for each in client.autopilots if each.autopilot == kind and each.state != "lost"]
