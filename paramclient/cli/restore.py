"""The subcommand restore: earlier states of vehicles, and what a restore without a time undoes."""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import anyio.to_thread

from paramclient.cache import ParamCache
from paramclient.cli.apply import backups_of, metadata_of_all, set_up, within
from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.file_output import described
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import local_time, printable, say
from paramclient.cli.session import ChosenVehicle, CommandSession, sessions
from paramclient.cli.setup_results import Address, SetupOutput
from paramclient.cli.sources import (
    check_pattern,
    choose,
    fill_pattern,
    is_file,
    is_pattern_name,
    open_file,
)
from paramclient.cli.time_arguments import parse_when
from paramclient.client.component import Component
from paramclient.errors import (
    AlreadyRestored,
    CacheError,
    FileError,
    NotInCache,
    ParamClientError,
    UnknownVehicle,
    UsageError,
)
from paramclient.files import ParamFile
from paramclient.model.paramset import ParamSet, RestorePoint
from paramclient.model.wording import age_in_words, first_of
from paramclient.provision import ApplyProgress, FleetApplied, FleetVerified, restore_all
from paramclient.provision.fleet import compare_states
from paramclient.provision.inspection import wait_for_identity
from paramclient.provision.restore_point import load_restore_point

__all__ = ["restore"]

CHANGES_SHOWN_MAX: Final = 10
"""Parameters that a line names, so that it stays short; it gives the number of further ones."""

_OPTIONS: Final = LinkOptions()


async def restore(
    url: str,
    when: str | None = None,
    /,
    *,
    include: tuple[str, ...] = (),
    reboot: bool = False,
    allow_armed: bool = False,
    force: bool = False,
    backup: str | None = None,
    dry_run: bool = False,
    full: bool = False,
    extended: bool = False,
    yes: bool = False,
    options: LinkOptions = _OPTIONS,
) -> int:
    """Restore an earlier state of a vehicle, with its own identity and calibration.

    Parameters that the state does not have are not changed. On a terminal, the changes are shown and must be
    confirmed. The exit codes are those of apply.

    A time without a time zone is in the time zone of this computer, in which times are printed too, with its
    offset: 2026-11-20T14:00:00.000+01:00. A time in UTC ends with Z: 2026-11-20T13:00Z.

    Args:
        url: The link.
        when: A time, such as '2h ago' or '2026-11-20 14:00'; the number of a snapshot, from `history VEHICLE
            --snapshots`; or a backup file. Default: the state before the last apply, unless a restore ran
            since then. With --vehicle all, a time, or a backup file with {uid} or {system} in its name.
        include: Include a category that is left out by default, or a name or pattern, as with apply.
        reboot: Reboot the vehicle if values take effect only after a reboot.
        allow_armed: Continue if the vehicle is armed.
        force: Send NaN and infinity also to PX4, which cannot save them and may stop, and to ArduPilot.
        backup: A new file for the current state of the vehicle. {uid} and {system} in the name are replaced
            by the vehicle's ids.
        dry_run: Print the values that would be sent, and send none of them.
        full: Also print parameters that are unchanged or left out.
        extended: Extended parameters (PARAM_EXT_*), such as a camera's. Not needed with a file of them.
        yes: Do not ask for confirmation.
    """
    check_pattern("the file of --backup", backup, options)
    loader = _Loader.of(url, when, options)
    extended = extended or (loader.file is not None and loader.file.is_extended)
    async with sessions(url, options, writes=True, extended=extended) as found:
        states: dict[Address, _State] = {}
        failed: dict[Address, ParamClientError] = {}
        for each in found:
            address = (each.component.system, each.component.component)
            try:
                states[address] = await loader.load(each)
            except ParamClientError as error:
                if not each.choice.is_all:
                    raise
                failed[address] = error
        by_address = {(each.component.system, each.component.component): each for each in found}
        commands = {
            address: _command(url, state.name, by_address[address])
            for address, state in states.items()
            if state.name
        }
        show = SetupOutput(found, full=full, commands=commands)
        for address, state in states.items():
            state.say(by_address[address].prefix)
        components = [by_address[address].component for address in states]
        params = {address: state.params for address, state in states.items()}
        info, backups = await metadata_of_all(found, None, None), await backups_of(backup, found)

        async def plans() -> FleetVerified:
            fleet = await compare_states(components, params, include=include, info=info, force=force)
            return FleetVerified(fleet.results, {**failed, **fleet.errors})

        async def write(progress: Callable[[Component, ApplyProgress], None]) -> FleetApplied:
            fleet = await restore_all(
                components,
                params,
                include=include,
                info=info,
                reboot=reboot,
                allow_armed=allow_armed,
                force=force,
                backup=backups,
                timeout=found[0].deadline.left(),
                progress=progress,
                before_writing=lambda _: found[0].check_only(),
            )
            return FleetApplied(fleet.results, {**failed, **fleet.errors})

        if dry_run:
            return show.planned(
                await within(found, plans()), reboot=reboot, skip_invalid=True, allow_armed=allow_armed
            )
        done = await set_up(found, show, plans, write, verb="restoring", reboot=reboot, yes=yes)
        if done is None:
            return ExitCode.INCOMPLETE
        code = show.applied(done)
        for address, result in done.results.items():
            if result.error is None and states[address].point:
                label = by_address[address].label
                say(printable(f"{label}: restored the state {states[address].point}"))
        return code


@dataclass(frozen=True, slots=True)
class _State:
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

    @classmethod
    def before_apply(cls, point: RestorePoint) -> _State:
        """Return the state before the last apply, with what its restore undoes."""
        now = time.time()
        changes = [f"{name} {age_in_words(now - at)} ago" for name, at in point.changes.items()]
        return cls(
            point.state,
            f"before the last apply, {age_in_words(now - point.at)} ago (snapshot {point.snapshot})",
            f"changed since then: {first_of(changes, CHANGES_SHOWN_MAX)}"
            if changes
            else "nothing is known to have changed since then",
            str(point.snapshot),
        )

    def say(self, prefix: str) -> None:
        """Print the state, and what its restore undoes, on stderr."""
        say(printable(f"{prefix}the state: {described(self.params)}"))
        if self.point:
            say(printable(f"{prefix}the state is that {self.point}; {self.changes}"))


@dataclass(frozen=True, slots=True)
class _Loader:
    """Loads the state of each vehicle: of a backup file, of a time, or before the last apply.

    Attributes:
        url: the link, for messages.
        pattern: the name of a backup file with placeholders, or None.
        file: the backup file, or None.
        moment: a time or the number of a snapshot, or None.
    """

    url: str
    pattern: str | None = None
    file: ParamFile | None = None
    moment: float | int | None = None

    @classmethod
    def of(cls, url: str, when: str | None, options: LinkOptions) -> _Loader:
        """Return the loader of the state that the user names.

        Raises:
            UsageError: it is no time and no file, or not one for several vehicles; or there is no cache.
        """
        is_all = ChosenVehicle.parse(options.vehicle).is_all
        if when is not None and is_all and is_pattern_name(when):
            return cls(url, pattern=when)
        if when is not None and is_file(when):
            check_pattern("the backup file", when, options)
            return cls(url, file=open_file(when))
        moment = None if when is None else parse_when(when, time.time())
        if is_all and isinstance(moment, int):
            raise UsageError(
                f"snapshot {when} is of one vehicle; with --vehicle all, give a time such as '2h ago'"
            )
        if options.place is False:
            raise UsageError(
                "earlier states are in the cache, which --no-cache excludes; leave out --no-cache, or name a "
                "backup file"
            )
        return cls(url, moment=moment)

    async def load(self, session: CommandSession) -> _State:
        """Return the state of a vehicle.

        Raises:
            ParamClientError: there is none.
        """
        choice = session.choice
        if self.pattern is not None:
            path = await fill_pattern(self.pattern, session)
            if not is_file(path):
                raise FileError("no such file", source=path)
            return _State(choose(open_file(path), choice.component, session.component.system))
        if self.file is not None:
            return _State(self.file.choose(choice.component))
        cache = session.client.cache
        if cache is None:
            raise NotInCache("earlier states are in the cache, which cannot be used")
        vehicle = session.component
        await wait_for_identity(vehicle)
        await vehicle.core.cache_writer.write_all()
        key, component, extended = vehicle.identity.key, vehicle.component, vehicle.is_extended
        moment = self.moment
        if moment is not None:
            state = await anyio.to_thread.run_sync(
                lambda: _state_at(cache, key, component, moment, extended=extended)
            )
            return _State(state, name="" if isinstance(moment, int) else local_time(moment))
        try:
            point = await anyio.to_thread.run_sync(
                lambda: load_restore_point(cache, key, component, extended=extended)
            )
        except NotInCache as error:
            raise NotInCache(f"{error}, such as '2h ago', or a backup file") from None
        except AlreadyRestored as error:
            raise _choices_error(error, self.url, session) from None
        except CacheError as error:
            raise CacheError(
                f"nothing was sent, as the state before the last apply cannot be read: {error}. A backup file"
                " can be restored without the cache (--no-cache)"
            ) from error
        return _State.before_apply(point)


def _state_at(cache: ParamCache, key: str, component: int, moment: float, *, extended: bool) -> ParamSet:
    try:
        return cache.state_at(key, component, moment, extended=extended)
    except UnknownVehicle:  # the vehicle was heard on the link; the user named none of the cache
        message = f"the cache {cache.place} has no earlier state of {key}, component {component}"
        raise NotInCache(message) from None


def _choices_error(error: AlreadyRestored, url: str, session: CommandSession) -> UsageError:
    """Return the error with the commands that choose a state."""

    def command(when: object) -> str:
        return f"`{_command(url, when, session)}`"

    more = " ".join([*_more(session), "--snapshots"])
    listing = f"`paramclient history {session.component.system} {more}`"
    seconds = max(1, int(time.time() - error.restored_at) + 1)
    return UsageError(
        f"{error.summary}; choose the state: {command(error.before_apply)} for the state before that apply, "
        f"also to continue that restore; {command(error.before_restore)} for the state before that restore; "
        f"or a time, as in {command(f'{seconds}s ago')}; {listing} lists the snapshots"
    )


def _command(url: str, when: object, session: CommandSession) -> str:
    """Return the command that restores a state of a vehicle, for messages."""
    vehicle = session.options.vehicle
    if session.choice.is_all:
        vehicle = str(session.component.system)
    chosen: Sequence[str] = () if vehicle is None else ("--vehicle", vehicle)
    return shlex.join(["paramclient", "restore", url, str(when), *chosen, *_more(session)])


def _more(session: CommandSession) -> Sequence[str]:
    return ("--extended",) if session.component.is_extended else ()
