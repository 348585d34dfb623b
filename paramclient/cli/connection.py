"""A link, a vehicle on it, and the time that there is for both."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import anyio

from paramclient.cli.options import LinkOptions
from paramclient.client.client import ParamClient
from paramclient.client.component import Component
from paramclient.client.signing import Signing
from paramclient.errors import AmbiguousVehicle, UsageError
from paramclient.links import LinkKind, ReplayLink, parse_link
from paramclient.links.names import names_service
from paramclient.protocol.params.fetch_result import Policy

__all__ = ["Deadline", "Session", "connect", "listen"]

HEARING_PATIENCE: Final = 10.0
"""Seconds for a vehicle to be heard, where the user sets no limit."""
CHECKING_PATIENCE: Final = 2.5
"""Seconds for a vehicle to be seen to be still the only one: it is known, unless it was lost or its link was
away, and then it takes as long as before."""


class Deadline:
    """The moment at which everything is to be over.

    Args:
        seconds: from now; None for never.
    """

    def __init__(self, seconds: float | None) -> None:
        self._at = None if seconds is None else anyio.current_time() + seconds

    def left(self, at_most: float | None = None) -> float | None:
        """Seconds that are left, 0 when it is over; None without a limit, or `at_most` where given."""
        if self._at is None:
            return at_most
        left = max(self._at - anyio.current_time(), 0.0)
        return left if at_most is None else min(left, at_most)


@dataclass(frozen=True, slots=True)
class Session:
    """An open client and the component that the command is about."""

    client: ParamClient
    component: Component
    deadline: Deadline
    options: LinkOptions

    @property
    def now(self) -> float:
        """The time of day; of a log, when the last frame that was read from it was written."""
        link = self.client.link
        at = link.at if isinstance(link, ReplayLink) else None
        return time.time() if at is None else at

    @property
    def who(self) -> str:
        """The component in words: `1/1 px4`."""
        component = self.component
        return f"{component.system}/{component.component} {component.autopilot}"

    async def check_only(self) -> None:
        """Check that the component is still the only one that the options can mean.

        For commands that write, directly before they do: vehicles may come and go while others are read.

        Raises:
            AmbiguousVehicle: another vehicle is there, beside it or in its place.
            NoReply: no vehicle is there any more.
            LinkError: the link failed.
        """
        options, component = self.options, self.component
        patience = self.deadline.left(CHECKING_PATIENCE)
        found = await self.client.only_component(
            options.system, options.component, peer=options.peer, timeout=patience
        )
        if found is not component:
            heard = f"{found.system}/{found.component} {found.autopilot}"
            raise AmbiguousVehicle(
                f"{self.who} was chosen and is not heard any more, {heard} is. Nothing was written.",
                vehicles=(self.who, heard),
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
) -> AsyncIterator[Session]:
    """Open a link and wait for the component that the options name.

    A log is read as fast as it goes, unless its name says otherwise or somebody looks on live.

    Args:
        url: the link.
        options: which component, and how to reach it.
        policy, is_live: see `ParamClient` and above.
        only: whether several vehicles are an error, unless the options name one: for commands that write.

    Raises:
        UsageError: no such link, or options that exclude each other.
        AmbiguousVehicle: with `only`, several vehicles were heard.
        NoReply: the component was not heard.
        LinkError: the link cannot be opened, or failed.
    """
    if options.peer is not None and not options.split_peers:
        raise UsageError("--peer goes with --split-peers")
    deadline = Deadline(options.timeout)
    async with ParamClient(
        url if is_live else _at_once(url),
        cache=None if options.place is True else options.place,
        encoding=options.encoding,
        policy=policy,
        listen_only=options.listen_only,
        forward=options.forward,
        tlog=options.tlog,
        signing=options.signing,
        split_peers=options.split_peers,
    ) as client:
        patience = HEARING_PATIENCE if options.timeout is None else deadline.left()
        find = client.only_component if only else client.component
        component = await find(options.system, options.component, peer=options.peer, timeout=patience)
        yield Session(client, component, deadline, options)


def listen(
    url: str, signing: Signing | None = None, *, listen_only: bool = False, tlog: Path | None = None
) -> ParamClient:
    """A client that counts everything it hears, and neither reads nor writes a cache.

    Raises:
        UsageError: no such link, or a service in its place.
    """
    if names_service(url):
        raise UsageError("a service does not give the traffic of its links; ask where such a link is")
    return ParamClient(url, cache=False, traffic=True, signing=signing, listen_only=listen_only, tlog=tlog)


def _difference(found: Component, chosen: Component) -> str:
    """Return which argument tells two components apart."""
    if found.system != chosen.system:
        return "system"
    return "component" if found.component != chosen.component else "peer"


def _at_once(url: str) -> str:
    """The same link; a log whose name says nothing of the speed as fast as it goes."""
    if not url.lower().startswith(f"{LinkKind.REPLAY}:"):
        return url
    spec = parse_link(url)
    return spec.name if spec.options else replace(spec, options=(("speed", 0.0),)).name
