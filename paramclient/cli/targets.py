"""Whom a set-up is about: one vehicle on a link or all of them, and what each of them shall have."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeAlias

import anyio

from paramclient.cli.connection import HEARING_PATIENCE, Deadline, Session, connect
from paramclient.cli.options import LinkOptions
from paramclient.cli.sources import choose, is_file, open_file, resolve
from paramclient.client.client import ParamClient, implementation_of
from paramclient.client.component import Component
from paramclient.errors import FileError, NoReply, UsageError
from paramclient.files import ParamFile
from paramclient.model.paramset import ParamSet
from paramclient.provision import overlay
from paramclient.provision.inspection import identified

__all__ = ["Address", "Source", "Targets", "check_new", "check_pattern", "of_vehicle", "targets", "who"]

Address: TypeAlias = tuple[int, int]

LISTENING_TIME: Final = 3.0
"""Seconds in which every vehicle has been heard, also on a link that loses two heartbeats of three."""
PAUSE: Final = 0.05
"""Seconds between two looks whether all that are expected have been heard."""
PLACES: Final = ("{uid}", "{system}")


@dataclass(frozen=True, slots=True)
class Targets:
    """An open client, and the vehicles that the command is about."""

    session: Session
    vehicles: list[Component]
    everybody: bool

    @property
    def client(self) -> ParamClient:
        """The client."""
        return self.session.client

    @property
    def deadline(self) -> Deadline:
        """The moment at which everything is to be over."""
        return self.session.deadline

    async def check_only(self) -> None:
        """See `Session.check_only`; with `everybody` every vehicle is named."""
        if not self.everybody:
            await self.session.check_only()


@asynccontextmanager
async def targets(
    url: str, options: LinkOptions, *, everybody: bool, expect: int | None, only: bool
) -> AsyncIterator[Targets]:
    """Open a link and wait for the vehicle that the options name, or listen for all that are there.

    Args:
        url: the link.
        options: which vehicle.
        everybody: all of them.
        expect: how many are waited for.
        only: as in `connect`: for commands that write. With `everybody` every vehicle is named.

    Raises:
        UsageError: no such link, or options that exclude each other.
        AmbiguousVehicle: with `only`, several vehicles were heard, and none is named.
        NoReply: nobody was heard, or fewer than expected.
        LinkError: the link cannot be opened, or failed.
    """
    if everybody and options.system is not None:
        raise UsageError("--all and --system exclude each other")
    if everybody and options.split_peers:
        raise UsageError("--all and --split-peers exclude each other: files and results go by system id")
    if expect is not None and not everybody:
        raise UsageError("--expect goes with --all")
    async with connect(url, options, only=only and not everybody) as session:
        vehicles = [session.component]
        if everybody:
            vehicles = await _all_heard(session.client, options.component, expect, session.deadline)
        yield Targets(session, vehicles, everybody)


class Source:
    """What vehicles shall have: one set for all of them, or those of a file that has one for each system.

    Args:
        text: a file, or another source of parameters (see `paramclient.cli.sources`).
        over: the name of a file that lies over it, with `{uid}` or `{system}` for the vehicle's own; or None.
        options: `component` chooses in files.
        only: as in `connect`, where it is a link: its values will be written.
    """

    def __init__(self, text: str, over: str | None, options: LinkOptions, *, only: bool) -> None:
        self._text = text
        self._over = over
        self._options = options
        self._only = only
        self._file: ParamFile | None = None
        self._set: ParamSet | None = None

    async def open(self) -> None:
        """Read it, or fetch it; the overlays are read when it is known of whom.

        Raises:
            ParamClientError: as from `resolve`.
        """
        if is_file(self._text):
            self._file = open_file(self._text)
        else:
            self._set = await resolve(self._text, self._options, only=self._only)

    async def wanted(self, vehicles: list[Component]) -> dict[Address, ParamSet]:
        """What each of them shall have, by address.

        Raises:
            FileError: there is nothing for one of them, or its overlay cannot be read.
            UsageError: an overlay is named by a hardware id that the vehicle does not give.
        """
        return {(each.system, each.component): await self._of(each) for each in vehicles}

    async def _of(self, vehicle: Component) -> ParamSet:
        base = self._set if self._file is None else self._choose(self._file, vehicle)
        assert base is not None
        if self._over is None:
            return base
        path = await of_vehicle(self._over, vehicle)
        if not is_file(path):
            raise FileError(
                f"there is no such file, which was to be laid over for {who(vehicle)}", source=path
            )
        return overlay(base, self._choose(open_file(path), vehicle))

    def _choose(self, file: ParamFile, vehicle: Component) -> ParamSet:
        return choose(file, self._options.component, vehicle.system)


async def of_vehicle(pattern: str, vehicle: Component) -> str:
    """A file's name, with the vehicle's own ids in the places for them.

    Raises:
        UsageError: it wants the hardware id, and the vehicle does not give one.
    """
    if "{uid}" in pattern:
        await identified(vehicle)
        uid = vehicle.identity.uid
        if uid is None:
            raise UsageError(f"{who(vehicle)} does not say its hardware id, which {pattern} needs")
        pattern = pattern.replace("{uid}", uid)
    return pattern.replace("{system}", str(vehicle.system))


def check_pattern(option: str, pattern: str | None, *, everybody: bool) -> None:
    """See that a file's name gives each vehicle a file of its own, where there are several.

    Raises:
        UsageError: it does not.
    """
    if pattern is not None and everybody and not any(place in pattern for place in PLACES):
        raise UsageError(f"{option} needs {' or '.join(PLACES)} in the name, to go with --all: {pattern}")


def check_new(path: str) -> Path:
    """A file that is to be written, and is not there: it may be the only copy of an earlier state.

    Raises:
        FileError: it is there.
    """
    if Path(path).exists():
        raise FileError(
            "is there already, and may be what an earlier run has kept; choose another name", source=path
        )
    return Path(path)


def who(vehicle: Component) -> str:
    """A vehicle in words: `1/1 px4`."""
    return f"{vehicle.system}/{vehicle.component} {vehicle.autopilot}"


async def _all_heard(
    client: ParamClient, component: int | None, expect: int | None, deadline: Deadline
) -> list[Component]:
    patience = deadline.left(LISTENING_TIME if expect is None else HEARING_PATIENCE)
    with anyio.move_on_after(patience):
        while expect is None or len(_vehicles(client, component)) < expect:
            implementation_of(client).check_open()
            await anyio.sleep(PAUSE)
    found = _vehicles(client, component)
    if expect is not None and len(found) < expect:
        heard = ", ".join(map(who, found)) or "nobody"
        raise NoReply(f"{expect} vehicles (heard: {heard})", attempts=0, waited=patience or 0.0)
    return found


def _vehicles(client: ParamClient, component: int | None) -> list[Component]:
    if component is None:
        return client.autopilots
    return [each for each in client.components.values() if each.component == component]
