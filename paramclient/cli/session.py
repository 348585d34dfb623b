"""An open link with its vehicle, and the deadline of a command."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from typing import Final

import anyio

from paramclient.cli.options import LinkOptions, TrafficOptions
from paramclient.client.client import ParamClient
from paramclient.client.component import Component
from paramclient.errors import AmbiguousVehicle, UsageError
from paramclient.links import LinkKind, ReplayLink, parse_link
from paramclient.links.names import names_service
from paramclient.protocol.params.fetch_result import Policy

__all__ = ["Deadline", "CommandSession", "connect", "listen"]

VEHICLE_TIMEOUT: Final = 10.0
"""Seconds to wait for the first heartbeat of a vehicle, without --timeout."""
RECHECK_TIMEOUT: Final = 2.5
"""Seconds to check that the vehicle is still the only one: no wait is needed unless the vehicle or the link
was lost in between."""


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
        """The present unix time in seconds; for a log, the time of the last frame read from it."""
        link = self.client.link
        at = link.at if isinstance(link, ReplayLink) else None
        return time.time() if at is None else at

    @property
    def label(self) -> str:
        """The component in words: `1/1 px4`."""
        component = self.component
        return f"{component.system}/{component.component} {component.autopilot}"

    async def check_only(self) -> None:
        """Check that the component is still the only one that matches the options.

        For subcommands that write, directly before the first write: other vehicles may have appeared.

        Raises:
            AmbiguousVehicle: another vehicle is on the link, or has replaced the component.
            NoReply: no vehicle is heard.
            LinkError: the link failed.
        """
        options, component = self.options, self.component
        found = await self.client.only_component(
            options.system,
            options.component,
            peer=options.peer,
            timeout=self.deadline.left(RECHECK_TIMEOUT),
        )
        if found is not component:
            heard = f"{found.system}/{found.component} {found.autopilot}"
            raise AmbiguousVehicle(
                f"{self.label} was chosen and is no longer heard; {heard} is heard instead. "
                "Nothing was written.",
                vehicles=(self.label, heard),
                choose_by=_difference(found, component),
            )


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
    ) as client:
        timeout = VEHICLE_TIMEOUT if options.timeout is None else deadline.left()
        find = client.only_component if only else client.component
        component = await find(options.system, options.component, peer=options.peer, timeout=timeout)
        yield CommandSession(client, component, deadline, options)


def listen(url: str, options: TrafficOptions, *, listen_only: bool = False) -> ParamClient:
    """Return a client that counts all traffic, and neither reads nor writes a cache.

    Raises:
        UsageError: no such link, or the URL of a service.
    """
    if names_service(url):
        raise UsageError(
            f"{url} is a service, which does not report the traffic of its links; run the command with the "
            "link itself"
        )
    return ParamClient(
        url,
        cache=False,
        traffic=True,
        signing=options.signing,
        listen_only=listen_only,
        tlog=options.tlog,
    )


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
