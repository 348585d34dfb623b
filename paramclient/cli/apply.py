"""The subcommand apply, and what it shares with restore: the plan, the confirmation, the writes."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Final, TypeVar

import anyio
from cyclopts import Parameter

from paramclient.cli.confirmation import can_confirm, confirm
from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.metadata import MetadataChoice, from_file, known_of_session
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import say
from paramclient.cli.session import CommandSession, Sessions, sessions
from paramclient.cli.setup_results import Address, SetupOutput
from paramclient.cli.sources import (
    check_new,
    check_pattern,
    choose,
    fill_pattern,
    is_file,
    open_file,
    read_rules,
    resolve,
)
from paramclient.client.component import Component
from paramclient.errors import FileError, NoReply, UsageError
from paramclient.metadata import Metadata
from paramclient.model.paramset import ParamSet
from paramclient.provision import ApplyProgress, FleetApplied, FleetVerified, apply_all, overlay, verify_all

__all__ = ["apply", "backups_of", "metadata_of_all", "set_up", "within"]

Result = TypeVar("Result")

_OPTIONS: Final = LinkOptions()


async def apply(
    url: str,
    file: str,
    /,
    *,
    include: tuple[str, ...] = (),
    reboot: bool = False,
    allow_armed: bool = False,
    skip_invalid: bool = False,
    force: bool = False,
    durable: bool = False,
    backup: str | None = None,
    over: Annotated[str | None, Parameter(name="--overlay")] = None,
    dry_run: bool = False,
    renames: str | None = None,
    metadata: MetadataChoice = None,
    full: bool = False,
    extended: bool = False,
    yes: bool = False,
    options: LinkOptions = _OPTIONS,
) -> int:
    """Write the values of a parameter file to a vehicle, in dependency order, and verify each of them.

    The previous state is stored in the cache, for `restore`. On a terminal, the changes are shown and must be
    confirmed. Exit code 0: the vehicle has all values of the file. Exit code 1: some values differ. After an
    interruption, run the same command again to continue. If several vehicles are heard, --vehicle must
    choose one, or all.

    Args:
        url: The link, such as udpin:0.0.0.0:14550, or sim:ardupilot for a simulated vehicle.
        file: A parameter file; or a vehicle in the cache, as cache:VEHICLE.
        include: Include a category that is left out by default (identity, hardware, calibration, measured,
            counter, action, read-only, out-of-range), or a name or pattern such as "COMPASS_OFS*". May be
            given several times.
        reboot: Reboot the vehicle if values take effect only after a reboot.
        allow_armed: Continue if the vehicle is armed.
        skip_invalid: Skip invalid values and write the remaining ones.
        force: Send NaN and infinity also to PX4, which cannot save them and may stop, and to ArduPilot.
        durable: End only when the values and their history are on the disk and survive a power loss.
        backup: A new file for the state before the first write; its extension determines the file format.
            {uid} and {system} in the name are replaced by the vehicle's ids.
        over: A file whose parameters replace and extend those of FILE, with {uid} or {system} in its name
            for the vehicle's ids.
        dry_run: Print the values that would be sent, and send none of them.
        renames: A JSON file of names that firmware versions have changed. A parameter that the vehicle does
            not have is looked up under its other name.
        metadata: A file that describes parameters, or vehicle to download the vehicle's own metadata: for the
            ranges of values, and for parameters that take effect only after a reboot.
        full: Also print parameters that are unchanged or left out.
        extended: Extended parameters (PARAM_EXT_*), such as a camera's. Not needed with a file of them.
        yes: Do not ask for confirmation.
    """
    check_pattern("the file of --overlay", over, options)
    check_pattern("the file of --backup", backup, options)
    given, rules = from_file(metadata), read_rules(renames)
    opened = open_file(file, partial=skip_invalid) if is_file(file) else None
    params = await resolve(file, options, writes=True, extended=extended) if opened is None else None
    extended = extended or (opened is not None and opened.is_extended)
    async with sessions(url, options, writes=True, extended=extended) as found:
        wanted: dict[Address, ParamSet] = {}
        for each in found:
            system, component = each.component.system, each.component.component
            base = params
            if opened is not None:
                base = choose(opened, each.choice.component, system)
            assert base is not None
            wanted[system, component] = base if over is None else await _with_overlay(base, over, each)
        info = await metadata_of_all(found, metadata, given)
        backups = await backups_of(backup, found)
        components = [each.component for each in found]
        show = SetupOutput(found, full=full)

        async def plans() -> FleetVerified:
            return await verify_all(
                components, wanted, include=include, info=info, force=force, renames=rules
            )

        async def write(progress: Callable[[Component, ApplyProgress], None]) -> FleetApplied:
            return await apply_all(
                components,
                wanted,
                include=include,
                info=info,
                reboot=reboot,
                allow_armed=allow_armed,
                skip_invalid=skip_invalid,
                force=force,
                renames=rules,
                durable=durable,
                backup=backups,
                timeout=found[0].deadline.left(),
                progress=progress,
                before_writing=lambda _: found[0].check_only(),
            )

        if dry_run:
            return show.planned(
                await within(found, plans()),
                reboot=reboot,
                skip_invalid=skip_invalid,
                allow_armed=allow_armed,
            )
        if options.no_cache and backup is None and not url.startswith("sim:"):
            say("the state before is not stored: --no-cache is given, and --backup is not")
        done = await set_up(found, show, plans, write, verb="setting", reboot=reboot, yes=yes)
        code = ExitCode.INCOMPLETE if done is None else show.applied(done)
        return max(code, ExitCode.INCOMPLETE) if opened is not None and opened.left_out else code


async def _with_overlay(base: ParamSet, pattern: str, session: CommandSession) -> ParamSet:
    path = await fill_pattern(pattern, session)
    if not is_file(path):
        raise FileError(f"no such file, which --overlay names for {session.label}", source=path)
    own = choose(open_file(path), session.choice.component, session.component.system)
    return overlay(base, own)


# Shared with restore


async def set_up(
    found: Sessions,
    show: SetupOutput,
    plans: Callable[[], Awaitable[FleetVerified]],
    write: Callable[[Callable[[Component, ApplyProgress], None]], Awaitable[FleetApplied]],
    *,
    verb: str,
    reboot: bool,
    yes: bool,
) -> FleetApplied | None:
    """Show the changes and ask for confirmation on a terminal, then write; None without confirmation."""
    if not yes and can_confirm(found[0].options):
        fleet = await within(found, plans())
        show.report_errors(fleet.errors)
        if any(plan.steps or (reboot and plan.awaiting_reboot) for plan in fleet.results.values()):
            show.show_planned(fleet, reboot=reboot)
            if not await confirm("go on?"):
                return None
    await found.announce_write()
    with show.progress_until_interrupted(f"{verb} {_title(found)}") as progress:
        return await write(progress)


async def metadata_of_all(
    found: Sequence[CommandSession], choice: str | None, given: Metadata | None
) -> Callable[[Component], Metadata | None]:
    """Return a function that returns the metadata of a vehicle."""
    known = {each.component.system: given or await known_of_session(each, choice) for each in found}
    return lambda component: known[component.system]


async def backups_of(
    pattern: str | None, found: Sequence[CommandSession]
) -> Callable[[Component], Path] | None:
    """Return a function that returns the backup file of a vehicle; None without a pattern.

    Raises:
        UsageError: the pattern gives several vehicles one file.
        FileError: one of the files exists.
    """
    if pattern is None:
        return None
    names = {each.component.system: await fill_pattern(pattern, each) for each in found}
    if len(set(names.values())) < len(names):
        raise UsageError(f"--backup {pattern} names one file for several vehicles")
    paths: Mapping[int, Path] = {system: check_new(name) for system, name in names.items()}
    return lambda component: paths[component.system]


async def within(found: Sequence[CommandSession], work: Awaitable[Result]) -> Result:
    """Await `work` until the deadline of the command.

    Raises:
        NoReply: the deadline has passed.
    """
    left = found[0].deadline.left()
    with anyio.move_on_after(left):
        return await work
    raise NoReply(f"the parameters of {_title(found)}", attempts=0, waited=left or 0.0)


def _title(found: Sequence[CommandSession]) -> str:
    return found[0].label if len(found) == 1 else f"{len(found)} vehicles"
