"""The vehicles of apply, verify and restore, one or all on a link, and the wanted parameters of each."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeAlias

import anyio

from paramclient.cli.options import LinkOptions
from paramclient.cli.output import printable, say
from paramclient.cli.session import (
    VEHICLE_TIMEOUT,
    CommandSession,
    Deadline,
    connect,
    receiver_in_words,
    wait_for_firmware,
)
from paramclient.cli.sources import choose, is_file, open_file, resolve
from paramclient.client.client import ParamClient
from paramclient.client.component import Component
from paramclient.client.vehicle_search import VEHICLES_LISTENING_TIME, listen_for_vehicles
from paramclient.errors import FileError, UsageError
from paramclient.files import ParamFile
from paramclient.model.paramset import ParamSet
from paramclient.provision import overlay
from paramclient.provision.inspection import wait_for_identity

__all__ = [
    "PLACEHOLDERS",
    "Address",
    "Source",
    "Targets",
    "check_new",
    "check_pattern",
    "describe",
    "fill_pattern",
    "find_vehicles",
    "targets",
]

Address: TypeAlias = tuple[int, int]
"""System id and component id."""

PLACEHOLDERS: Final = ("{uid}", "{system}")
"""Placeholders in file names, which are replaced by the ids of the vehicle."""


@dataclass(frozen=True, slots=True)
class Targets:
    """An open client, and the vehicles to set up.

    Attributes:
        session: the open client, with the first vehicle.
        vehicles: the vehicles.
        all_vehicles: whether these are all vehicles on the link (--all).
    """

    session: CommandSession
    vehicles: list[Component]
    all_vehicles: bool

    @property
    def client(self) -> ParamClient:
        """The client."""
        return self.session.client

    @property
    def deadline(self) -> Deadline:
        """The deadline of the command."""
        return self.session.deadline

    async def announce_write(self) -> None:
        """Print a line on stderr for each vehicle to which the subcommand writes, unless it prints JSON.

        Also reports vehicles of the link that were not heard; see `CommandSession.report_unheard`.
        """
        if not self.session.options.json:
            for each in self.vehicles:
                say(printable(f"writing to {receiver_in_words(each)} on {self.client.link.name}"))
        await self.session.report_unheard()

    async def check_only(self) -> None:
        """See `CommandSession.check_only`; does nothing with --all, which names every vehicle."""
        if not self.all_vehicles:
            await self.session.check_only()


@asynccontextmanager
async def targets(
    url: str, options: LinkOptions, *, all_vehicles: bool, expect: int | None, only: bool
) -> AsyncIterator[Targets]:
    """Open a link and wait for the vehicle that the options name, or for all vehicles on the link.

    Args:
        url: the link.
        options: they name the vehicle.
        all_vehicles: wait for all vehicles.
        expect: the number of vehicles to wait for, or None.
        only: as in `connect`, for subcommands that write. Ignored with `all_vehicles`.

    Raises:
        UsageError: no such link, or options that exclude each other.
        AmbiguousVehicle: with `only`, several vehicles were heard, and the options name none.
        NoReply: no vehicle was heard, or fewer than expected.
        LinkError: the link cannot be opened, or failed.
    """
    if all_vehicles and (options.system is not None or options.vehicle is not None):
        raise UsageError(
            f"--all and {'--system' if options.vehicle is None else '--vehicle'} exclude each other"
        )
    if all_vehicles and options.split_peers:
        raise UsageError(
            "--all and --split-peers exclude each other: files and results are identified by system id"
        )
    if expect is not None and not all_vehicles:
        raise UsageError("--expect needs --all")
    async with connect(url, options, only=only and not all_vehicles) as session:
        vehicles = [session.component]
        if all_vehicles:
            vehicles = await find_vehicles(session.client, options.component, expect, session.deadline)
        if only:
            await wait_for_firmware(vehicles, session.deadline)
        yield Targets(session, vehicles, all_vehicles)


class Source:
    """The wanted parameters of vehicles: one set for all, or those of a file with a set for each system.

    Args:
        text: a file, or another source of parameters (see `paramclient.cli.sources`).
        over: the name of an overlay file, with the placeholders `{uid}` or `{system}`; or None.
        options: `component` selects the component in files.
        only: as in `connect`, if the source is a link: its values will be written.
    """

    def __init__(self, text: str, over: str | None, options: LinkOptions, *, only: bool) -> None:
        self._text = text
        self._over = over
        self._options = options
        self._only = only
        self._file: ParamFile | None = None
        self._set: ParamSet | None = None

    async def open(self) -> None:
        """Read the file, or fetch the source. The overlays are read later, for each vehicle.

        Raises:
            ParamClientError: as from `resolve`.
        """
        if is_file(self._text):
            self._file = open_file(self._text)
        else:
            self._set = await resolve(self._text, self._options, only=self._only)

    async def wanted(self, vehicles: list[Component]) -> dict[Address, ParamSet]:
        """Return the wanted parameters of each vehicle by address.

        Raises:
            FileError: the file has no set for a vehicle, or its overlay cannot be read.
            UsageError: an overlay is named by hardware id, and the vehicle reports none.
        """
        return {(each.system, each.component): await self._of(each) for each in vehicles}

    async def _of(self, vehicle: Component) -> ParamSet:
        base = self._set if self._file is None else self._choose(self._file, vehicle)
        assert base is not None
        if self._over is None:
            return base
        path = await fill_pattern(self._over, vehicle)
        if not is_file(path):
            raise FileError(f"no such file, which --overlay names for {describe(vehicle)}", source=path)
        return overlay(base, self._choose(open_file(path), vehicle))

    def _choose(self, file: ParamFile, vehicle: Component) -> ParamSet:
        return choose(file, self._options.component, vehicle.system)


async def fill_pattern(pattern: str, vehicle: Component) -> str:
    """Return a file name with the placeholders replaced by the vehicle's ids.

    Raises:
        UsageError: the name has `{uid}`, and the vehicle reports no hardware id.
    """
    if "{uid}" in pattern:
        await wait_for_identity(vehicle)
        uid = vehicle.identity.uid
        if uid is None:
            raise UsageError(f"{describe(vehicle)} does not report a hardware id, which {pattern} needs")
        pattern = pattern.replace("{uid}", uid)
    return pattern.replace("{system}", str(vehicle.system))


def check_pattern(option: str, pattern: str | None, *, all_vehicles: bool) -> None:
    """Check that a file name has a placeholder if there may be several vehicles.

    Raises:
        UsageError: it has none.
    """
    if pattern is not None and all_vehicles and not any(place in pattern for place in PLACEHOLDERS):
        raise UsageError(
            f"with --all, {option} needs {' or '.join(PLACEHOLDERS)} in the file name: {pattern}"
        )


def check_new(path: str) -> Path:
    """Return the path of a new file. An existing file may be the only copy of an earlier state.

    Raises:
        FileError: the file exists.
    """
    if Path(path).exists():
        raise FileError(
            "exists already, and may be the backup of an earlier run; choose another name", source=path
        )
    return Path(path)


def describe(vehicle: Component) -> str:
    """Return a vehicle in words: `1/1 px4`."""
    return f"{vehicle.system}/{vehicle.component} {vehicle.autopilot}"


async def find_vehicles(
    client: ParamClient, component: int | None, expect: int | None, deadline: Deadline
) -> list[Component]:
    """Return the vehicles on a link, by system id: those heard within 3 s, or as many as are expected.

    Args:
        client: the client.
        component: their component id; None for autopilots.
        expect: the number of vehicles to wait for, at most 10 s; or None.
        deadline: the deadline of the command.

    Raises:
        NoReply: fewer than expected were received.
        LinkError: the link failed.
    """
    return await listen_for_vehicles(
        lambda: _vehicles(client, component),
        expect=expect,
        timeout=deadline.left(VEHICLES_LISTENING_TIME if expect is None else VEHICLE_TIMEOUT),
        began=anyio.current_time(),
        check_open=client.core.check_open,
    )


def _vehicles(client: ParamClient, component: int | None) -> list[Component]:
    if component is None:
        return client.autopilots
    return [each for each in client.components.values() if each.component == component]
