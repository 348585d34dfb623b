"""The subcommands fetch, get and watch."""

from __future__ import annotations

import asyncio
import shlex
from collections.abc import AsyncGenerator, Iterable, Sequence
from contextlib import aclosing, suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Final, Literal, TypeAlias

import anyio
from cyclopts import Parameter
from cyclopts.validators import Number

from paramclient.cli.exit_codes import ExitCode, code_of
from paramclient.cli.extended import (
    check_choice,
    fetch_extended,
    get_extended,
    is_extended_session,
)
from paramclient.cli.metadata import (
    DESCRIBED_COLUMNS,
    MetadataChoice,
    described_cells,
    from_file,
    known_of_session,
)
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import (
    by_index,
    default_text,
    local_time,
    milliseconds,
    print_document,
    print_line,
    print_table,
    printable,
    progress_bar,
    report,
    say,
)
from paramclient.cli.param_names import ChosenNames, check_given, may_appear, suggest
from paramclient.cli.session import CommandSession, connect
from paramclient.client.events import (
    Contested,
    Event,
    Events,
    Found,
    Heard,
    Lost,
    Rebooted,
    Resynced,
    Uncontested,
)
from paramclient.client.subscription import Changes
from paramclient.errors import CacheError, NoReply, ParamClientError, UsageError
from paramclient.model.notation import hash_text
from paramclient.model.patterns import NameChoice, is_pattern
from paramclient.model.values import Param, Trust, format_value, type_name
from paramclient.model.wording import first_of
from paramclient.protocol.params.change import Added, Change, Removed
from paramclient.protocol.params.fetch_result import FetchResult, Policy
from paramclient.protocol.params.sampling import SAMPLE_SIZE, Sample

if TYPE_CHECKING:
    from paramclient.documents.command_output import FetchOutputDoc
    from paramclient.documents.document import Document

__all__ = ["fetch", "get", "watch"]

REFRESH_TIMEOUT: Final = 10.0
"""Seconds to wait for the values that the vehicle's hash does not cover, without --timeout."""
INDICES_SHOWN_MAX: Final = 20
"""Missing indices that a message names, so that it stays readable; it gives the number of further ones."""

_DEFAULTS: Final = LinkOptions()
_ComponentEvent: TypeAlias = Lost | Found | Rebooted | Resynced | Contested | Uncontested
"""Events that watch prints."""


async def fetch(
    url: str,
    /,
    *names: Annotated[str, Parameter(show=False)],
    only: Annotated[tuple[str, ...], Parameter(show_default=False)] = (),
    refresh: bool = False,
    changed: bool = False,
    accept: Literal["verified", "sampled"] = "verified",
    sample: Annotated[int | None, Parameter(validator=Number(gte=1))] = None,
    policy: Policy = Policy.AUTO,
    extended: bool = False,
    plain: bool = False,
    options: LinkOptions = _DEFAULTS,
) -> int:
    """Fetch all parameters. Uses the cache if the vehicle's hash matches, otherwise downloads.

    Exit code 1: some parameters are missing, or with --changed, the firmware's defaults are not known.

    Args:
        url: The link, such as udpin:0.0.0.0:14550, tcp:HOST:PORT or sim:px4.
        names: Not accepted; the error names the commands that take names.
        only: Print only this name or pattern, such as "MC_*". May be given several times.
        refresh: Download all parameters even if the cache is up to date.
        changed: Print only parameters that differ from the firmware's defaults.
        accept: With "sampled", a cached table of a vehicle without a hash is accepted if a sample of it
            agrees; the probability that the sample shows a change is printed.
        sample: Number of parameters in the sample. Default: 30.
        policy: Requests that may be sent to the vehicle: all that are needed, only for its hash, or none.
        extended: Use the extended parameters (PARAM_EXT_*) of the component, as of a camera. Without it, a
            camera, gimbal or other payload is asked whether it has them.
        plain: Use the plain parameters, also of a component that has extended ones.
    """
    if names:
        given = shlex.quote(names[0])
        raise UsageError(
            f"fetch takes no names, as it fetches all: `paramclient get {url} {given}` reads only some, "
            f"`paramclient fetch {url} --only {given}` fetches all and prints some"
        )
    check_choice(extended=extended, plain=plain)
    if sample is not None and accept != "sampled":
        raise UsageError("--sample needs --accept sampled")
    async with connect(url, options, policy=policy) as session:
        if await is_extended_session(session, extended=extended, plain=plain or changed):
            if accept != "verified":
                raise UsageError("--accept is for plain parameters; add --plain")
            return await fetch_extended(session)
        result = await _fetch_all(session, refresh=refresh, accept=accept, sample=sample or SAMPLE_SIZE)
        with suppress(NoReply):
            await session.component.refreshed(timeout=session.deadline.left(REFRESH_TIMEOUT))
        fetched = _Fetched.of(session, result, policy)
    has_defaults = any(param.default is not None for param in fetched.params)
    if only:
        chosen, unmatched = NameChoice(only).choose({param.name for param in fetched.params})
        if unmatched:
            raise UsageError(f"no parameter of {session.label} is called {unmatched}")
        fetched = replace(fetched, params=[param for param in fetched.params if param.name in chosen])
    if changed:
        fetched = replace(fetched, params=[param for param in fetched.params if param.is_changed])
    for note in result.notes:
        report(note)
    if result.sample is not None:
        report(_confidence(result.sample))
    if options.json:
        print_document(fetched.document())
    else:
        if not changed:
            rows = ((*_cells(param), param.trust) for param in fetched.params)
            print_table([*_COLUMNS, "trust"], rows, right="value index")
        elif has_defaults:
            rows = ((*_cells(param), param.trust, default_text(param)) for param in fetched.params)
            print_table([*_COLUMNS, "trust", "default"], rows, right="value index default")
        say(printable(fetched.summary))
    if changed and not has_defaults:
        from paramclient.provision.vehicle_params import NO_DEFAULTS  # only here: loads provision

        report(NO_DEFAULTS)
        return ExitCode.INCOMPLETE
    if fetched.missing:
        number = "was" if len(fetched.missing) == 1 else "were"
        report(
            f"incomplete: {_index_text(fetched.missing)} of {session.label} {number} not received; run the "
            "command again to request what is missing"
        )
        return ExitCode.INCOMPLETE
    return ExitCode.DONE


async def get(
    url: str,
    name: str,
    /,
    *names: str,
    metadata: MetadataChoice = None,
    extended: bool = False,
    plain: bool = False,
    options: LinkOptions = _DEFAULTS,
) -> int:
    """Read parameters from the vehicle.

    Args:
        url: The link.
        name: The parameter, in upper or lower case, or a pattern such as "MC_*": then the whole table is
            fetched, from the cache if the vehicle's hash matches.
        names: Further parameters and patterns.
        metadata: A file that describes parameters; or vehicle, to download the vehicle's own metadata.
        extended: Use the extended parameters (PARAM_EXT_*) of the component, as of a camera. Without it, a
            camera, gimbal or other payload is asked whether it has them.
        plain: Use the plain parameters, also of a component that has extended ones.
    """
    check_choice(extended=extended, plain=plain)
    described = from_file(metadata)
    wanted = check_given((name, *names))
    async with connect(url, options) as session:
        if await is_extended_session(session, extended=extended, plain=plain):
            return await get_extended(session, wanted)
        params, errors = await _get_chosen(session, wanted)
        if described is None:
            described = await known_of_session(session, metadata)
    if options.json:
        from paramclient.documents.param import ReadOutputDoc  # only here: loads pydantic

        print_document(ReadOutputDoc.of(params, described, errors))
    elif params and described is None:
        print_table(_COLUMNS, map(_cells, params), right="value index")
    elif params and described is not None:
        rows = ((*_cells(param), *described_cells(described, param)) for param in params)
        print_table([*_COLUMNS, *DESCRIBED_COLUMNS], rows, right="value index")
    return _report_all(errors.values())


async def watch(
    url: str, /, *names: str, policy: Policy = Policy.AUTO, options: LinkOptions = _DEFAULTS
) -> int:
    """Print changes of values by any source, as they happen, until Ctrl-C or --timeout.

    Updates the table first, and also prints values that have changed since the cache was written. Also prints
    when the vehicle is lost, found or rebooted, and when its table matches again. Parameters that appear, as
    after a change of an *_ENABLE, are watched as well if NAMES or a pattern fits.

    Args:
        url: The link.
        names: The parameters to watch, or patterns such as "MC_*". Default: all.
        policy: Requests that may be sent besides those for NAMES: all that are needed, only for the hash, or
            none.
    """
    wanted = check_given(names)
    async with connect(url, options, policy=policy, is_live=True) as session:
        changes, events = session.component.changes(), session.client.events()
        listens = session.client.listens_only
        has_pattern = any(map(is_pattern, wanted))
        if not listens and (has_pattern or not wanted):
            with suppress(CacheError):  # with an empty cache, all received parameters are new
                await _fetch_all(session)
        if wanted and not listens and (code := await _check_watched(session, wanted)):
            return code
        known = None if listens else set(session.component.params)
        watched = ", ".join(wanted) if wanted else f"{len(session.component.params)} parameters"
        say(printable(f"watching {watched} of {session.label}"))
        failure: Exception | None = None
        async with anyio.create_task_group() as tasks:
            if wanted and not has_pattern and not listens:
                tasks.start_soon(_follow_groups, session)
            with anyio.move_on_after(session.deadline.left()):
                try:
                    await _print_changes_and_events(
                        session,
                        changes,
                        events,
                        known,
                        NameChoice(wanted) if wanted else None,
                        as_lines_of_json=options.json,
                    )
                except Exception as error:  # raised here, the task group would wrap it in a group
                    failure = error
            tasks.cancel_scope.cancel()
        if failure is not None:
            raise failure
    return ExitCode.DONE


# fetch


@dataclass(frozen=True, slots=True)
class _Fetched:
    """The parameters that were received or confirmed in this session.

    A value that is only cached is left out, and its index counts as missing. If the policy prevents its
    request, or a sample confirms the table, it is included and named in `cached`.
    """

    session: CommandSession
    result: FetchResult
    params: list[Param]
    missing: list[int]
    cached: list[str]
    bytes_received: int
    bytes_sent: int

    @classmethod
    def of(cls, session: CommandSession, result: FetchResult, policy: Policy) -> _Fetched:
        """Select the parameters of a fetch under a policy."""
        params = by_index(session.component.params.values())
        cached = [param for param in params if param.trust is Trust.CACHED]
        missing = set(result.missing)
        if policy is Policy.AUTO and result.sample is None:
            if result.source == "cache":
                missing = {param.index for param in cached if param.index is not None}
            params = [param for param in params if param.trust is not Trust.CACHED]
            cached = []
        return cls(
            session,
            result,
            params=params,
            missing=sorted(missing),
            cached=[param.name for param in cached],
            bytes_received=session.client.bytes_received,
            bytes_sent=session.client.bytes_sent,
        )

    @property
    def received(self) -> int:
        """The number of parameters that were received or confirmed."""
        return self.result.count - len(self.missing)

    @property
    def summary(self) -> str:
        """The line about the fetch: parameters, source, seconds, losses, bytes, hash."""
        result = self.result
        of = f" of {result.count}" if self.missing else ""
        crc = "" if result.hash is None else f"; hash {hash_text(result.hash)}"
        lost = "" if result.source == "cache" else f"{result.lost} lost, {result.repeated} repeated, "
        trip = "" if result.round_trip is None else f"round trip {milliseconds(result.round_trip)}, "
        return (
            f"{self.received}{of} parameters of {self.session.label} from {result.source} in "
            f"{result.elapsed:.2f} s, {lost}{trip}{self.bytes_received:,} bytes received, "
            f"{self.bytes_sent:,} sent{crc}"
        )

    def document(self) -> FetchOutputDoc:
        """Return the JSON document."""
        from paramclient.documents.command_output import FetchOutputDoc  # only here: loads pydantic

        return FetchOutputDoc.of(
            self.session.component,
            self.result,
            self.params,
            missing=self.missing,
            cached=self.cached,
            bytes_received=self.bytes_received,
            bytes_sent=self.bytes_sent,
        )


async def _fetch_all(
    session: CommandSession, *, refresh: bool = False, accept: str = "verified", sample: int = SAMPLE_SIZE
) -> FetchResult:
    with progress_bar(f"fetching {session.label}") as progress:
        return await session.component.fetch_all(
            refresh=refresh,
            accept=accept,
            sample=sample,
            timeout=session.deadline.left(),
            progress=progress,
        )


def _confidence(sample: Sample) -> str:
    """Return the probabilities that the sample would have shown a change, in words."""
    chances = " and ".join(f"{sample.confidence(each):.0%} for {each}" for each in _ASSUMED_CHANGES)
    return (
        f"{sample.size} of {sample.count} parameters were read and agreed. If other parameters had changed, "
        f"the probability that the sample shows it is {chances} of them."
    )


def _index_text(indices: Sequence[int]) -> str:
    return f"{'index' if len(indices) == 1 else 'indices'} {first_of(indices, INDICES_SHOWN_MAX)}"


_ASSUMED_CHANGES: Final = (1, 10, 100)
"""Numbers of changed parameters for which the probability is given that a sample detects the change."""

# get

_COLUMNS: Final = ("name", "value", "type", "index")
"""Columns of the table of parameters."""


def _cells(param: Param) -> tuple[object, ...]:
    return param.name, format_value(param.value, param.type), type_name(param.type), param.index


async def _get_chosen(
    session: CommandSession, wanted: Sequence[str]
) -> tuple[list[Param], dict[str, ParamClientError]]:
    """Read the parameters that names and patterns choose; return them, and the errors by name.

    With a pattern, the table is fetched. Values that were received or confirmed by that are not read again.
    """
    component = session.component
    has_pattern = any(map(is_pattern, wanted))
    if has_pattern:
        await _fetch_all(session)
        with suppress(NoReply):
            await component.refreshed(timeout=session.deadline.left(REFRESH_TIMEOUT))
    chosen = ChosenNames.of(component, wanted)
    held = {name: component.params[name] for name in chosen.names if has_pattern and name in component.params}
    fresh = {name: param for name, param in held.items() if param.trust is not Trust.CACHED}
    asked = [name for name in chosen.names if name not in fresh]
    read, errors = await _get_all(session, asked)
    answered = [name for name in asked if name not in errors]
    found = fresh | dict(zip(answered, read, strict=True))
    return (
        [found[name] for name in chosen.names if name in found],
        await suggest(session, {**errors, **chosen.errors}),
    )


async def _get_all(
    session: CommandSession, names: Sequence[str]
) -> tuple[list[Param], dict[str, ParamClientError]]:
    """Read several parameters concurrently; return parameters and errors in the order of the names."""
    found: dict[str, Param] = {}
    errors: dict[str, ParamClientError] = {}

    async def read(name: str) -> None:
        try:
            found[name] = await session.component.get(name, timeout=session.deadline.left())
        except ParamClientError as error:
            errors[name] = error

    async with anyio.create_task_group() as tasks:
        for name in names:
            tasks.start_soon(read, name)
    return (
        [found[name] for name in names if name in found],
        {name: errors[name] for name in names if name in errors},
    )


def _report_all(errors: Iterable[ParamClientError]) -> int:
    """Print every error; return the exit code for all of them."""
    worst = ExitCode.DONE
    for error in errors:
        report(str(error))
        worst = max(worst, code_of(error))
    return worst


# watch


async def _check_watched(session: CommandSession, wanted: Sequence[str]) -> int:
    """Read the watched parameters, and report those that the vehicle does not have; return the exit code.

    A name or pattern of a group that the vehicle hides at present may appear later, and is no error.
    """
    _, errors = await _get_chosen(session, [text for text in wanted if not is_pattern(text)])
    patterns = [text for text in wanted if is_pattern(text)]
    errors |= ChosenNames.of(session.component, patterns).errors
    hidden = [name for name in errors if may_appear(name, session.component)]
    if hidden:
        say(printable(f"not there at present: {', '.join(hidden)}"))
    return _report_all(error for name, error in errors.items() if name not in hidden)


async def _follow_groups(session: CommandSession) -> None:
    """Fetch the table, so that parameters which come and go are noticed. Values were read already."""
    with suppress(ParamClientError):  # the events and the end of the changes tell
        await session.component.fetch_all()


async def _print_changes_and_events(
    session: CommandSession,
    changes: Changes,
    events: Events,
    known: set[str] | None,
    wanted: NameChoice | None,
    *,
    as_lines_of_json: bool,
) -> None:
    """Print changes and events of the component until cancelled.

    Args:
        session: the session.
        changes: the changes of the component.
        events: the events of the client.
        known: names of the table at the start. The first value of any other parameter is not a change. None:
            the first value of every parameter is not a change.
        wanted: the names to watch; None for all.
        as_lines_of_json: print JSON instead of text.
    """
    async with aclosing(_merged(changes, events)) as news:
        async for each in news:
            if isinstance(each, Change):
                is_first = each.old is None and not isinstance(each, Added)
                if is_first and (known is None or each.name in known):
                    known = known and known - {each.name}
                    continue
                if wanted is not None and not wanted.has(each.name):
                    continue
                text = _change_text(each)
            elif isinstance(each, Heard) or each.component is not session.component:
                continue
            else:
                text = _event_text(each)
            at = session.now
            if as_lines_of_json:
                print_document(_line(each, at))
            else:
                print_line(f"{local_time(at)}  {text}")


async def _merged(changes: Changes, events: Events) -> AsyncGenerator[Change | Event]:
    """Yield changes and events in the order of their arrival."""
    waiting: dict[asyncio.Future[Change | Event], Changes | Events] = {}

    def wait(feed: Changes | Events) -> None:
        waiting[asyncio.ensure_future(anext(feed))] = feed

    try:
        wait(changes)
        wait(events)
        while waiting:
            done, _ = await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
            for each in [each for each in waiting if each in done]:
                feed = waiting.pop(each)
                if not isinstance(each.exception(), StopAsyncIteration):  # else a log has ended
                    wait(feed)
                    yield each.result()
    finally:
        for each in waiting:
            if not each.cancel():
                each.exception()  # both end with the link; one error is reported


def _line(news: Change | _ComponentEvent, at: float) -> Document:
    """Return the JSON document of a change or an event."""
    from paramclient.documents.command_output import ChangeLineDoc, EventLineDoc  # only here: loads pydantic

    return ChangeLineDoc.of(news, at) if isinstance(news, Change) else EventLineDoc.of(news, at)


def _change_text(change: Change) -> str:
    old, new = (
        "none" if param is None else format_value(param.value, param.type)
        for param in (change.old, change.new)
    )
    if isinstance(change, Added):
        return f"{change.name}  added: {new}  ({change.by})"
    if isinstance(change, Removed):
        return f"{change.name}  removed, was {old}  ({change.by})"
    return f"{change.name}  {old} -> {new}  ({change.by})"


def _event_text(event: _ComponentEvent) -> str:
    match event:
        case Lost():
            text = f"lost: not heard for {event.silence:.1f} s"
        case Found():
            text = f"found after {event.silence:.1f} s"
        case Rebooted():
            text = "rebooted"
        case Contested():
            text = f"contested: {'; '.join(event.contest.claimants)}"
        case Uncontested():
            text = "no longer contested"
        case Resynced():
            count = len(event.changed)
            text = f"resynced: {count or 'no'} {'value' if count == 1 else 'values'} had changed"
    return f"{event.component.system}/{event.component.component} {text}"
