"""Open links with their vehicles: the sessions on which a subcommand works, and the parameters it reads."""

from __future__ import annotations

import math
import re
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Mapping, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from typing import Any, Final, Protocol, TypeVar

import anyio

from paramclient.cli.json_output import JsonObject, taken
from paramclient.cli.options import LinkOptions, TrafficOptions
from paramclient.cli.output import ExitCode, Status, listed, print_json, print_table, report, report_all, say
from paramclient.client.client import VEHICLES_LISTENING_TIME, ParamClient
from paramclient.client.component import Component
from paramclient.errors import AmbiguousVehicle, NoReply, ParamClientError, UnknownParameter, UsageError
from paramclient.links import LinkKind, SimLink
from paramclient.model.identity import version_text
from paramclient.model.names import NameChoice, counted, did_you_mean, is_pattern, nearest_names
from paramclient.model.paramset import ParamSet
from paramclient.model.values import Param, Trust, check_name
from paramclient.protocol.fetch import FetchResult, Progress
from paramclient.protocol.identity import HEARTBEAT_WAIT, expects_extended
from paramclient.protocol.selection import address_in_words, hint_of_link, node_in_words

VEHICLE_TIMEOUT: Final = 10.0
"""Seconds to wait for the first heartbeat of a vehicle, without --timeout."""
RECHECK_TIMEOUT: Final = 2.5
"""Seconds to check that the vehicle is still the only one: no wait is needed unless the vehicle or the link
was lost in between."""
OTHERS_TIMEOUT: Final = 2.5
"""Seconds in which a camera or another component beside an autopilot must give its first parameter, to be
one of all."""
QUICK_ROUND_TRIP: Final = 0.1
"""Seconds up to which a round trip is that of UDP or USB, where a table takes 1 s; on a radio it takes 30."""
SUGGESTION_TIMEOUT: Final = 2.0
"""Seconds for a table that is fetched for similar names only."""
FIRMWARE_TIMEOUT: Final = 0.5
"""Seconds to wait for the firmware version of the vehicle, to name it to the user or to find its metadata."""

Result = TypeVar("Result", covariant=True)

_VEHICLE: Final = re.compile(
    r"(?P<system>[0-9]{1,3})(/(?P<component>[0-9]{1,3}))?|uid:(?P<uid>[0-9a-f]{6,})|(?P<all>all)",
    re.IGNORECASE,
)
"""What --vehicle takes."""


class Deadline:
    """The deadline of a command.

    Args:
        seconds: from now, the value of --timeout; None for the default.
        default: seconds without --timeout; None for no deadline.
    """

    def __init__(self, seconds: float | None, default: float | None = None) -> None:
        self._is_given, limit = seconds is not None, default if seconds is None else seconds
        self._at = math.inf if limit is None else anyio.current_time() + limit

    @property
    def heartbeat_timeout(self) -> float | None:
        """Seconds to wait for the first heartbeat of a vehicle."""
        return self.left(math.inf if self._is_given else VEHICLE_TIMEOUT)

    def left(self, at_most: float = math.inf) -> float | None:
        """Return the seconds left, at most `at_most`; 0 after the deadline; None for no limit."""
        left = min(max(self._at - anyio.current_time(), 0.0), at_most)
        return None if left == math.inf else left


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
    def parse(cls, text: str | None, *, one: str = "") -> ChosenVehicle:
        """Parse the value of --vehicle; `one` says why it must be a single vehicle, if it must.

        Raises:
            UsageError: it names no vehicle of a link.
        """
        if text is None:
            return cls()
        if (found := _VEHICLE.fullmatch(text)) is None:
            raise UsageError(
                f"--vehicle {text}: a vehicle is written as 4, as 4/1 (system and component id), as uid: and "
                "at least 6 digits of its hardware id, or as all"
            )
        if found["all"] and one:
            raise UsageError(f"--vehicle all is not possible here: {one}; name one vehicle")
        system, component = (int(found[name]) if found[name] else None for name in ("system", "component"))
        return cls(system, component, found["uid"] and found["uid"].lower(), bool(found["all"]))


def noun_of(params: Component | ParamSet) -> str:
    """Return the parameters of a component or of a set in words, in the singular."""
    return "extended parameter" if params.is_extended else "parameter"


@dataclass(frozen=True, slots=True)
class CommandSession:
    """An open client, and a component that the command works on: with --extended, its extended parameters.

    If the command writes, the component is the only one, or chosen by --vehicle.
    """

    client: ParamClient
    component: Component
    deadline: Deadline
    options: LinkOptions
    choice: ChosenVehicle
    writes: bool

    @property
    def address(self) -> str:
        """System and component id: `1/1`."""
        return f"{self.component.system}/{self.component.component}"

    @property
    def ids(self) -> JsonObject:
        """The address as members of JSON."""
        return taken(self.component, "system", "component")

    @property
    def label(self) -> str:
        """The component in words: `1/1 PX4 quadrotor`."""
        return node_in_words(self.component.node)

    @property
    def others(self) -> list[str]:
        """Other vehicles of the link in words, where --vehicle chose none; none beside a write."""
        heard = [] if self.writes or self.options.vehicle is not None else self.client.autopilots
        return [node_in_words(each.node) for each in heard if each.node is not self.component.node]

    @property
    def prefix(self) -> str:
        """The beginning of a remark on the component: its label if others were heard, else ""."""
        return f"{self.label}: " if self.choice.is_all or self.others else ""

    @property
    def shown_address(self) -> str | None:
        """The address in results, unless the component is certainly the one that was meant."""
        link, is_named = self.client.link, self.writes or self.options.vehicle is not None
        is_only = is_named or (isinstance(link, SimLink) and link.has_one_vehicle)
        return self.address if self.choice.is_all or not is_only else None

    @property
    def receiver(self) -> str:
        """Address, kind and firmware of the component: `1/1 PX4 quadrotor, firmware 1.16.0`."""
        firmware = self.component.node.identification.identity.firmware
        return f"{self.label}, firmware {version_text(firmware)}" if firmware else self.label

    async def fetch(self, *, refresh: bool = False) -> FetchResult:
        """Fetch the table; after an interruption, print what was received and kept."""
        component, title = self.component, f"fetching {self.label}"

        def update(progress: Progress) -> None:
            status.count(progress.received, progress.total)

        with Status(f"{title}: waiting for the first response", title) as status:
            try:
                timeout = self.deadline.left()
                return await component.fetch_all(refresh=refresh, timeout=timeout, progress=update)
            except anyio.get_cancelled_exc_class():
                received = sum(each.trust is not Trust.CACHED for each in component.params.values())
                of = "" if component.count is None else f" of {component.count}"
                kept = "not kept" if self.client.core.cache_writer.failure else "kept in the cache"
                kept = "not kept, without a cache" if self.client.cache is None else kept
                what = f"{received}{of} {noun_of(component)}s of {self.label}"
                say(f"interrupted: {what} received and {kept}")
                raise

    def report_missing(self, missing: Sequence[int]) -> int:
        """Print which indices the component did not send, if any; return the exit code."""
        if missing:
            what = f"{counted(len(missing), 'parameter')}, index {listed(missing)}"
            report(f"incomplete: {self.label} did not send {what}; run the command again to request them")
        return ExitCode.INCOMPLETE if missing else ExitCode.DONE

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
        address = (choice.system, choice.component) if choice.uid is None else own.address
        found = await self.client.only_component(*address, timeout=self.deadline.left(RECHECK_TIMEOUT))
        if found.node is not own.node:
            other = node_in_words(found.node)
            message = f"{self.label} is no longer heard; {other} is heard instead. Nothing was written."
            raise AmbiguousVehicle(message, vehicles=(self.label, other), choose_by="component")


class Shown(Protocol):
    """What a subcommand prints of one vehicle: an object of JSON, or the rows of a table."""

    @property
    def columns(self) -> Sequence[str]:
        """The headings."""

    def as_json(self) -> JsonObject:
        """Return the object."""

    def rows(self) -> Iterable[Sequence[object]]:
        """Return the rows."""

    def report(self) -> int:
        """Print a summary and remarks; return the exit code."""


class Sessions(list[CommandSession]):
    """The vehicles that a subcommand works on: the one of --vehicle, or all of them.

    Attributes:
        errors: the errors of vehicles whose work has failed; there is no further work on them.
    """

    def __init__(self, sessions: Iterable[CommandSession]) -> None:
        super().__init__(sessions)
        self.errors: dict[CommandSession, ParamClientError] = {}

    async def work(self, work: Callable[[CommandSession], Awaitable[Result]]) -> dict[CommandSession, Result]:
        """Work on all vehicles concurrently; return the results. A failure of one does not stop the others.

        Raises:
            ParamClientError: the error of the vehicle, without --vehicle all.
        """
        if not self[0].choice.is_all:
            return {self[0]: await work(self[0])}
        found: dict[CommandSession, Result] = {}

        async def run(session: CommandSession) -> None:
            try:
                found[session] = await work(session)
            except ParamClientError as error:
                self.errors[session] = error

        async with anyio.create_task_group() as tasks:
            for session in self:
                if session not in self.errors:
                    tasks.start_soon(run, session)
        return {session: found[session] for session in self if session in found}

    def show(self, results: Mapping[CommandSession, Shown]) -> int:
        """Print results as one table or as JSON, then remarks and failures; return the exit code.

        If none was named, the table says which vehicle it shows.
        """
        self.report_others()
        found = results.items()
        if not self[0].options.json:
            rows = [(session.shown_address, *cells) for session, each in found for cells in each.rows()]
            if rows:
                print_table(["vehicle", *next(iter(results.values())).columns], rows)
        else:
            items = [session.ids | result.as_json() for session, result in found]
            failures = [session.ids | {"error": str(error)} for session, error in self.errors.items()]
            print_json({"vehicles": items, "errors": failures} if self[0].choice.is_all else items[0])
        return max([result.report() for result in results.values()] + [self.report_errors()])

    def report_errors(self) -> int:
        """Print the errors of vehicles whose work has failed; return the exit code."""
        codes = [report_all([error], f"{session.label}: ") for session, error in self.errors.items()]
        return max(codes, default=ExitCode.DONE)

    def report_others(self, choosing: str = "--vehicle") -> None:
        """Report other vehicles of the link, if --vehicle did not choose the one that was used.

        For subcommands that only read: they use the first vehicle heard, which may be another one next time.
        Some have no --vehicle, and another one chooses.
        """
        if others := self[0].others:
            used = f"{self[0].label} was used, the first vehicle heard"
            report(f"{used}. Also on this link: {listed(others)}. {choosing} chooses one")


@asynccontextmanager
async def sessions(
    url: str, options: LinkOptions, *, writes: bool = False, is_live: bool = False
) -> AsyncIterator[Sessions]:
    """Open a link, and yield a session for each vehicle that --vehicle names.

    Args:
        url: the link.
        options: the vehicle, its extended parameters or the plain ones, and the options of the link.
        writes: whether several vehicles are an error, unless --vehicle names one or all.
        is_live: read a log in real time; otherwise it is read at full speed, unless its name gives a speed.

    Raises:
        UsageError: no such link, or options that exclude each other.
        AmbiguousVehicle: with `writes`, several vehicles were heard.
        NoReply: the vehicle was not heard.
        LinkError: the link cannot be opened, or failed.
    """
    choice, deadline = ChosenVehicle.parse(options.vehicle), Deadline(options.timeout)
    if choice.is_all and (options.timeout or math.inf) <= VEHICLES_LISTENING_TIME:
        listening = f"--vehicle all listens for vehicles for {VEHICLES_LISTENING_TIME:g} s"
        raise UsageError(f"--timeout {options.timeout:g} is too short: {listening} first")
    is_log = url.lower().startswith(f"{LinkKind.REPLAY}:")
    link = f"{url}?speed=0" if is_log and not is_live and "?speed=" not in url else url
    more = {"encoding": options.encoding, "listen_only": options.listen_only}
    async with open_client(link, options, cache=options.place, **more) as client:

        def known() -> list[Component]:
            return [each for each in client.components.values() if each.node.identification.has_parameters]

        if choice.is_all:
            with _waiting(client, "vehicles"):
                try:
                    found = await client.find_autopilots(timeout=deadline.heartbeat_timeout)
                except NoReply:
                    if client.listens_only or (writes and not options.extended) or not known():
                        raise
                    found = []
            if options.extended:
                found = await _with_parameters([each.ext for each in known()])
            elif not (writes or client.listens_only):
                found += await _with_parameters([each for each in known() if each not in found])
            if not found:
                what = f"a component with {'extended ' * options.extended}parameters"
                raise NoReply(what, attempts=0, waited=OTHERS_TIMEOUT)
        else:
            found = [await wait_for_vehicle(client, choice, deadline, only=writes)]
            found = [each.ext for each in found] if options.extended else found
        if writes:
            await wait_for_firmware(found, deadline)
        for each in found:
            if not each.is_extended and expects_extended(each.identity.vehicle_type, each.component):
                say(f"{each.system}/{each.component} usually has extended parameters: --extended uses them")
        yield Sessions(CommandSession(client, each, deadline, options, choice, writes) for each in found)


def open_client(url: str, options: TrafficOptions, **more: Any) -> ParamClient:
    """Return a client with the options of the command line, and further arguments of `ParamClient`.

    Raises:
        UsageError: no such link.
    """
    return ParamClient(url, tlog=options.tlog, signing=options.signing, system=options.source_system, **more)


# Vehicles


async def _with_parameters(components: Sequence[Component]) -> list[Component]:
    """Return the components that have a parameter, and print a line for each other."""

    async def ask(request: Callable[..., Awaitable[object]], *which: int) -> None:
        with suppress(NoReply, UnknownParameter):
            await request(*which, timeout=OTHERS_TIMEOUT)

    async with anyio.create_task_group() as tasks:
        for each in components:
            for first in (0, 1):  # some begin at 1
                tasks.start_soon(ask, each.get, first)
            tasks.start_soon(ask, each.fetch_all)  # some serve lists only
    for each in components:
        if each.count is None:
            hint = "" if each.is_extended else "; --extended uses extended ones"
            say(f"{node_in_words(each.node)} has no {noun_of(each)}s, or none in {OTHERS_TIMEOUT} s{hint}")
    return [each for each in components if each.count is not None]


async def wait_for_vehicle(
    client: ParamClient, choice: ChosenVehicle, deadline: Deadline, *, only: bool = False
) -> Component:
    """Wait for one vehicle; meanwhile, show on a terminal the awaited one and those that were heard.

    Args:
        client: an open client.
        choice: the vehicle.
        deadline: of the command.
        only: as `writes` in `sessions`.

    Raises:
        ParamClientError: as from `ParamClient.component` and `ParamClient.only_component`.
    """
    timeout = deadline.heartbeat_timeout
    if choice.uid is not None:
        return await _find_by_uid(client, choice.uid, timeout)
    address = (choice.system, choice.component)
    with _waiting(client, address_in_words(*address)):
        if not only:
            return await client.component(*address, timeout=timeout)
        try:
            return await client.only_component(*address, timeout=timeout)
        except AmbiguousVehicle:  # of the first two; the user chooses among all that are heard
            await anyio.sleep(HEARTBEAT_WAIT if timeout is None else min(HEARTBEAT_WAIT, timeout))
            with suppress(NoReply):
                await client.only_component(*address, timeout=RECHECK_TIMEOUT)
            raise


async def _find_by_uid(client: ParamClient, uid: str, timeout: float | None) -> Component:
    """Wait for the autopilot with a hardware id, and with the beginning of one also for a second.

    Raises:
        AmbiguousVehicle: several have this beginning.
        NoReply: none has it.
    """

    def fitting() -> list[Component]:
        return [each for each in client.autopilots if (each.identity.uid or "").startswith(uid)]

    awaited = f"a vehicle with hardware id {uid}"
    with _waiting(client, awaited), anyio.move_on_after(timeout):
        while not (found := fitting()):
            await client.core.link_task.wait_for_activity()
        if found[0].identity.uid != uid:
            await anyio.sleep(HEARTBEAT_WAIT)
        if len(found := fitting() or found) == 1:
            return found[0]
        words = [node_in_words(each.node) for each in found]
        what = f"{len(words)} vehicles on this link have hardware ids that begin with {uid}"
        raise AmbiguousVehicle(f"{what}: {', '.join(words)}.", vehicles=words, choose_by="system")
    raise NoReply(awaited, attempts=0, waited=timeout or 0.0, hint=received_in_words(client))


def _waiting(client: ParamClient, awaited: str) -> Status:
    return Status(f"waiting for {awaited} on {client.link.name}", heard=lambda: received_in_words(client))


def received_in_words(client: ParamClient) -> str:
    """Return what was received so far on the link."""
    return hint_of_link(client.core.station, client.bytes_received)


async def wait_for_firmware(vehicles: Sequence[Component], deadline: Deadline) -> None:
    """Wait until the firmware versions of vehicles are known, for at most `FIRMWARE_TIMEOUT`."""
    with anyio.move_on_after(deadline.left(FIRMWARE_TIMEOUT)):
        for each in vehicles:
            await each.wait_until_identified(FIRMWARE_TIMEOUT)


# Parameters that arguments name


async def get_chosen(
    session: CommandSession, given: Sequence[str], *, is_fetched: bool = False
) -> tuple[list[Param], dict[str, ParamClientError]]:
    """Read the parameters that names and patterns choose; return them, and the errors by name.

    With a pattern, the table is fetched, unless it is already. Values that were received or confirmed by that
    are not read again.
    """
    component = session.component
    if not is_fetched and (is_fetched := any(map(is_pattern, given))):
        await session.fetch()
    found: dict[str, Param | ParamClientError | None] = {}
    for text in given:
        names = [spelling(text, component)]
        if is_pattern(text):
            names = sorted(NameChoice([text]).divide(component.params)[0])
        elif is_fetched and session.client.listens_only and names[0] not in component.params:
            names = []
        if not names and component.session.table.missing():
            awaited = f"a parameter of {session.address} that matches {text}"
            found[text] = NoReply(awaited, attempts=0, waited=0.0)
        elif not names:
            nearest = nearest_names(text, component.params)
            what = f"{session.address} has no parameter that matches {text}{did_you_mean(nearest)}"
            found[text] = UnknownParameter(what, *component.address, name=text, nearest=nearest)
        for name in names:
            known = component.params.get(name) if is_fetched else None
            found[name] = None if known is None or known.trust is Trust.CACHED else known
    requested = [name for name, each in found.items() if each is None]

    async def read(name: str) -> None:
        try:
            found[name] = await component.get(name, timeout=session.deadline.left())
        except ParamClientError as error:
            found[name] = error

    with Status(f"waiting for {listed(requested)} of {session.label}"):
        async with anyio.create_task_group() as tasks:
            for name in requested:
                tasks.start_soon(read, name)
    errors = {name: each for name, each in found.items() if isinstance(each, ParamClientError)}
    await suggest_names(session, errors.values())
    return [each for each in found.values() if isinstance(each, Param)], errors


async def suggest_names(session: CommandSession, errors: Iterable[ParamClientError | None]) -> None:
    """Name similar parameters in the errors about names that the vehicle does not have.

    An error has none if the table was never fetched. It is fetched for that, but not over a slow link.
    """
    unknown = [each for each in errors if isinstance(each, UnknownParameter) and not each.nearest]
    if not unknown or (session.component.round_trip or math.inf) > QUICK_ROUND_TRIP:
        return
    with suppress(NoReply):
        await session.component.fetch_all(timeout=session.deadline.left(SUGGESTION_TIMEOUT))
    for error in unknown:
        if nearest := nearest_names(error.name or "", session.component.params):
            error.nearest, error.args = nearest, (str(error).partition(":")[0] + did_you_mean(nearest),)


def check_given(given: Iterable[str]) -> list[str]:
    """Return names and patterns without repetitions.

    Raises:
        UsageError: a name is not a valid param_id.
    """
    return [text if is_pattern(text) else check_name(text) for text in dict.fromkeys(given)]


def spelling(name: str, component: Component) -> str:
    """Return the vehicle's spelling of a name in upper or lower case.

    A name that fits several parameters in upper and lower case, and is none of them, is returned unchanged:
    the vehicle has no such parameter.
    """
    known = [each for each in component.params if each.upper() == name.upper()]
    return known[0] if len(known) == 1 else name
