"""The subcommands apply and restore."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Final, TypeAlias, TypeVar

import anyio
import anyio.to_thread
from cyclopts import Parameter

from paramclient.cli.confirmation import can_confirm, confirm
from paramclient.cli.exit_codes import ExitCode, code_of
from paramclient.cli.extended import (
    apply_extended,
    check_choice,
    is_extended_link,
    is_extended_source,
    restore_extended,
)
from paramclient.cli.file_output import described
from paramclient.cli.metadata import MetadataChoice, from_file, known_of_session
from paramclient.cli.options import Count, LinkOptions
from paramclient.cli.output import print_json, printable, progress_bar, report, say
from paramclient.cli.restore_states import (
    StateToRestore,
    check_when_for_all,
    load_states,
    restore_command,
)
from paramclient.cli.session import receiver_in_words
from paramclient.cli.setup_results import (
    NamedVehicle,
    applied_code,
    applied_json,
    interrupted_json,
    planned_code,
    planned_json,
    show_applied,
    show_interrupted,
    show_planned,
)
from paramclient.cli.sources import is_file, read_rules
from paramclient.cli.targets import (
    Address,
    Source,
    Targets,
    check_new,
    check_pattern,
    describe,
    fill_pattern,
    targets,
)
from paramclient.client.component import Component
from paramclient.errors import NoReply, ParamClientError, UsageError
from paramclient.metadata import Metadata
from paramclient.protocol.fetch import Progress
from paramclient.provision import ApplyProgress, ApplyResult, ApplyRow, Plan, verify_all
from paramclient.provision import apply_all as apply_to_all
from paramclient.provision import restore_all as restore_to_all
from paramclient.provision.fleet import compare_states

__all__ = ["apply", "restore"]

Include: TypeAlias = Annotated[tuple[str, ...], Parameter(show_default=False)]
"""Categories and globs of --include."""
AllVehicles: TypeAlias = Annotated[bool, Parameter(name="--all")]
"""The option --all."""
Result = TypeVar("Result")
Found = TypeVar("Found")

RATE_DELAY: Final = 0.5
"""Seconds of writing after which the rate is precise enough to be shown."""

_OPTIONS: Final = LinkOptions()


async def apply(
    url: str,
    file: str,
    /,
    *,
    include: Include = (),
    reboot: bool = False,
    allow_armed: bool = False,
    skip_invalid: bool = False,
    force: bool = False,
    durable: bool = False,
    backup: str | None = None,
    over: Annotated[str | None, Parameter(name="--overlay")] = None,
    all_vehicles: AllVehicles = False,
    expect: Count = None,
    dry_run: bool = False,
    renames: str | None = None,
    metadata: MetadataChoice = None,
    full: bool = False,
    extended: bool = False,
    yes: bool = False,
    options: LinkOptions = _OPTIONS,
) -> ExitCode:
    """Write the values of a parameter file to a vehicle, in dependency order, and verify each of them.

    The previous state is stored in the cache, for `restore`. On a terminal, the changes are shown and must be
    confirmed. Exit code 0: the vehicle has all values of the file. Exit code 1: some values differ. After an
    interruption, run the same command again to continue. If several vehicles are heard, --system must
    choose one, or --all must choose all.

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
        all_vehicles: Set up all vehicles on the link, concurrently.
        expect: With --all, wait for this number of vehicles, and fail with fewer.
        dry_run: Print the values that would be sent, and send none of them.
        renames: A JSON file of names that firmware versions have changed. A parameter that the vehicle does
            not have is looked up under its other name.
        metadata: A file that describes parameters, or vehicle to download the vehicle's own metadata: for the
            ranges of values, and for parameters that take effect only after a reboot.
        full: Also print parameters that are unchanged or left out.
        extended: Use extended parameters (PARAM_EXT_*), such as those of a camera. Not needed with a file of
            extended parameters.
        yes: Do not ask for confirmation.
    """
    if extended or is_extended_source(file):
        if include or reboot or over or all_vehicles or renames or metadata:
            raise UsageError(
                f"{file} has extended parameters; --include, --reboot, --overlay, --all, --renames and "
                "--metadata are for plain ones"
            )
        return await apply_extended(
            url, file, options, dry_run=dry_run, yes=yes, durable=durable, backup=backup
        )
    check_pattern("--overlay", over, all_vehicles=all_vehicles)
    check_pattern("--backup", backup, all_vehicles=all_vehicles)
    chosen = from_file(metadata)
    rules = read_rules(renames)
    values = Source(file, over, options, only=True)
    await values.open()
    async with targets(url, options, all_vehicles=all_vehicles, expect=expect, only=True) as found:
        wanted = await values.wanted(found.vehicles)
        info = await _described(found, metadata, chosen)
        backups = await _backups(backup, found.vehicles)
        show = _Output(found, as_json=options.json, is_fleet=all_vehicles, full=full)

        async def plans() -> tuple[dict[NamedVehicle, Plan], dict[NamedVehicle, ParamClientError]]:
            compared = verify_all(
                found.vehicles, wanted, include=include, info=info, force=force, renames=rules
            )
            fleet = await _within(found, compared)
            return show.by_vehicle(fleet.results), show.by_vehicle(fleet.errors)

        if dry_run:
            code = show.planned(*await plans(), reboot=reboot, skip_invalid=skip_invalid)
            return max(code, _armed(found, allow_armed=allow_armed))
        if not yes and can_confirm(options) and not await _confirm(*await plans(), reboot=reboot, full=full):
            return ExitCode.INCOMPLETE
        await found.announce_write()
        if options.no_cache and backup is None and not url.startswith("sim:"):
            say("the state before is not stored: --no-cache is given, and --backup is not")
        with show.progress_until_interrupted(f"setting {_title(found)}") as progress:
            fleet = await apply_to_all(
                found.vehicles,
                wanted,
                include=include,
                info=info,
                reboot=reboot,
                allow_armed=allow_armed,
                skip_invalid=skip_invalid,
                force=force,
                renames=rules,
                durable=durable,
                backup=None if backup is None else lambda each: backups[each.system, each.component],
                timeout=found.deadline.left(),
                progress=progress,
                before_writing=lambda _: found.check_only(),
            )
        return show.applied(show.by_vehicle(fleet.results), show.by_vehicle(fleet.errors))


async def restore(
    url: str,
    when: str | None = None,
    /,
    *,
    include: Include = (),
    reboot: bool = False,
    allow_armed: bool = False,
    force: bool = False,
    backup: str | None = None,
    all_vehicles: AllVehicles = False,
    expect: Count = None,
    dry_run: bool = False,
    full: bool = False,
    extended: bool = False,
    plain: bool = False,
    yes: bool = False,
    options: LinkOptions = _OPTIONS,
) -> ExitCode:
    """Restore an earlier state of a vehicle, with its own identity and calibration.

    Parameters that the state does not have are not changed. On a terminal, the changes are shown and must be
    confirmed. The exit codes are those of apply.

    A time without a time zone is in the time zone of this computer, in which times are printed too, with its
    offset: 2026-11-20T14:00:00.000+01:00. A time in UTC ends with Z: 2026-11-20T13:00Z.

    Args:
        url: The link.
        when: A time, such as '2h ago' or '2026-11-20 14:00'; the number of a snapshot, from `history VEHICLE
            --snapshots`; or a backup file. Default: the state before the last apply, unless a restore ran
            since then. With --all, a time, or a backup file with {uid} or {system} in its name.
        include: Include a category that is left out by default, or a name or pattern, as with apply.
        reboot: Reboot the vehicle if values take effect only after a reboot.
        allow_armed: Continue if the vehicle is armed.
        force: Send NaN and infinity also to PX4, which cannot save them and may stop, and to ArduPilot.
        backup: A new file for the current state of the vehicle. {uid} and {system} in the name are replaced
            by the vehicle's ids.
        all_vehicles: Restore all vehicles on the link, concurrently, each to its own earlier state.
        expect: With --all, wait for this number of vehicles, and fail with fewer.
        dry_run: Print the values that would be sent, and send none of them.
        full: Also print parameters that are unchanged or left out.
        extended: Restore the extended parameters (PARAM_EXT_*) of the component, such as a camera. Without
            this option, they are used if a camera or other payload answers a request for the first one.
        plain: Restore the plain parameters, even if the component has extended ones.
        yes: Do not ask for confirmation.
    """
    check_choice(extended=extended, plain=plain)
    is_plain_file = when is not None and is_file(when) and not is_extended_source(when)
    if extended or (
        not plain
        and not is_plain_file
        and not (all_vehicles and not (when is not None and is_extended_source(when)))
        and ((when is not None and is_extended_source(when)) or await is_extended_link(url, options))
    ):
        if include or reboot or allow_armed or force or all_vehicles or expect is not None:
            raise UsageError(
                "--include, --reboot, --allow-armed, --force, --all and --expect are for plain parameters"
            )
        return await restore_extended(url, when, options, dry_run=dry_run, yes=yes, backup=backup)
    if all_vehicles:
        check_when_for_all(when)
        check_pattern("--backup", backup, all_vehicles=True)
    async with targets(url, options, all_vehicles=all_vehicles, expect=expect, only=True) as found:
        states, failed = await load_states(found, url, when, options)
        show = _Output(found, as_json=options.json, is_fleet=all_vehicles, full=full)
        without = show.by_vehicle(failed)
        found = replace(
            found, vehicles=[each for each in found.vehicles if (each.system, each.component) in states]
        )
        show.states(states)
        show.continues_by(
            {
                address: restore_command(url, state.name, options, address if all_vehicles else None)
                for address, state in states.items()
                if state.name
            }
        )
        params = {address: state.params for address, state in states.items()}
        backups = await _backups(backup, found.vehicles)
        info = await _described(found, None, None)

        async def plans() -> tuple[dict[NamedVehicle, Plan], dict[NamedVehicle, ParamClientError]]:
            compared = compare_states(found.vehicles, params, include=include, info=info, force=force)
            fleet = await _within(found, compared)
            return show.by_vehicle(fleet.results), without | show.by_vehicle(fleet.errors)

        if dry_run:
            code = show.planned(*await plans(), reboot=reboot, skip_invalid=True)
            return max(code, _armed(found, allow_armed=allow_armed))
        if not yes and can_confirm(options) and not await _confirm(*await plans(), reboot=reboot, full=full):
            return ExitCode.INCOMPLETE
        await found.announce_write()
        with show.progress_until_interrupted(f"restoring {_title(found)}") as progress:
            fleet = await restore_to_all(
                found.vehicles,
                params,
                include=include,
                info=info,
                reboot=reboot,
                allow_armed=allow_armed,
                force=force,
                backup=None if backup is None else lambda each: backups[each.system, each.component],
                timeout=found.deadline.left(),
                progress=progress,
                before_writing=lambda _: found.check_only(),
            )
        code = show.applied(show.by_vehicle(fleet.results), without | show.by_vehicle(fleet.errors))
        ended = [address for address, result in fleet.results.items() if result.error is None]
        show.restored({address: states[address] for address in ended})
        return code


# Preparation


async def _described(
    found: Targets, choice: str | None, chosen: Metadata | None
) -> Callable[[Component], Metadata | None]:
    """Return a function that returns the metadata of a vehicle."""
    known = {
        (each.system, each.component): chosen
        or await known_of_session(replace(found.session, component=each), choice)
        for each in found.vehicles
    }
    return lambda component: known[component.system, component.component]


async def _backups(pattern: str | None, vehicles: list[Component]) -> dict[Address, Path]:
    """Return the backup file of each vehicle by address.

    Raises:
        UsageError: the pattern gives several vehicles one file.
        FileError: one of the files exists.
    """
    if pattern is None:
        return {}
    names = {(each.system, each.component): await fill_pattern(pattern, each) for each in vehicles}
    if len(set(names.values())) < len(names):
        raise UsageError(f"--backup {pattern} names one file for several vehicles")
    return {address: check_new(name) for address, name in names.items()}


async def _within(found: Targets, work: Awaitable[Result]) -> Result:
    """Await `work` until the deadline of the command.

    Raises:
        NoReply: the deadline has passed.
    """
    left = found.deadline.left()
    with anyio.move_on_after(left):
        return await work
    raise NoReply(f"the parameters of {_title(found)}", attempts=0, waited=left or 0.0)


def _armed(found: Targets, *, allow_armed: bool) -> ExitCode:
    """Report armed vehicles, to which `apply` would write nothing; return the exit code."""
    armed = [] if allow_armed else [each for each in found.vehicles if each.is_armed]
    for vehicle in armed:
        report(f"{describe(vehicle)} is armed; nothing would be set now without --allow-armed")
    return ExitCode.INCOMPLETE if armed else ExitCode.DONE


async def _confirm(
    plans: Mapping[NamedVehicle, Plan],
    errors: Mapping[NamedVehicle, ParamClientError],
    *,
    reboot: bool,
    full: bool,
) -> bool:
    """Show the changes and ask for confirmation. Return True without a prompt if there are none."""
    for vehicle, error in errors.items():
        report(f"{vehicle.label}: {error}")
    if not any(plan.steps or (reboot and plan.awaiting_reboot) for plan in plans.values()):
        return True
    show_planned(plans, reboot=reboot, full=full)
    return await confirm("go on?")


def _title(found: Targets) -> str:
    many = len(found.vehicles)
    return describe(found.vehicles[0]) if many == 1 else f"{many} vehicles"


# Results


class _Output:
    """Prints the results of a subcommand for one vehicle or several, and returns the exit code."""

    def __init__(self, found: Targets, *, as_json: bool, is_fleet: bool, full: bool) -> None:
        self._vehicles = {
            (each.system, each.component): NamedVehicle(
                each.system, each.component, describe(each), receiver_in_words(each), each.identity
            )
            for each in found.vehicles
        }
        self._as_json = as_json
        self._is_fleet = is_fleet
        self._full = full
        self._commands: Mapping[NamedVehicle, str] = {}

    def continues_by(self, commands: Mapping[Address, str]) -> None:
        """Set the commands that continue a set-up, for messages, where they are not the given command."""
        self._commands = self.by_vehicle(commands)

    def by_vehicle(self, results: Mapping[Address, Found]) -> dict[NamedVehicle, Found]:
        """Return results by vehicle instead of by address."""
        return {self._vehicles[address]: result for address, result in results.items()}

    def planned(
        self,
        plans: Mapping[NamedVehicle, Plan],
        errors: Mapping[NamedVehicle, ParamClientError],
        *,
        reboot: bool,
        skip_invalid: bool,
    ) -> ExitCode:
        """Print plans; return the exit code that `apply` is expected to have."""
        return self._print(
            plans,
            errors,
            lambda: show_planned(plans, reboot=reboot, full=self._full),
            planned_json,
            lambda plan: planned_code(plan, skip_invalid=skip_invalid),
        )

    def applied(
        self, results: Mapping[NamedVehicle, ApplyResult], errors: Mapping[NamedVehicle, ParamClientError]
    ) -> ExitCode:
        """Print the results of `apply` or `restore`; return the exit code."""
        return self._print(
            results,
            errors,
            lambda: show_applied(results, full=self._full, commands=self._commands),
            applied_json,
            applied_code,
        )

    def states(self, states: Mapping[Address, StateToRestore]) -> None:
        """Print the states to restore, and what their restore undoes, on stderr."""
        for address, state in states.items():
            start = f"{self._vehicles[address].label}: " if self._is_fleet else ""
            say(printable(f"{start}the state: {described(state.params)}"))
            if state.point:
                say(printable(f"{start}the state is that {state.point}; {state.changes}"))

    def restored(self, states: Mapping[Address, StateToRestore]) -> None:
        """Print the restore points that were written, on stderr."""
        for address, state in states.items():
            if state.point:
                say(printable(f"{self._vehicles[address].label}: restored the state {state.point}"))

    @contextmanager
    def progress_until_interrupted(self, title: str) -> Iterator[Callable[[Component, ApplyProgress], None]]:
        """Yield a function that draws the progress; on cancellation, print the outcomes so far."""
        rows: dict[NamedVehicle, dict[str, ApplyRow]] = {}
        steps: dict[NamedVehicle, tuple[int, int]] = {}
        began = 0.0
        try:
            with progress_bar(title) as draw:

                def update(component: Component, state: ApplyProgress) -> None:
                    nonlocal began
                    vehicle = self._vehicles[component.system, component.component]
                    steps[vehicle] = (state.done, state.total)
                    if state.row is not None:
                        rows.setdefault(vehicle, {})[state.row.name] = state.row.so_far
                        began = began or anyio.current_time()
                    if draw is not None and began:
                        done, total = (sum(numbers) for numbers in zip(*steps.values(), strict=True))
                        seconds = anyio.current_time() - began
                        rate = done / seconds if seconds > RATE_DELAY else 0.0
                        draw(Progress(done, total, rate, (total - done) / rate if rate else None))

                yield update
        except anyio.get_cancelled_exc_class():
            outcomes = {vehicle: list(each.values()) for vehicle, each in rows.items()}
            if self._as_json:
                self._print_documents(
                    [interrupted_json(each, outcomes.get(each, [])) for each in self._vehicles.values()]
                )
            else:
                show_interrupted(outcomes, self._commands)
            raise

    def _print(
        self,
        results: Mapping[NamedVehicle, Result],
        errors: Mapping[NamedVehicle, ParamClientError],
        show: Callable[[], None],
        as_document: Callable[..., object],
        code: Callable[[Result], ExitCode],
    ) -> ExitCode:
        """Print results and errors as tables or JSON; return the exit code.

        Raises:
            ParamClientError: the error of the vehicle, if the command is for one vehicle.
        """
        if errors and not self._is_fleet:
            raise next(iter(errors.values()))
        if self._as_json:
            documents = [as_document(vehicle, result, full=self._full) for vehicle, result in results.items()]
            self._print_documents(documents, errors)
        else:
            show()
        for vehicle, error in errors.items():
            report(f"{vehicle.label}: {error}")
        codes = [*map(code, results.values()), *map(code_of, errors.values())]
        return max(codes, default=ExitCode.DONE)

    def _print_documents(
        self, documents: Sequence[object], errors: Mapping[NamedVehicle, ParamClientError] | None = None
    ) -> None:
        if not self._is_fleet:
            print_json(documents[0])
            return
        failed = [
            {"system": vehicle.system, "component": vehicle.component, "error": str(error)}
            for vehicle, error in (errors or {}).items()
        ]
        print_json({"vehicles": documents, "errors": failed})
