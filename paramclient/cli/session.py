"""Open links with their vehicles: the sessions on which a subcommand works, and its deadline."""

from __future__ import annotations

import re
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Generic, TypeVar

import anyio
import anyio.to_thread

from paramclient.cache import CachedSummary
from paramclient.cli.exit_codes import ExitCode, code_of
from paramclient.cli.options import LinkOptions, TrafficOptions
from paramclient.cli.output import (
    local_time,
    printable,
    report,
    say,
    while_waiting,
)
from paramclient.client.client import ParamClient
from paramclient.client.component import Component
from paramclient.errors import AmbiguousVehicle, CacheError, NoReply, ParamClientError, UsageError
from paramclient.links import LinkKind, ReplayLink, parse_link
from paramclient.model.identity import version_text
from paramclient.model.wording import counted, first_of
from paramclient.protocol.fetch import Policy
from paramclient.protocol.identity import HEARTBEAT_WAIT, expects_extended, kind_in_words
from paramclient.protocol.selection import address_in_words, hint_of_link, node_in_words
from paramclient.wire.messages import MAV_AUTOPILOT_INVALID

__all__ = [
    "CommandSession",
    "Deadline",
    "Done",
    "ChosenVehicle",
    "announce_write",
    "check_link_argument",
    "connect",
    "failed_json",
    "listen",
    "received_in_words",
    "receiver_in_words",
    "report_failures",
    "report_others",
    "run_on_all",
    "sessions",
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
UID_POLL_INTERVAL: Final = 0.05
"""Seconds between two checks whether a vehicle with a hardware id was heard."""

T = TypeVar("T")

_PARAMETER: Final = re.compile(r"[A-Z][A-Z0-9]*_[A-Z0-9_]*(=.*)?", re.IGNORECASE)
"""A text that is probably the name of a parameter, or NAME=VALUE: it has an underscore."""
_ADDRESS: Final = re.compile(r"([0-9]{1,3})(?:/([0-9]{1,3}))?")
_UID: Final = re.compile(r"uid:([0-9a-f]{6,})", re.IGNORECASE)


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
class ChosenVehicle:
    """The vehicle that --vehicle names; without any part, the first one heard or the only one.

    Attributes:
        system, component: its ids, or None.
        uid: the beginning of its hardware id, or None.
        is_all: whether all vehicles of the link are chosen.
    """

    system: int | None = None
    component: int | None = None
    uid: str | None = None
    is_all: bool = False

    @classmethod
    def parse(cls, text: str | None) -> ChosenVehicle:
        """Parse the value of --vehicle.

        Raises:
            UsageError: it names no vehicle of a link.
        """
        if text is None:
            return cls()
        if text.lower() == "all":
            return cls(is_all=True)
        if found := _UID.fullmatch(text):
            return cls(uid=found[1].lower())
        if (found := _ADDRESS.fullmatch(text)) is None:
            raise UsageError(
                f"--vehicle {text}: a vehicle is written as 4, as 4/1 (system and component id), as uid: and "
                "at least 6 digits of its hardware id, or as all"
            )
        ids = [int(each) for each in found.groups() if each is not None]
        if not all(each <= 255 for each in ids) or ids[0] == 0:
            raise UsageError(f"--vehicle {text}: system ids are 1 to 255, component ids 0 to 255")
        return cls(system=ids[0], component=ids[1] if len(ids) > 1 else None)

    @property
    def is_named(self) -> bool:
        """Whether the user has chosen the vehicle."""
        return self != ChosenVehicle()


@dataclass(frozen=True, slots=True)
class CommandSession:
    """An open client, and a component that the command works on: with --extended, its extended parameters."""

    client: ParamClient
    component: Component
    deadline: Deadline
    options: LinkOptions
    choice: ChosenVehicle

    @property
    def now(self) -> float:
        """The current unix time in seconds; for a log, the time of the last frame read from it."""
        link = self.client.link
        at = link.at if isinstance(link, ReplayLink) else None
        return time.time() if at is None else at

    @property
    def address(self) -> str:
        """System and component id: `1/1`."""
        return f"{self.component.system}/{self.component.component}"

    @property
    def label(self) -> str:
        """The component in words: `1/1 px4`; one that names no autopilot by its kind: `1/100 camera`."""
        autopilot = self.component.autopilot
        is_named = autopilot not in ("unknown", "no autopilot", "generic")
        return f"{self.address} {autopilot}" if is_named else node_in_words(self.component.node)

    @property
    def prefix(self) -> str:
        """The beginning of a line about the component: its label with --vehicle all, else ""."""
        return f"{self.label}: " if self.choice.is_all else ""

    @property
    def noun(self) -> str:
        """The parameters of the component in words, in the singular."""
        return "extended parameter" if self.component.is_extended else "parameter"

    @property
    def receiver(self) -> str:
        """The component with its kind and firmware; see `receiver_in_words`."""
        return receiver_in_words(self.component)

    async def check_only(self) -> None:
        """Check that the component is still the only one that --vehicle fits.

        For subcommands that write, directly before the first write: other vehicles may have appeared.

        Raises:
            AmbiguousVehicle: another vehicle is on the link, or has replaced the component.
            NoReply: no vehicle is heard.
            LinkError: the link failed.
        """
        choice, own = self.choice, self.component
        if choice.is_all:
            return
        system, component = choice.system, choice.component
        if choice.uid is not None:
            system, component = own.system, own.component
        timeout = self.deadline.left(RECHECK_TIMEOUT)
        found = await self.client.only_component(system, component, timeout=timeout)
        if found.node is not own.node:
            other = f"{found.system}/{found.component} {found.autopilot}"
            raise AmbiguousVehicle(
                f"{self.label} was chosen and is no longer heard; {other} is heard instead. Nothing was "
                "written.",
                vehicles=(self.label, other),
                choose_by="system" if found.system != own.system else "component",
            )


@asynccontextmanager
async def sessions(
    url: str,
    options: LinkOptions,
    *,
    writes: bool = False,
    policy: Policy = Policy.AUTO,
    is_live: bool = False,
    extended: bool = False,
) -> AsyncIterator[list[CommandSession]]:
    """Open a link, and yield a session for each vehicle that --vehicle names.

    Args:
        url: the link.
        options: the vehicle, and the options of the link.
        writes: whether several vehicles are an error, unless --vehicle names one or all.
        policy: as in `ParamClient`.
        is_live: read a log in real time; otherwise it is read at full speed, unless its name gives a speed.
        extended: use the extended parameters. Otherwise --extended is suggested for a camera.

    Raises:
        UsageError: no such link, or options that exclude each other.
        AmbiguousVehicle: with `writes`, several vehicles were heard.
        NoReply: the vehicle was not heard.
        LinkError: the link cannot be opened, or failed.
    """
    check_link_argument(url)
    choice, deadline = ChosenVehicle.parse(options.vehicle), Deadline(options.timeout)
    if extended and choice.is_all:
        raise UsageError("--vehicle all is not possible with --extended; name one vehicle")
    async with ParamClient(
        url if is_live else _at_full_speed(url),
        cache=None if options.place is True else options.place,
        encoding=options.encoding,
        policy=policy,
        listen_only=options.listen_only,
        forward=options.forward,
        tlog=options.tlog,
        signing=options.signing,
        **options.source,
    ) as client:
        timeout = VEHICLE_TIMEOUT if options.timeout is None else deadline.left()
        found = await _find(client, choice, timeout=timeout, only=writes)
        if writes:
            await wait_for_firmware(found, deadline)
        for each in () if extended else found:
            if expects_extended(each.identity.vehicle_type, each.component):
                label = f"{each.system}/{each.component}"
                say(f"{label} usually has extended parameters: --extended uses them")
        chosen = [each.ext for each in found] if extended else found
        yield [CommandSession(client, each, deadline, options, choice) for each in chosen]


@asynccontextmanager
async def connect(
    url: str, options: LinkOptions, *, writes: bool = False, is_live: bool = False, extended: bool = False
) -> AsyncIterator[CommandSession]:
    """Open a link, and yield the session of one vehicle; arguments and errors as in `sessions`.

    Raises:
        UsageError: also for --vehicle all.
    """
    if ChosenVehicle.parse(options.vehicle).is_all:
        raise UsageError("--vehicle all is not possible here; name one vehicle")
    async with sessions(url, options, writes=writes, is_live=is_live, extended=extended) as found:
        yield found[0]


async def announce_write(found: Sequence[CommandSession]) -> None:
    """Print a line on stderr for each vehicle to which the subcommand writes, unless it prints JSON.

    Also reports vehicles of the link in the cache that were not heard, if --vehicle names none.
    """
    first = found[0]
    if not first.options.json:
        for each in found:
            say(printable(f"writing to {each.receiver} on {each.client.link.name}"))
    if not first.choice.is_named:
        for sentence in await _unheard_in_words(first):
            report(f"{sentence} --vehicle chooses one")


async def report_others(found: Sequence[CommandSession]) -> None:
    """Report other vehicles of the link, if --vehicle did not choose the one that was used.

    For subcommands that only read: they use the first vehicle heard, which may be another one next time. A
    short command may end before the heartbeat of another vehicle; the cache knows those of earlier commands.
    """
    first = found[0]
    if first.choice.is_all:
        own = [each.component.node for each in found]
        parts = [each for each in first.client.components.values() if each.node not in own]
        parts = [each for each in parts if each.node.identification.has_parameters]
        if parts:
            listed = first_of([vehicle_in_words(each) for each in parts], OTHERS_SHOWN_MAX)
            report(f"--vehicle all chooses autopilots. Also heard, and not asked: {listed}")
        for sentence in await _unheard_in_words(first):
            report(sentence)
    if first.choice.is_named:
        return
    others = [each for each in first.client.autopilots if each.system != first.component.system]
    sentences = []
    if others:
        listed = first_of([vehicle_in_words(each) for each in others], OTHERS_SHOWN_MAX)
        sentences.append(f"Also on this link: {listed}.")
    sentences += await _unheard_in_words(first)
    if sentences:
        used = f"{first.label} was used, the first vehicle heard."
        report(f"{' '.join([used, *sentences])} --vehicle chooses one")


# Work on every session


@dataclass(frozen=True, slots=True)
class Done(Generic[T]):
    """The outcome of the work on one vehicle: its result, or the error that ended it."""

    session: CommandSession
    result: T | None = None
    error: ParamClientError | None = None


async def run_on_all(
    found: Sequence[CommandSession], work: Callable[[CommandSession], Awaitable[T]]
) -> list[Done[T]]:
    """Work on all vehicles concurrently; return the outcomes. A failure of one does not stop the others.

    Raises:
        ParamClientError: the error of the vehicle, without --vehicle all.
    """
    if not found[0].choice.is_all:
        return [Done(found[0], await work(found[0]))]
    done: dict[int, Done[T]] = {}

    async def run(place: int, session: CommandSession) -> None:
        try:
            done[place] = Done(session, result=await work(session))
        except ParamClientError as error:
            done[place] = Done(session, error=error)

    async with anyio.create_task_group() as tasks:
        for place, session in enumerate(found):
            tasks.start_soon(run, place, session)
    return [done[place] for place in sorted(done)]


def report_failures(done: Sequence[Done[T]]) -> int:
    """Print the errors of vehicles on which the work failed; return the exit code for them."""
    worst: int = ExitCode.DONE
    for each in done:
        if each.error is not None:
            report(f"{each.session.label}: {each.error}")
            worst = max(worst, code_of(each.error))
    return worst


def failed_json(done: Sequence[Done[T]]) -> list[dict[str, object]]:
    """Return the JSON of the vehicles on which the work failed."""
    return [
        {
            "system": each.session.component.system,
            "component": each.session.component.component,
            "error": str(each.error),
        }
        for each in done
        if each.error is not None
    ]


# Vehicles


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


async def _unheard_in_words(session: CommandSession) -> list[str]:
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
    return node_in_words(component.node)


async def _find(
    client: ParamClient, choice: ChosenVehicle, *, timeout: float | None, only: bool
) -> list[Component]:
    """Return the vehicles that a choice names; see `sessions`."""
    if not choice.is_all:
        return [await wait_for_vehicle(client, choice, timeout=timeout, only=only)]

    async def look(_: Callable[[], None]) -> list[Component]:
        return await client.find_autopilots(timeout=timeout)

    return await while_waiting(look, f"vehicles on {client.link.name}", lambda: received_in_words(client))


async def wait_for_vehicle(
    client: ParamClient, choice: ChosenVehicle, *, timeout: float | None, only: bool = False
) -> Component:
    """Wait for one vehicle; meanwhile, show on a terminal the awaited one and those that were heard.

    Args:
        client: an open client.
        choice: the vehicle.
        timeout: seconds; None waits without limit.
        only: as `writes` in `sessions`.

    Raises:
        ParamClientError: as from `ParamClient.component` and `ParamClient.only_component`.
    """
    if choice.uid is None:
        awaited = address_in_words(choice.system, choice.component, None)
    else:
        awaited = f"a vehicle with hardware id {choice.uid}"

    async def look(_: Callable[[], None]) -> Component:
        if choice.uid is not None:
            return await _find_by_uid(client, choice.uid, awaited, timeout, only=only)
        if only:
            return await _find_only(client, choice, timeout)
        return await client.component(choice.system, choice.component, timeout=timeout)

    return await while_waiting(look, f"{awaited} on {client.link.name}", lambda: received_in_words(client))


async def _find_by_uid(
    client: ParamClient, uid: str, awaited: str, timeout: float | None, *, only: bool
) -> Component:
    """Wait for the autopilot with a hardware id; with `only`, also for another one that begins like it.

    Raises:
        AmbiguousVehicle: several have this beginning.
        NoReply: none has it.
    """
    began, has_looked = anyio.current_time(), False
    with anyio.move_on_after(timeout):
        while True:
            found = [each for each in client.autopilots if (each.identity.uid or "").startswith(uid)]
            if len(found) > 1:
                words = [vehicle_in_words(each) for each in found]
                raise AmbiguousVehicle(
                    f"{len(found)} vehicles on this link have hardware ids that begin with {uid}: "
                    f"{', '.join(words)}.",
                    vehicles=words,
                    choose_by="system",
                )
            if found and (has_looked or not only or found[0].identity.uid == uid):
                return found[0]
            if found:
                has_looked = True
                await anyio.sleep(HEARTBEAT_WAIT)
                continue
            client.core.station.gate.check()
            await anyio.sleep(UID_POLL_INTERVAL)
    waited = anyio.current_time() - began
    raise NoReply(awaited, attempts=0, waited=waited, hint=received_in_words(client))


async def _find_only(client: ParamClient, choice: ChosenVehicle, timeout: float | None) -> Component:
    """Wait for the only component, as `ParamClient.only_component` does; the error lists all vehicles.

    That call ends with the second vehicle that is heard. The user chooses one of all: the others are
    waited for as long as an autopilot takes for a heartbeat.
    """
    deadline, address = Deadline(timeout), (choice.system, choice.component)
    try:
        return await client.only_component(*address, timeout=timeout)
    except AmbiguousVehicle:
        await anyio.sleep(deadline.left(HEARTBEAT_WAIT) or 0.0)
        with suppress(NoReply):
            await client.only_component(*address, timeout=RECHECK_TIMEOUT)
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
    return hint_of_link(client.core.station, client.bytes_received)


def _at_full_speed(url: str) -> str:
    """Return the link name; for a log without a speed, with the option for full speed."""
    if not url.lower().startswith(f"{LinkKind.REPLAY}:"):
        return url
    spec = parse_link(url)
    return spec.name if spec.options else replace(spec, options=(("speed", 0.0),)).name
