"""The subcommands fetch, get and watch."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, Final

import anyio

from paramclient.cli.json_output import JsonObject, fetch_json, param_json, param_value
from paramclient.cli.metadata import (
    MetadataChoice,
    default_in,
    info_of,
    known_of_session,
    no_defaults,
    say_sources,
)
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import (
    LINE_NAMES_MAX,
    ExitCode,
    by_index,
    cells_of,
    local_time,
    milliseconds,
    print_json,
    print_line,
    report,
    report_all,
    say,
)
from paramclient.cli.session import CommandSession, Sessions, check_given, get_chosen, sessions
from paramclient.client.client import Event
from paramclient.errors import ParamClientError, VehicleError
from paramclient.links import ReplayLink
from paramclient.metadata import Metadata
from paramclient.model.names import NameChoice, counted, first_of
from paramclient.model.notation import hash_text, rounded, time_text
from paramclient.model.paramset import Default
from paramclient.model.values import Param, format_value
from paramclient.protocol.channel import task_group
from paramclient.protocol.fetch import FetchResult
from paramclient.protocol.table import Change

_DEFAULTS: Final = LinkOptions()


async def fetch(
    url: str,
    /,
    *names: str,
    refresh: bool = False,
    changed: bool = False,
    metadata: MetadataChoice = None,
    options: LinkOptions = _DEFAULTS,
) -> int:
    """Fetch all parameters. Uses the cache if the vehicle confirms it, otherwise downloads.

    Args:
        url: The link: udpin:0.0.0.0:14550, tcp:HOST:PORT, serial:PATH, sim:px4.
        names: Print only these names and patterns, such as "MC_*". All are fetched.
        refresh: Download even if the cache is up to date.
        changed: Print only values that differ from the firmware's defaults.
        metadata: A file with defaults; or vehicle, to download them from it.
    """
    chosen = NameChoice(check_given(names) or ["*"])
    async with sessions(url, options) as found:

        async def work(session: CommandSession) -> _Fetched:
            result = await session.fetch(refresh=refresh)
            params = by_index(each for name, each in result.params.items() if name not in result.cached)
            known = None
            if changed or options.json or metadata is not None:
                known = await known_of_session(session, metadata)
            defaults = {param.name: default_in(known, param) for param in params}
            if changed and not any(defaults.values()):
                raise VehicleError(no_defaults(), *session.component.address)
            kept = chosen.choose(defaults) if names else defaults.keys()
            params = [
                param
                for param in params
                if param.name in kept and (not changed or _is_changed(param, defaults[param.name]))
            ]
            return _Fetched(session, result, params, known, defaults if changed else {})

        done = await found.work(work)
    return found.show(done)


async def get(
    url: str,
    name: str,
    /,
    *names: str,
    metadata: MetadataChoice = None,
    options: LinkOptions = _DEFAULTS,
) -> int:
    """Read parameters from the vehicle.

    Args:
        url: The link.
        name: The parameter, in upper or lower case, or a pattern such as "MC_*": then the whole table is
            fetched, from the cache if the vehicle confirms it.
        names: Further parameters and patterns.
        metadata: A file that describes parameters; or vehicle, to download the vehicle's own metadata.
    """
    chosen = check_given((name, *names))
    async with sessions(url, options) as found:

        async def work(session: CommandSession) -> _Read:
            params, errors = await get_chosen(session, chosen)
            return _Read(session, params, errors, await known_of_session(session, metadata))

        done = await found.work(work)
    return found.show(done)


def _is_changed(param: Param, default: Default | None) -> bool:
    return default is not None and replace(param, default=default.value).is_changed is True


@dataclass(slots=True)
class _Fetched:
    """The parameters that were received or confirmed in this session: values that are only cached are not.

    Attributes:
        session: the vehicle.
        result: the fetch.
        params: the parameters.
        metadata: the metadata of the vehicle for its defaults, or None.
        defaults: the defaults of the parameters by name, if the table is to show them.
    """

    columns: ClassVar[Sequence[str]] = ("name", "value", "type", "index", "trust", "default")

    session: CommandSession
    result: FetchResult
    params: list[Param]
    metadata: Metadata | None
    defaults: Mapping[str, Default | None]

    def report(self) -> int:
        """Print notes, a summary, and what is missing; return the exit code."""
        session, result = self.session, self.result
        for note in result.notes:
            report(f"{session.prefix}{note}")
        if not session.options.json:
            if self.defaults:
                say_sources(session.label, (self.defaults[param.name] for param in self.params))
            say(self._summary)
        if not result.missing:
            return ExitCode.DONE
        missing = counted(len(result.missing), "parameter")
        report(
            f"incomplete: {session.label} did not send {missing}, index "
            f"{first_of(result.missing, LINE_NAMES_MAX)}; run the command again to request them"
        )
        return ExitCode.INCOMPLETE

    @property
    def _summary(self) -> str:
        """The line about the fetch: parameters, source, seconds, losses, bytes, hash."""
        result, client = self.result, self.session.client
        of = f" of {result.count}" if result.missing else ""
        crc = "" if result.hash is None else f"; hash {hash_text(result.hash)}"
        lost = "" if result.source == "cache" else f"{result.lost} lost, {result.repeated} repeated, "
        trip = "" if result.round_trip is None else f"round trip {milliseconds(result.round_trip)}, "
        link = " on the whole link" if len(client.components) > 1 else ""
        return (
            f"{result.received}{of} {self.session.noun}s of {self.session.label} from "
            f"{result.source} in {result.elapsed:.2f} s, {lost}{trip}{client.bytes_received:,} "
            f"bytes received, {client.bytes_sent:,} sent{link}{crc}"
        )

    def as_json(self) -> JsonObject:
        """Return the JSON object."""
        return fetch_json(self.session.component, self.result, self.params, self.metadata)

    def rows(self) -> Iterator[Sequence[object]]:
        """Yield the cells of each parameter."""
        for param in self.params:
            default = self.defaults.get(param.name)
            value, kind = format_value(param.settable, param.type), param.type.name
            changed = default and format_value(default.value, param.type)
            yield param.name, value, kind, param.index, param.trust, changed


@dataclass(frozen=True, slots=True)
class _Read:
    """The parameters that were read from a vehicle, the errors by name, and the metadata or None."""

    columns: ClassVar[Sequence[str]] = ("name", "value", "type", "index", "meaning", "units")

    session: CommandSession
    params: list[Param]
    errors: Mapping[str, ParamClientError]
    metadata: Metadata | None

    def as_json(self) -> JsonObject:
        """Return the JSON of the parameters with all their metadata, and of the errors."""
        failed = {name: str(error) for name, error in self.errors.items()}
        found = {
            each.name: param_json(each, info_of(self.metadata, each.name), whole=True) for each in self.params
        }
        return {"params": found} | ({"errors": failed} if failed else {})

    def report(self) -> int:
        """Print a doubt about the values, and the errors; return the exit code."""
        prefix = self.session.prefix
        if doubt := self.session.component.session.encoding_doubt:
            report(f"{prefix}{doubt}")
        return report_all(self.errors.values(), prefix)

    def rows(self) -> Iterator[Sequence[object]]:
        """Yield the cells of each parameter, with meaning and units if metadata is known."""
        return cells_of(self.as_json()["params"], "value", "type", "index", "text", "units")


# watch


async def watch(url: str, /, *names: str, options: LinkOptions = _DEFAULTS) -> int:
    """Print changes of values by any source, as they happen, until Ctrl-C or --timeout.

    Updates the table first, and also prints values that have changed since the cache was written. Also prints
    when the vehicle is lost, found or rebooted, and when its table is in sync again. Parameters that appear
    later, such as after a change of an *_ENABLE parameter, are watched too if a name or pattern matches.

    Args:
        url: The link.
        names: The parameters to watch, or patterns such as "MC_*". Default: all.
    """
    given = check_given(names)
    async with sessions(url, options, is_live=True) as found:
        codes = (await found.work(partial(_watch, given=given, found=found))).values()
    return max([*codes, found.report_errors()])


async def _watch(session: CommandSession, given: Sequence[str], found: Sessions) -> int:
    """Watch one vehicle; return the exit code."""
    component, choice = session.component, NameChoice(given or ["*"])
    changes, events = component.changes(), session.client.events()
    is_first: set[str] | None = None
    if not session.client.listens_only:
        await session.fetch()
        _, errors = await get_chosen(session, given, is_fetched=True)
        if errors:
            return report_all(errors.values(), session.prefix)
        is_first = set(component.params)
    everything = counted(len(component.params), session.noun)
    say(f"watching {', '.join(given) or everything} of {session.label}")
    if session is found[0]:
        found.report_others()

    async def print_events() -> None:
        async for event in events:
            if event.kind != "discovered" and event.component.node is component.node:
                _print(session, *_event(event))

    with anyio.move_on_after(session.deadline.left()):
        async with task_group() as tasks:  # both end with a log
            tasks.start_soon(print_events)
            async for change in changes:
                # the first value of a parameter that the table had, or of any of a log, is no change
                if change.kind == "first" and (is_first is None or change.name in is_first):
                    is_first = is_first and is_first - {change.name}
                elif choice.has(change.name):
                    item, text = _change(change)
                    _print(session, item, f"{session.prefix}{text}")
    return ExitCode.DONE


def _print(session: CommandSession, item: JsonObject, text: str) -> None:
    """Print with the current time; in a log, that of the last frame read from it."""
    link = session.client.link
    now = (link.at if isinstance(link, ReplayLink) else None) or time.time()
    if session.options.json:
        print_json({"time": time_text(now)} | (session.ids if session.choice.is_all else {}) | item)
    else:
        print_line(f"{local_time(now)}  {text}")


def _change(change: Change) -> tuple[JsonObject, str]:
    """Return a change as JSON and in words."""
    old, new = param_value(change.old), param_value(change.new)
    words = f"{'none' if old is None else old} -> {'none' if new is None else new}"
    if change.kind == "added":
        words = f"added: {new}"
    elif change.kind == "removed":
        words = f"removed, was {old}"
    found = {"name": change.name, "old": old, "new": new, "by": change.by, "kind": change.kind}
    return found, f"{change.name}  {words}  ({change.by})"


def _event(event: Event) -> tuple[JsonObject, str]:
    """Return an event as JSON and in words."""
    component, words = event.component, ""
    found: JsonObject = {"event": event.kind, "system": component.system, "component": component.component}
    if event.silence is not None:
        found["silence_s"] = rounded(event.silence)
        words = f" after {event.silence:.1f} s without a message"
    if event.kind == "resynced":
        found |= {"changed": event.changed, "hash": hash_text(event.hash)}
        words = f": {counted(len(event.changed), 'value')} had changed"
    return found, f"{component.system}/{component.component} {event.kind}{words}"
