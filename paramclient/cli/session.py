"""An open link with its vehicle, and the deadline of a command."""

from __future__ import annotations

import re
import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import anyio
import anyio.to_thread

from paramclient.cache import CachedSummary
from paramclient.cli.options import LinkOptions, TrafficOptions
from paramclient.cli.output import local_time, printable, report, say
from paramclient.cli.vehicle_name import check_kind, check_uid, wait_for_kind
from paramclient.cli.waiting import while_waiting
from paramclient.client.arguments import address_in_words
from paramclient.client.client import ParamClient
from paramclient.client.component import Component
from paramclient.errors import AmbiguousVehicle, CacheError, NoReply, UsageError
from paramclient.links import LinkKind, ReplayLink, parse_link
from paramclient.model.identity import version_text
from paramclient.model.wording import counted, first_of
from paramclient.protocol.fetch import Policy
from paramclient.protocol.kinds import kind_in_words
from paramclient.protocol.selection import LOOK_TIME, hint_of_link
from paramclient.wire.messages import MAV_AUTOPILOT_INVALID

__all__ = [
    "Deadline",
    "CommandSession",
    "check_link_argument",
    "connect",
    "listen",
    "received_in_words",
    "receiver_in_words",
    "unheard_in_words",
    "vehicle_in_words",
    "wait_for_firmware",
    "wait_for_vehicle",
]

VEHICLE_TIMEOUT: Final = 10.0
"""Seconds to wait for the first heartbeat of a vehicle, without --timeout."""
RECHECK_TIMEOUT: Final = 2.5
"""Seconds to check that the vehicle is still the only one: no wait is needed unless the vehicle or the link
was lost in between."""

UNHEARD_AGE_MAX: Final = 86_400.0
"""Seconds since a vehicle in the cache was heard, up to which a command names it if it is not heard now: one
day, because a vehicle of an earlier one is probably not here any more."""
CACHE_LIST_TIMEOUT: Final = 0.5
"""Seconds to wait for the list of vehicles in the cache, which takes milliseconds from a local one."""

OTHERS_SHOWN_MAX: Final = 5
"""Other vehicles that a line names, so that it stays readable; it gives the number of further ones."""

FIRMWARE_TIMEOUT: Final = 0.5
"""Seconds to wait for the firmware version of the vehicle, to name it to the user or to find its metadata."""
FIRMWARE_POLL_INTERVAL: Final = 0.01
"""Seconds between two checks whether the firmware version is known."""

_PARAMETER: Final = re.compile(r"[A-Z][A-Z0-9]*_[A-Z0-9_]*(=.*)?", re.IGNORECASE)
"""A text that is probably the name of a parameter, or NAME=VALUE: it has an underscore."""


class Deadline:
    """The deadline of a command.

    Args:
        seconds: from now; None for no deadline.
    """

    def __init__(self, seconds: float | None) -> None:
        self._at = None if seconds is None else anyio.current_time() + seconds

    def left(self, at_most: float | None = None) -> float | None:
        """Return the seconds left, at most `at_most`; 0 after the deadline; `at_most` without a deadline."""
        if self._at is None:
            return at_most
        left = max(self._at - anyio.current_time(), 0.0)
        return left if at_most is None else min(left, at_most)


@dataclass(frozen=True, slots=True)
class CommandSession:
    """An open client, and the component that the command works on."""

    client: ParamClient
    component: Component
    deadline: Deadline
    options: LinkOptions

    @property
    def now(self) -> float:
        """The current unix time in seconds; for a log, the time of the last frame read from it."""
        link = self.client.link
        at = link.at if isinstance(link, ReplayLink) else None
        return time.time() if at is None else at

    @property
    def label(self) -> str:
        """The component in words: `1/1 px4`."""
        component = self.component
        return f"{component.system}/{component.component} {component.autopilot}"

    @property
    def receiver(self) -> str:
        """The component with its kind and firmware, for a subcommand that writes; see `receiver_in_words`."""
        return receiver_in_words(self.component)

    @property
    def is_named(self) -> bool:
        """Whether an option chose the vehicle, instead of the first one heard."""
        options = self.options
        return options.system is not None or options.vehicle is not None or options.peer is not None

    async def report_others(self, *, has_all: bool = False) -> None:
        """Report other vehicles of the link, if no option chose the one that was used.

        For subcommands that only read: they use the first vehicle heard, which may be another one next
        time. A short command may end before the heartbeat of another vehicle; the cache knows those of
        earlier commands.

        Args:
            has_all: whether the subcommand has --all for every vehicle.
        """
        if self.is_named:
            return
        others = [each for each in self.client.autopilots if each.system != self.component.system]
        sentences = [f"{self.label} was used, the first vehicle heard."]
        if others:
            listed = first_of([vehicle_in_words(each) for each in others], OTHERS_SHOWN_MAX)
            sentences.append(f"Also on this link: {listed}.")
        sentences += await unheard_in_words(self)
        if len(sentences) > 1:
            all_of_them = ", --all reads all of them" if has_all else ""
            report(f"{' '.join(sentences)} --system chooses one{all_of_them}")

    async def announce_write(self) -> None:
        """Print a line on stderr that says to which vehicle the subcommand writes, unless it prints JSON."""
        if not self.options.json:
            await wait_for_firmware([self.component], self.deadline)
            say(printable(f"writing to {self.receiver} on {self.client.link.name}"))

    async def report_unheard(self) -> None:
        """Report vehicles of the link that the cache knows and that were not heard, if no option chose one.

        For subcommands that write, before the first write.
        """
        if not self.is_named:
            for sentence in await unheard_in_words(self):
                report(f"{sentence} --system chooses one")

    async def check_only(self) -> None:
        """Check that the component is still the only one that matches the options.

        For subcommands that write, directly before the first write: other vehicles may have appeared.

        Raises:
            AmbiguousVehicle: another vehicle is on the link, or has replaced the component.
            NoReply: no vehicle is heard.
            LinkError: the link failed.
        """
        options, component = self.options, self.component
        kind = options.named.kind
        if kind is not None and check_kind(self.client, kind) in (None, component):
            await self.client.only_component(
                component.system, component.component, timeout=self.deadline.left(RECHECK_TIMEOUT)
            )
            return
        found = await self.client.only_component(
            options.system,
            options.component,
            peer=options.peer,
            timeout=self.deadline.left(RECHECK_TIMEOUT),
        )
        if found is not component:
            other_vehicle = f"{found.system}/{found.component} {found.autopilot}"
            raise AmbiguousVehicle(
                f"{self.label} was chosen and is no longer heard; {other_vehicle} is heard instead. "
                "Nothing was written.",
                vehicles=(self.label, other_vehicle),
                choose_by=_difference(found, component),
            )


def check_link_argument(text: str) -> None:
    """Check that the first argument of a subcommand is not the file or the parameter that follows the link.

    Any other text that is not a link fails when the link is opened.

    Raises:
        UsageError: it is the name of a file or a parameter.
    """
    try:
        parse_link(text)
    except UsageError:
        found = "the name of a parameter" if _PARAMETER.fullmatch(text) else ""
        with suppress(OSError, ValueError):  # a text that is too long or has a NUL is not a file name
            found = "a file" if Path(text).is_file() else found
        if found:
            raise UsageError(
                f"{text} is {found}: the first argument is the link, such as udpin:0.0.0.0:14550 or sim:px4"
            ) from None


async def unheard_in_words(session: CommandSession) -> list[str]:
    """Return a sentence about vehicles of the link in the cache that were not heard; none without any.

    Vehicles that were heard last more than `UNHEARD_AGE_MAX` ago are left out, and so are those with the
    system id of a heard one.
    """
    cache, now = session.client.cache, session.now
    if cache is None:
        return []
    known: list[CachedSummary] = []
    with anyio.move_on_after(CACHE_LIST_TIMEOUT), suppress(CacheError):
        known = await anyio.to_thread.run_sync(cache.components, abandon_on_cancel=True)
    heard = {each.system for each in session.client.components.values()}
    link = session.client.link.name
    unheard: dict[int, str] = {}
    for each in known:
        at = max(each.updated_at, each.synced_at or 0.0)
        is_recent = now - at <= UNHEARD_AGE_MAX
        if each.autopilot == MAV_AUTOPILOT_INVALID or not is_recent:
            continue
        if each.identity.link != link or each.system in heard:
            continue
        kind = kind_in_words(each.autopilot, each.identity.vehicle_type)
        words = f"{each.system}/{each.component} {kind}".rstrip()
        unheard.setdefault(each.system, f"{words} (last {local_time(at)})")
    if not unheard:
        return []
    listed = first_of([unheard[system] for system in sorted(unheard)], OTHERS_SHOWN_MAX)
    was = "was" if len(unheard) == 1 else "were"
    return [f"{counted(len(unheard), 'vehicle')} of this link in the cache {was} not heard: {listed}."]


async def wait_for_firmware(vehicles: Sequence[Component], deadline: Deadline) -> None:
    """Wait until the firmware versions of vehicles are known, for at most `FIRMWARE_TIMEOUT`."""
    with anyio.move_on_after(deadline.left(FIRMWARE_TIMEOUT)):
        while not all(each.identity.firmware for each in vehicles):  # noqa: ASYNC110 - no event
            await anyio.sleep(FIRMWARE_POLL_INTERVAL)


def receiver_in_words(component: Component) -> str:
    """Return address, kind and firmware of a component: `1/1 PX4 quadrotor, firmware 1.16.0`."""
    firmware = component.identity.firmware
    return vehicle_in_words(component) + (f", firmware {version_text(firmware)}" if firmware else "")


def vehicle_in_words(component: Component) -> str:
    """Return address and kind of a component: `1/1 PX4 quadrotor`."""
    kind = kind_in_words(component.identity.autopilot, component.identity.vehicle_type)
    return f"{component.system}/{component.component} {kind}".rstrip()


@asynccontextmanager
async def connect(
    url: str,
    options: LinkOptions,
    *,
    policy: Policy = Policy.AUTO,
    is_live: bool = False,
    only: bool = False,
) -> AsyncIterator[CommandSession]:
    """Open a link and wait for the component that the options name.

    Args:
        url: the link.
        options: the component, and the options of the link.
        policy: as in `ParamClient`.
        is_live: read a log in real time; otherwise it is read at full speed, unless its name gives a speed.
        only: whether several vehicles are an error, unless the options name one: for subcommands that write.

    Raises:
        UsageError: no such link, or options that exclude each other.
        AmbiguousVehicle: with `only`, several vehicles were heard.
        NoReply: the component was not heard.
        LinkError: the link cannot be opened, or failed.
    """
    check_link_argument(url)
    if options.peer is not None and not options.split_peers:
        raise UsageError("--peer needs --split-peers")
    deadline = Deadline(options.timeout)
    async with ParamClient(
        url if is_live else _at_full_speed(url),
        cache=None if options.place is True else options.place,
        encoding=options.encoding,
        policy=policy,
        listen_only=options.listen_only,
        forward=options.forward,
        tlog=options.tlog,
        signing=options.signing,
        split_peers=options.split_peers,
        **options.source,
    ) as client:
        timeout = VEHICLE_TIMEOUT if options.timeout is None else deadline.left()
        component = await wait_for_vehicle(
            client,
            options.system,
            options.component,
            kind=options.named.kind,
            peer=options.peer,
            timeout=timeout,
            only=only,
        )
        await check_uid(client, component, options.named.uid)
        yield CommandSession(client, component, deadline, options)


async def wait_for_vehicle(
    client: ParamClient,
    system: int | None,
    component: int | None,
    *,
    kind: str | None = None,
    peer: str | None = None,
    timeout: float | None,
    only: bool = False,
) -> Component:
    """Wait for a component; meanwhile, show on a terminal the awaited component and those that were heard.

    Args:
        client: an open client.
        system, component, peer, timeout: as in `ParamClient.component`.
        kind: wait for the only vehicle with this autopilot instead.
        only: as in `connect`.

    Raises:
        ParamClientError: as from `ParamClient.component` and `ParamClient.only_component`.
    """
    awaited = (
        address_in_words(system, component, peer) if kind is None else f"a vehicle with autopilot {kind}"
    )

    async def look(_: Callable[[], None]) -> Component:
        if kind is None and not only:
            return await client.component(system, component, peer=peer, timeout=timeout)
        if kind is None:
            return await _find_only(client, system, component, peer=peer, timeout=timeout)
        began = anyio.current_time()
        found = await wait_for_kind(client, kind, timeout)
        if found is None:
            waited = anyio.current_time() - began
            raise NoReply(awaited, attempts=0, waited=waited, hint=received_in_words(client))
        return found

    return await while_waiting(look, f"{awaited} on {client.link.name}", lambda: received_in_words(client))


async def _find_only(
    client: ParamClient, system: int | None, component: int | None, *, peer: str | None, timeout: float | None
) -> Component:
    """Wait for the only component, as `ParamClient.only_component` does; the error lists all vehicles.

    That call ends with the second vehicle that is heard. The user chooses one of all: the others are
    waited for as long as an autopilot takes for a heartbeat.
    """
    deadline = Deadline(timeout)
    try:
        return await client.only_component(system, component, peer=peer, timeout=timeout)
    except AmbiguousVehicle:
        await anyio.sleep(deadline.left(LOOK_TIME) or 0.0)
        with suppress(NoReply):
            await client.only_component(system, component, peer=peer, timeout=RECHECK_TIMEOUT)
        raise


def listen(url: str, options: TrafficOptions, *, listen_only: bool = False) -> ParamClient:
    """Return a client that counts all traffic, and neither reads nor writes a cache.

    Raises:
        UsageError: no such link.
    """
    return ParamClient(
        url,
        cache=False,
        traffic=True,
        signing=options.signing,
        listen_only=listen_only,
        tlog=options.tlog,
        **options.source,
    )


def received_in_words(client: ParamClient) -> str:
    """Return what was received so far on the link."""
    return hint_of_link(client.core.station, client.link.name)


def _difference(found: Component, chosen: Component) -> str:
    """Return the name of the argument that distinguishes two components."""
    if found.system != chosen.system:
        return "system"
    return "component" if found.component != chosen.component else "peer"


def _at_full_speed(url: str) -> str:
    """Return the link name; for a log without a speed, with the option for full speed."""
    if not url.lower().startswith(f"{LinkKind.REPLAY}:"):
        return url
    spec = parse_link(url)
    return spec.name if spec.options else replace(spec, options=(("speed", 0.0),)).name
