"""Work on every vehicle on a link (--all) of the subcommands fetch, get and set."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import anyio

from paramclient.cli.exit_codes import ExitCode, code_of
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import report
from paramclient.cli.session import CommandSession, connect, unheard_in_words
from paramclient.cli.targets import find_vehicles
from paramclient.errors import ParamClientError, UsageError
from paramclient.protocol.fetch import Policy

__all__ = [
    "Done",
    "address_text",
    "check_all",
    "check_expected",
    "every_vehicle",
    "failed_json",
    "report_failures",
    "run_on_all",
]

Worked = TypeVar("Worked")
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Done(Generic[Worked, T]):
    """The outcome of the work on one vehicle: its result, or the error that ended it."""

    vehicle: Worked
    result: T | None = None
    error: ParamClientError | None = None


def check_all(options: LinkOptions, *, extended: bool) -> None:
    """Check that no option excludes --all.

    Raises:
        UsageError: one does.
    """
    if options.system is not None or options.vehicle is not None:
        raise UsageError("--all excludes --system and --vehicle")
    if options.split_peers:
        raise UsageError("--all and --split-peers exclude each other: results are identified by system id")
    if extended:
        raise UsageError("--all is for the plain parameters of vehicles; without it, --extended is possible")


def check_expected(expect: int | None, *, all_: bool) -> None:
    """Check that --expect comes with --all.

    Raises:
        UsageError: it does not.
    """
    if expect is not None and not all_:
        raise UsageError("--expect needs --all")


@asynccontextmanager
async def every_vehicle(
    url: str, options: LinkOptions, *, expect: int | None = None, policy: Policy = Policy.AUTO
) -> AsyncIterator[list[CommandSession]]:
    """Open a link, listen for 3 s, and yield a session for each vehicle that was heard, by system id.

    Args:
        url: the link.
        options: the options of the link.
        expect: the number of vehicles to wait for instead, at most 10 s; or None.
        policy: as in `ParamClient`.

    Raises:
        UsageError: no such link.
        NoReply: no vehicle was heard, or fewer than expected.
        LinkError: the link cannot be opened, or failed.
    """
    async with connect(url, options, policy=policy) as session:
        vehicles = await find_vehicles(session.client, options.component, expect, session.deadline)
        if expect is None:
            for sentence in await unheard_in_words(session):
                report(f"{sentence} --expect waits longer for a number of vehicles")
        yield [replace(session, component=each) for each in vehicles]


async def run_on_all(
    vehicles: Sequence[Worked], work: Callable[[Worked], Awaitable[T]]
) -> list[Done[Worked, T]]:
    """Work on all vehicles concurrently; return the outcomes. A failure of one does not stop the others."""
    done: dict[int, Done[Worked, T]] = {}

    async def run(place: int, vehicle: Worked) -> None:
        try:
            done[place] = Done(vehicle, result=await work(vehicle))
        except ParamClientError as error:
            done[place] = Done(vehicle, error=error)

    async with anyio.create_task_group() as tasks:
        for place, vehicle in enumerate(vehicles):
            tasks.start_soon(run, place, vehicle)
    return [done[place] for place in sorted(done)]


def report_failures(done: Sequence[Done[CommandSession, T]]) -> int:
    """Print the errors of vehicles on which the work failed; return the exit code for them."""
    worst: int = ExitCode.DONE
    for each in done:
        if each.error is not None:
            report(f"{each.vehicle.label}: {each.error}")
            worst = max(worst, code_of(each.error))
    return worst


def failed_json(done: Sequence[Done[CommandSession, T]]) -> list[dict[str, object]]:
    """Return the JSON of the vehicles on which the work failed."""
    return [
        {
            "system": each.vehicle.component.system,
            "component": each.vehicle.component.component,
            "error": str(each.error),
        }
        for each in done
        if each.error is not None
    ]


def address_text(session: CommandSession) -> str:
    """Return system and component of a vehicle: `1/1`."""
    return f"{session.component.system}/{session.component.component}"
