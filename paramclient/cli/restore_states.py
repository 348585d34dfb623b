"""The states that `restore` writes, and what a restore without a time undoes."""

from __future__ import annotations

import shlex
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Final

import anyio.to_thread

from paramclient.cache import ParamCache
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import local_time
from paramclient.cli.sources import choose, is_file, open_file
from paramclient.cli.targets import PLACEHOLDERS, Address, Targets, check_pattern, fill_pattern
from paramclient.cli.time_arguments import parse_when
from paramclient.client.component import Component
from paramclient.errors import (
    AlreadyRestored,
    FileError,
    NotInCache,
    ParamClientError,
    UnknownVehicle,
    UsageError,
)
from paramclient.model.paramset import ParamSet, RestorePoint
from paramclient.model.wording import age_in_words, first_of
from paramclient.provision.inspection import wait_for_identity
from paramclient.provision.restore_point import load_restore_point

__all__ = [
    "StateToRestore",
    "check_when_for_all",
    "choices_error",
    "load_states",
    "named_state",
    "restore_command",
    "undone_by",
]

CHANGES_SHOWN_MAX: Final = 10
"""Parameters that a line names, so that it stays short; it gives the number of further ones."""


@dataclass(frozen=True, slots=True)
class StateToRestore:
    """The state to restore of one vehicle.

    Attributes:
        params: the state.
        point: the restore point in words, such as `before the last apply, 9 min ago (snapshot 4)`; "" for a
            state that the user chose.
        changes: the changes since then in words; "" for a state that the user chose.
        name: the state as the command takes it, to continue after an interruption; "" if that is the given
            one. A restore without a time is refused the second time, and an age is another time later.
    """

    params: ParamSet
    point: str = ""
    changes: str = ""
    name: str = ""


def check_when_for_all(when: str | None) -> None:
    """Check that the state that `restore --all` names can be that of several vehicles.

    Raises:
        UsageError: the number of a snapshot, which is of one vehicle; or one file for all vehicles.
    """
    if when is None or _is_pattern(when):
        return
    if is_file(when):
        check_pattern("the backup file", when, all_vehicles=True)
    if isinstance(parse_when(when, time.time()), int):
        raise UsageError(f"snapshot {when} is of one vehicle; with --all, give a time such as '2h ago'")


async def load_states(
    found: Targets, url: str, when: str | None, options: LinkOptions
) -> tuple[dict[Address, StateToRestore], dict[Address, ParamClientError]]:
    """Return the state to restore of each vehicle, and the error of each vehicle without one, by address.

    Args:
        found: the vehicles.
        url: the link, for messages.
        when: a time, the number of a snapshot, or a backup file; None for the state before the last `apply`.
        options: the options of the command.

    Raises:
        UsageError: not a time; or the command has no cache.
        ParamClientError: one vehicle was chosen, and has no such state.
    """
    load = _loader(found, url, when, options)
    states: dict[Address, StateToRestore] = {}
    errors: dict[Address, ParamClientError] = {}
    for vehicle in found.vehicles:
        address = (vehicle.system, vehicle.component)
        try:
            states[address] = await load(vehicle)
        except ParamClientError as error:
            if not found.all_vehicles:
                raise
            errors[address] = error
    return states, errors


def restore_command(url: str, when: object, options: LinkOptions, address: Address | None = None) -> str:
    """Return the command that restores a state, for messages.

    Args:
        url: the link.
        when: the state, as the command takes it.
        options: options of a command, of which those that choose the vehicle are repeated.
        address: the vehicle, if the options choose several.
    """
    chosen: dict[str, object] = {"system": options.system, "component": options.component}
    if options.vehicle is not None:
        chosen = {"vehicle": options.vehicle}
    if address is not None:
        chosen = {**chosen, "system": address[0]}
    chosen["peer"] = options.peer
    words = ["paramclient", "restore", url, str(when)]
    for name, value in chosen.items():
        words += [] if value is None else [f"--{name}", str(value)]
    return shlex.join(words)


def choices_error(
    error: AlreadyRestored,
    url: str,
    options: LinkOptions,
    vehicle: Component,
    address: Address | None = None,
    *,
    extended: bool = False,
) -> UsageError:
    """Return the error with the commands that choose a state.

    Args:
        error: the error.
        url, options, address: as in `restore_command`.
        vehicle: the vehicle.
        extended: whether the states are those of extended parameters.
    """

    def command(when: object) -> str:
        return f"`{restore_command(url, when, options, address)}`"

    system = vehicle.system
    listing = f"`paramclient history {system} {'--extended ' if extended else ''}--snapshots`"
    seconds = max(1, int(time.time() - error.restored_at) + 1)
    return UsageError(
        f"{error.summary}; choose the state: {command(error.before_apply)} for the state before that apply, "
        f"also to continue that restore; {command(error.before_restore)} for the state before that restore; "
        f"or a time, as in {command(f'{seconds}s ago')}; {listing} lists the snapshots"
    )


def _loader(
    found: Targets, url: str, when: str | None, options: LinkOptions
) -> Callable[[Component], Awaitable[StateToRestore]]:
    """Return a function that loads the state of a vehicle."""
    if when is not None and found.all_vehicles and _is_pattern(when):

        async def load(vehicle: Component) -> StateToRestore:
            path = await fill_pattern(when, vehicle)
            if not is_file(path):
                raise FileError("no such file", source=path)
            return StateToRestore(choose(open_file(path), options.component, vehicle.system))

        return load
    if when is not None and is_file(when):
        chosen = open_file(when).choose(options.component)

        async def load_file(vehicle: Component) -> StateToRestore:
            return StateToRestore(chosen)

        return load_file
    moment = None if when is None else parse_when(when, time.time())
    cache = found.client.cache
    if cache is None:
        raise UsageError(
            "earlier states are in the cache, which --no-cache excludes; leave out --no-cache, or name a "
            "backup file"
        )

    async def load_cached(vehicle: Component) -> StateToRestore:
        await wait_for_identity(vehicle)
        await vehicle.core.client.cache_writer.write_all()
        key, component = vehicle.identity.key, vehicle.component
        if moment is not None:
            return await anyio.to_thread.run_sync(lambda: _state_at(cache, key, component, moment))
        try:
            point = await anyio.to_thread.run_sync(lambda: load_restore_point(cache, key, component))
        except NotInCache as error:
            raise NotInCache(f"{error}, such as '2h ago', or a backup file") from None
        except AlreadyRestored as error:
            address = (vehicle.system, vehicle.component) if found.all_vehicles else None
            raise choices_error(error, url, options, vehicle, address) from None
        return undone_by(point)

    return load_cached


def _is_pattern(when: str) -> bool:
    return any(place in when for place in PLACEHOLDERS)


def _state_at(cache: ParamCache, key: str, component: int, moment: float) -> StateToRestore:
    try:
        return named_state(cache.state_at(key, component, moment), moment)
    except UnknownVehicle:  # the vehicle was heard on the link; the user named none of the cache
        message = f"the cache {cache.place} has no earlier state of {key}, component {component}"
        raise NotInCache(message) from None


def named_state(state: ParamSet, when: float) -> StateToRestore:
    """Return a state that was chosen by its time or by the number of a snapshot."""
    return StateToRestore(state, name="" if isinstance(when, int) else local_time(when))


def undone_by(point: RestorePoint) -> StateToRestore:
    """Return the state before the last `apply`, with what its restore undoes."""
    now = time.time()
    age = age_in_words(now - point.at)
    changes = [f"{name} {age_in_words(now - at)} ago" for name, at in point.changes.items()]
    return StateToRestore(
        point.state,
        f"before the last apply, {age} ago (snapshot {point.snapshot})",
        f"changed since then: {first_of(changes, CHANGES_SHOWN_MAX)}"
        if changes
        else "nothing is known to have changed since then",
        str(point.snapshot),
    )
