"""The subcommand restore: earlier states of vehicles, and what a restore without a time undoes."""

from __future__ import annotations

import shlex
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import anyio.to_thread

from paramclient.cache import ParamCache
from paramclient.cli.apply import ApplyJob, run_jobs
from paramclient.cli.file_output import described
from paramclient.cli.metadata import known_of_session
from paramclient.cli.options import ApplyFlags, LinkOptions
from paramclient.cli.output import local_time, say
from paramclient.cli.session import ChosenVehicle, CommandSession, sessions
from paramclient.cli.sources import (
    check_pattern,
    choose,
    fill_pattern,
    is_file,
    is_pattern_name,
    open_file,
)
from paramclient.cli.time_arguments import parse_when
from paramclient.errors import AlreadyRestored, CacheError, FileError, NotInCache, UnknownVehicle, UsageError
from paramclient.files import ParamFile
from paramclient.model.paramset import ParamSet, RestorePoint
from paramclient.model.wording import age_in_words, first_of
from paramclient.provision import restore as restore_state
from paramclient.provision.apply_restore import restore_categories
from paramclient.provision.inspection import wait_for_identity
from paramclient.provision.restore_point import load_restore_point

__all__ = ["restore"]

CHANGES_SHOWN_MAX: Final = 10
"""Parameters that a line names, so that it stays short; it gives the number of further ones."""

_OPTIONS: Final = ApplyFlags()


async def restore(url: str, when: str | None = None, /, *, options: ApplyFlags = _OPTIONS) -> int:
    """Restore an earlier state of a vehicle, with its own identity and calibration.

    Parameters that the state does not have are not changed. Identity and calibration are written if the state
    is that of this very vehicle: a snapshot, a backup that has its hardware id (as .json files do), or one
    whose name has it; or if --vehicle names the hardware id. On a terminal, the changes are shown and must be
    confirmed. The exit codes are those of apply.

    A time without a time zone is in the time zone of this computer, in which times are printed too, with its
    offset: 2026-11-20T14:00:00.000+01:00. A time in UTC ends with Z: 2026-11-20T13:00Z.

    Args:
        url: The link.
        when: A time, such as '2h ago' or '2026-11-20 14:00'; the number of a snapshot, from `history VEHICLE
            --snapshots`; or a backup file. Default: the state before the last apply, unless a restore ran
            since then. With --vehicle all, a time, or a backup file with {uid} or {system} in its name.
    """
    check_pattern("the file of --backup", options.backup, options)
    loader = _Loader.of(url, when, options)
    extended = options.extended or (loader.file is not None and loader.file.is_extended)
    async with sessions(url, options, writes=True, extended=extended) as found:

        async def job(session: CommandSession) -> ApplyJob:
            state = await loader.load(session)
            state.say(session.prefix)
            return ApplyJob(
                session,
                state.params,
                options,
                {"info": await known_of_session(session, None)},
                restore_state,
                await restore_categories(session.component, state.params),
                again=_command(url, state.name, session) if state.name else "",
                done=f"restored the state {state.point}" if state.point else "",
            )

        return await run_jobs(found, await found.work(job))


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
        say(f"{prefix}the state: {described(self.params)}")
        if self.point:
            say(f"{prefix}the state is that {self.point}; {self.changes}")


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
            return _State(
                await _as_own(choose(open_file(path), choice.component, session.component.system), session)
            )
        if self.file is not None:
            return _State(await _as_own(self.file.choose(choice.component), session))
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


async def _as_own(params: ParamSet, session: CommandSession) -> ParamSet:
    """Return the parameters of a backup file; as the vehicle's own, if the user names its hardware id.

    The id is named by --vehicle, or in the name of the file. A file that has another one keeps it.
    """
    await wait_for_identity(session.component)
    own, origin = session.component.identity, params.identity
    is_named = session.choice.uid is not None or (own.uid is not None and own.uid in params.source)
    if not is_named or own.uid is None or (origin is not None and origin.uid is not None):
        return params
    return replace(params, identity=own if origin is None else replace(origin, uid=own.uid))


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
