"""The commands that set vehicles up: apply, verify, restore."""

from __future__ import annotations

import sys
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, TypeAlias, TypeVar

import anyio
import anyio.to_thread
from cyclopts import Parameter
from cyclopts.validators import Number

from paramclient.cache import ParamCache
from paramclient.cli.exit_codes import ExitCode, code_of
from paramclient.cli.metadata import MetadataChoice, from_file, known_of_session
from paramclient.cli.moments import parse_when
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import print_document, printable, progress_bar, report, say
from paramclient.cli.param_rows import described
from paramclient.cli.results import (
    Vehicle,
    applied_code,
    applied_doc,
    interrupted_doc,
    met_code,
    planned_code,
    planned_doc,
    show_applied,
    show_interrupted,
    show_planned,
    show_verified,
    verified_doc,
)
from paramclient.cli.sources import is_file, open_file
from paramclient.cli.targets import (
    Address,
    Source,
    Targets,
    check_new,
    check_pattern,
    of_vehicle,
    targets,
    who,
)
from paramclient.client.component import Component
from paramclient.client.local import local
from paramclient.errors import NoReply, NotInCache, ParamClientError, UnknownVehicle, UsageError
from paramclient.metadata import Metadata
from paramclient.model.paramset import ParamSet
from paramclient.protocol.params.fetch_result import Progress
from paramclient.provision import ApplyProgress, ApplyResult, ApplyRow, Plan, verify_all
from paramclient.provision import apply_all as apply_to_all
from paramclient.provision import restore as restore_to
from paramclient.provision.inspection import identified
from paramclient.provision.set_up import restored
from paramclient.provision.vehicle_params import before_last_apply

if TYPE_CHECKING:
    from paramclient.documents.setup import SetUpDoc

__all__ = ["apply", "restore", "verify"]

Include: TypeAlias = Annotated[tuple[str, ...], Parameter(show_default=False)]
Everybody: TypeAlias = Annotated[bool, Parameter(name="--all")]
Count: TypeAlias = Annotated[int | None, Parameter(validator=Number(gte=1, lte=255))]
Result = TypeVar("Result")
Found = TypeVar("Found")

RATE_AFTER: Final = 0.5
"""Seconds of writing after which it is worth telling how fast it goes."""

_OPTIONS: Final = LinkOptions()


async def apply(
    url: str,
    source: str,
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
    everybody: Everybody = False,
    expect: Count = None,
    dry_run: bool = False,
    metadata: MetadataChoice = None,
    full: bool = False,
    yes: bool = False,
    options: LinkOptions = _OPTIONS,
) -> ExitCode:
    """Bring a vehicle to the values of a parameter file, in an order that works, and prove each of them.

    What it had before is kept in the cache, for `restore`. On a terminal it is shown what will be set, and
    asked. Exit code 0 says that the vehicle has all of it, 1 that something is not as the file says. Ended
    in the middle, the same call goes on from what the vehicle has. Where several vehicles are heard, --system
    has to choose one, or --all takes all.

    Args:
        url: The link, such as udpin:0.0.0.0:14550, or sim:ardupilot for a simulated vehicle.
        source: A parameter file; or a vehicle in the cache, as cache:VEHICLE.
        include: A category of what is left out (identity, hardware, calibration, measured, counter, action,
            read-only, out-of-range), or a name or pattern such as "COMPASS_OFS*". It may be given again.
        reboot: Start the vehicle again where values count only from then on.
        allow_armed: Go on although it is armed.
        skip_invalid: Set the others although some values cannot be right.
        force: Send NaN and infinity also to PX4, which cannot save them and may stop, and to ArduPilot.
        durable: End only when the values and their lines of history are on the disk, past a loss of power.
        backup: A new file for what the vehicle has before; its ending tells the form. {uid} and {system} in
            it stand for the vehicle's own.
        over: A file that lies over the other, with {uid} or {system} in its name for the vehicle's own.
        everybody: Every vehicle that is heard on the link, side by side.
        expect: With --all, wait for so many vehicles, and fail with fewer.
        dry_run: Print what would be sent, and send none of it.
        metadata: A file that describes the parameters, or `vehicle` to ask the vehicle itself: for the ranges
            of values, and for what counts only from the next start on.
        full: Print also what is as it should be, or left out.
        yes: Do not ask.
    """
    check_pattern("--overlay", over, everybody=everybody)
    check_pattern("--backup", backup, everybody=everybody)
    chosen = from_file(metadata)
    values = Source(source, over, options, only=True)
    await values.open()
    async with targets(url, options, everybody=everybody, expect=expect, only=True) as found:
        wanted = await values.wanted(found.vehicles)
        info = await _described(found, metadata, chosen)
        backups = await _backups(backup, found.vehicles)
        show = _Show(found, as_json=options.json, is_fleet=everybody, full=full)

        async def plans() -> tuple[dict[Vehicle, Plan], dict[Vehicle, ParamClientError]]:
            compared = verify_all(found.vehicles, wanted, include=include, info=info, force=force)
            fleet = await _within(found, compared)
            return show.by_vehicle(fleet.results), show.by_vehicle(fleet.errors)

        if dry_run:
            code = show.planned(*await plans(), reboot=reboot, skip_invalid=skip_invalid)
            return max(code, _armed(found, allow_armed=allow_armed))
        if not yes and _is_asked(options) and not await _agrees(*await plans(), reboot=reboot, full=full):
            return ExitCode.INCOMPLETE
        if options.no_cache and backup is None and not url.startswith("sim:"):
            say("what the vehicle has before is kept nowhere: --no-cache, and no --backup")
        with show.ended_by_somebody(f"setting {_title(found)}") as tell:
            fleet = await apply_to_all(
                found.vehicles,
                wanted,
                include=include,
                info=info,
                reboot=reboot,
                allow_armed=allow_armed,
                skip_invalid=skip_invalid,
                force=force,
                durable=durable,
                backup=None if backup is None else lambda each: backups[each.system, each.component],
                timeout=found.deadline.left(),
                progress=tell,
                before_writing=lambda _: found.check_only(),
            )
        return show.applied(show.by_vehicle(fleet.results), show.by_vehicle(fleet.errors))


async def verify(
    url: str,
    source: str,
    /,
    *,
    include: Include = (),
    over: Annotated[str | None, Parameter(name="--overlay")] = None,
    everybody: Everybody = False,
    expect: Count = None,
    metadata: MetadataChoice = None,
    full: bool = False,
    options: LinkOptions = _OPTIONS,
) -> ExitCode:
    """Compare a vehicle with a parameter file; nothing is set.

    What the file does not name is not looked at, and what `apply` leaves out need not agree. Exit code 0
    says that the vehicle is as the file says, 1 that it is not.

    Args:
        url: The link.
        source: A parameter file; or a vehicle in the cache, as cache:VEHICLE.
        include: A category of what is left out, or a name or pattern, as with apply.
        over: A file that lies over the other, with {uid} or {system} in its name for the vehicle's own.
        everybody: Every vehicle that is heard on the link, side by side.
        expect: With --all, wait for so many vehicles, and fail with fewer.
        metadata: A file that describes the parameters, or `vehicle` to ask the vehicle itself: for the ranges
            of values, and for what counts only from the next start on.
        full: Print also what is as it should be, or left out.
    """
    check_pattern("--overlay", over, everybody=everybody)
    chosen = from_file(metadata)
    values = Source(source, over, options, only=False)
    await values.open()
    async with targets(url, options, everybody=everybody, expect=expect, only=False) as found:
        wanted = await values.wanted(found.vehicles)
        info = await _described(found, metadata, chosen)
        show = _Show(found, as_json=options.json, is_fleet=everybody, full=full)
        fleet = await _within(found, verify_all(found.vehicles, wanted, include=include, info=info))
        return show.verified(show.by_vehicle(fleet.results), show.by_vehicle(fleet.errors))


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
    dry_run: bool = False,
    full: bool = False,
    yes: bool = False,
    options: LinkOptions = _OPTIONS,
) -> ExitCode:
    """Bring an earlier state of a vehicle back, with its own identity and calibration.

    What the vehicle has and the state does not is left alone. On a terminal it is shown what will be set, and
    asked. The exit codes are those of apply.

    Args:
        url: The link.
        when: A moment, such as '2h ago' or '2026-11-20 14:00'; the number of a snapshot, from `history
            VEHICLE --snapshots`; or the file of a backup. Without it, the state before the last apply.
        include: A category of what is left out, or a name or pattern, as with apply.
        reboot: Start the vehicle again where values count only from then on.
        allow_armed: Go on although it is armed.
        force: Send NaN and infinity also to PX4, which cannot save them and may stop, and to ArduPilot.
        backup: A new file for what the vehicle has now.
        dry_run: Print what would be sent, and send none of it.
        full: Print also what is as it should be, or left out.
        yes: Do not ask.
    """
    async with targets(url, options, everybody=False, expect=None, only=True) as found:
        [vehicle] = found.vehicles
        state = await _state(found, vehicle, when, options)
        say(printable(f"the state: {described(state)}"))
        backups = await _backups(backup, found.vehicles)
        info = await _described(found, None, None)
        show = _Show(found, as_json=options.json, is_fleet=False, full=full)
        address = (vehicle.system, vehicle.component)

        async def plans() -> tuple[dict[Vehicle, Plan], dict[Vehicle, ParamClientError]]:
            whole = (*await restored(vehicle, state), *include)
            fleet = await _within(found, verify_all([vehicle], state, include=whole, info=info, force=force))
            return show.by_vehicle(fleet.results), show.by_vehicle(fleet.errors)

        if dry_run:
            code = show.planned(*await plans(), reboot=reboot, skip_invalid=True)
            return max(code, _armed(found, allow_armed=allow_armed))
        if not yes and _is_asked(options) and not await _agrees(*await plans(), reboot=reboot, full=full):
            return ExitCode.INCOMPLETE
        with show.ended_by_somebody(f"restoring {_title(found)}") as tell:
            result = await restore_to(
                vehicle,
                state,
                include=include,
                info=info(vehicle),
                reboot=reboot,
                allow_armed=allow_armed,
                force=force,
                backup=backups.get(address),
                timeout=found.deadline.left(),
                progress=lambda how_far: tell(vehicle, how_far),
                before_writing=found.check_only,
            )
        return show.applied(show.by_vehicle({address: result}), {})


# what goes before


async def _state(found: Targets, vehicle: Component, when: str | None, options: LinkOptions) -> ParamSet:
    """The state that is to come back."""
    if when is not None and is_file(when):
        return open_file(when).choose(options.component)
    moment = None if when is None else parse_when(when, time.time())
    cache = found.client.cache
    if cache is None:
        raise UsageError("earlier states are in the cache, and --no-cache excludes that; or name a file")
    await identified(vehicle)
    await local(vehicle).client.cache_writer.write_all()
    key, component = vehicle.identity.key, vehicle.component
    return await anyio.to_thread.run_sync(lambda: _kept(cache, key, component, moment))


def _kept(cache: ParamCache, key: str, component: int, moment: float | None) -> ParamSet:
    if moment is None:
        return before_last_apply(cache, key, component)
    try:
        return cache.state_at(key, component, moment)
    except UnknownVehicle:  # the user named no vehicle of the cache: this one was heard on the link
        what = f"the cache {cache.place} has no earlier state of {key}, component {component}"
        raise NotInCache(what) from None


async def _described(
    found: Targets, choice: str | None, chosen: Metadata | None
) -> Callable[[Component], Metadata | None]:
    """What is known of each vehicle's parameters."""
    known = {
        (each.system, each.component): chosen
        or await known_of_session(replace(found.session, component=each), choice)
        for each in found.vehicles
    }
    return lambda component: known[component.system, component.component]


async def _backups(pattern: str | None, vehicles: list[Component]) -> dict[Address, Path]:
    """The files for what each of them has before; none of them is there yet."""
    if pattern is None:
        return {}
    names = {(each.system, each.component): await of_vehicle(pattern, each) for each in vehicles}
    if len(set(names.values())) < len(names):
        raise UsageError(f"--backup {pattern} names one file for several vehicles")
    return {address: check_new(name) for address, name in names.items()}


async def _within(found: Targets, work: Awaitable[Result]) -> Result:
    """Do it in the time that is left."""
    left = found.deadline.left()
    with anyio.move_on_after(left):
        return await work
    raise NoReply(f"the parameters of {_title(found)}", attempts=0, waited=left or 0.0)


def _armed(found: Targets, *, allow_armed: bool) -> ExitCode:
    """Tell of vehicles on which nothing would be set for now."""
    armed = [] if allow_armed else [each for each in found.vehicles if each.is_armed]
    for vehicle in armed:
        report(f"{who(vehicle)} is armed; nothing would be set now without --allow-armed")
    return ExitCode.INCOMPLETE if armed else ExitCode.DONE


def _is_asked(options: LinkOptions) -> bool:
    """Whether there is somebody to ask."""
    return not options.json and sys.stdin.isatty() and sys.stderr.isatty()


async def _agrees(
    plans: Mapping[Vehicle, Plan], errors: Mapping[Vehicle, ParamClientError], *, reboot: bool, full: bool
) -> bool:
    """Show what will be sent, and ask. Nobody is asked where there is nothing to send."""
    for vehicle, error in errors.items():
        report(f"{vehicle.who}: {error}")
    if not any(plan.steps or (reboot and plan.unstarted) for plan in plans.values()):
        return True
    show_planned(plans, reboot=reboot, full=full)
    sys.stderr.write("go on? [y/N] ")
    sys.stderr.flush()
    await anyio.wait_readable(sys.stdin)  # a thread that reads could not be ended by Ctrl-C
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def _title(found: Targets) -> str:
    many = len(found.vehicles)
    return who(found.vehicles[0]) if many == 1 else f"{many} vehicles"


# what comes of it


class _Show:
    """Prints what came of a command, for one vehicle or for all of them, and gives the exit code."""

    def __init__(self, found: Targets, *, as_json: bool, is_fleet: bool, full: bool) -> None:
        self._vehicles = {
            (each.system, each.component): Vehicle(each.system, each.component, who(each))
            for each in found.vehicles
        }
        self._as_json = as_json
        self._is_fleet = is_fleet
        self._full = full

    def by_vehicle(self, results: Mapping[Address, Found]) -> dict[Vehicle, Found]:
        return {self._vehicles[address]: result for address, result in results.items()}

    def planned(
        self,
        plans: Mapping[Vehicle, Plan],
        errors: Mapping[Vehicle, ParamClientError],
        *,
        reboot: bool,
        skip_invalid: bool,
    ) -> ExitCode:
        return self._tell(
            plans,
            errors,
            lambda: show_planned(plans, reboot=reboot, full=self._full),
            planned_doc,
            lambda plan: planned_code(plan, skip_invalid=skip_invalid),
        )

    def applied(
        self, results: Mapping[Vehicle, ApplyResult], errors: Mapping[Vehicle, ParamClientError]
    ) -> ExitCode:
        return self._tell(
            results, errors, lambda: show_applied(results, full=self._full), applied_doc, applied_code
        )

    def verified(self, plans: Mapping[Vehicle, Plan], errors: Mapping[Vehicle, ParamClientError]) -> ExitCode:
        return self._tell(
            plans, errors, lambda: show_verified(plans, full=self._full), verified_doc, met_code
        )

    @contextmanager
    def ended_by_somebody(self, title: str) -> Iterator[Callable[[Component, ApplyProgress], None]]:
        """What is to be told how far it is; it draws that, and tells what became of it on Ctrl-C."""
        rows: dict[Vehicle, dict[str, ApplyRow]] = {}
        steps: dict[Vehicle, tuple[int, int]] = {}
        began = 0.0
        try:
            with progress_bar(title) as draw:

                def tell(component: Component, how_far: ApplyProgress) -> None:
                    nonlocal began
                    vehicle = self._vehicles[component.system, component.component]
                    steps[vehicle] = (how_far.done, how_far.total)
                    if how_far.row is not None:
                        rows.setdefault(vehicle, {})[how_far.row.name] = how_far.row.so_far
                        began = began or anyio.current_time()
                    if draw is not None and began:
                        done, total = (sum(numbers) for numbers in zip(*steps.values(), strict=True))
                        seconds = anyio.current_time() - began
                        rate = done / seconds if seconds > RATE_AFTER else 0.0
                        draw(Progress(done, total, rate, (total - done) / rate if rate else None))

                yield tell
        except anyio.get_cancelled_exc_class():
            told = {vehicle: list(each.values()) for vehicle, each in rows.items()}
            if self._as_json:
                self._print_documents(
                    [interrupted_doc(each, told.get(each, [])) for each in self._vehicles.values()]
                )
            else:
                show_interrupted(told)
            raise

    def _tell(
        self,
        results: Mapping[Vehicle, Result],
        errors: Mapping[Vehicle, ParamClientError],
        show: Callable[[], None],
        as_document: Callable[..., SetUpDoc],
        code: Callable[[Result], ExitCode],
    ) -> ExitCode:
        """Print it in one form or the other; an error of a vehicle that is alone is the command's."""
        if errors and not self._is_fleet:
            raise next(iter(errors.values()))
        if self._as_json:
            told = [as_document(vehicle, result, full=self._full) for vehicle, result in results.items()]
            self._print_documents(told, errors)
        else:
            show()
        for vehicle, error in errors.items():
            report(f"{vehicle.who}: {error}")
        codes = [*map(code, results.values()), *map(code_of, errors.values())]
        return max(codes, default=ExitCode.DONE)

    def _print_documents(
        self, told: Sequence[SetUpDoc], errors: Mapping[Vehicle, ParamClientError] | None = None
    ) -> None:
        if not self._is_fleet:
            print_document(told[0])
            return
        from paramclient.documents.setup import FleetSetupDoc  # only here: loads pydantic

        failed = {(vehicle.system, vehicle.component): error for vehicle, error in (errors or {}).items()}
        print_document(FleetSetupDoc.of(told, failed))
