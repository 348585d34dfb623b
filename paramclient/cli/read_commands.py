"""The subcommands fetch, get and watch."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import anyio

from paramclient.cli import output
from paramclient.cli.json_output import JsonObject, fetch_json, info_of, param_json, param_value, taken
from paramclient.cli.metadata import MetadataChoice, default_in, defaults_in, known_of_session, say_sources
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import ExitCode, cells_of, report, report_all, say
from paramclient.cli.session import CommandSession, Sessions, check_given, get_chosen, noun_of, sessions
from paramclient.client.client import Event
from paramclient.errors import ParamClientError, VehicleError
from paramclient.links import ReplayLink
from paramclient.model.names import NameChoice, counted, is_pattern
from paramclient.model.notation import hash_text, rounded, time_text
from paramclient.model.paramset import ParamMap
from paramclient.protocol.channel import task_group
from paramclient.protocol.fetch import FetchResult
from paramclient.protocol.table import Change


async def fetch(
    url: str,
    /,
    *names: str,
    refresh: bool = False,
    changed: bool = False,
    metadata: MetadataChoice = None,
    options: LinkOptions = LinkOptions(),
) -> int:
    """Fetch all parameters. Uses the cache if the vehicle confirms it, otherwise downloads.

    Args:
        url: The link: udpin:0.0.0.0:14550, tcp:HOST:PORT, serial:PATH, sim:px4.
        names: Print only these names and patterns, such as "MC_*". All are fetched.
        refresh: Download even if the cache is up to date.
        changed: Print only values that differ from the firmware's defaults.
        metadata: A file with defaults; or vehicle, to download them from it.
    """
    chosen = check_given(names)
    async with sessions(url, options) as found:

        async def work(session: CommandSession) -> _Shown:
            result = await session.fetch(refresh=refresh)
            params, errors = await get_chosen(session, chosen, is_fetched=True)
            if not chosen:
                params = [each for name, each in result.params.items() if name not in result.cached]
            params.sort(key=lambda param: (param.index is None, param.index or 0, param.name))
            known = None
            if changed or options.json or metadata is not None:
                known = await known_of_session(session, metadata)
            if changed:
                given = {each.name: default_in(known, each) for each in params}
                if params and not any(given.values()):
                    from paramclient.provision.sources import NO_DEFAULTS  # only here: loads provision

                    raise VehicleError(NO_DEFAULTS, *session.component.address)
                differing = ParamMap({each.name: each for each in params}).changed(defaults_in(known, given))
                params = [each for each in params if each.name in differing]
                say_sources(session.label, [given[each.name] for each in params])
            columns = ("name", "value", "type", "index", "trust", *(["default"] if changed else []))
            item = fetch_json(session.component, result, params, known) | _errors_json(errors)
            return _Shown(item, columns, partial(_report_fetch, session, result, errors.values()))

        return found.show(await found.work(work))


async def get(
    url: str,
    name: str,
    /,
    *names: str,
    metadata: MetadataChoice = None,
    options: LinkOptions = LinkOptions(),
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

        async def work(session: CommandSession) -> _Shown:
            params, errors = await get_chosen(session, chosen)
            known = await known_of_session(session, metadata)
            read = {each.name: param_json(each, info_of(known, each.name), whole=True) for each in params}
            item = {"params": read} | _errors_json(errors)
            columns = ("name", "value", "type", "index", "meaning", "units")
            missing = session.component.session.table.missing() if any(map(is_pattern, chosen)) else []
            return _Shown(item, columns, partial(_report_get, session, errors.values(), missing))

        return found.show(await found.work(work))


@dataclass(frozen=True, slots=True)
class _Shown:
    """The JSON of a vehicle's parameters, and the function that prints remarks and returns the exit code."""

    json: JsonObject
    columns: Sequence[str]
    report: Callable[[], int]

    def as_json(self) -> JsonObject:
        """Return the JSON."""
        return self.json

    def rows(self) -> Iterator[Sequence[object]]:
        """Yield the cells of each parameter."""
        return cells_of(self.json["params"], *self.columns[1:])


def _errors_json(errors: Mapping[str, ParamClientError]) -> JsonObject:
    """Return the errors by name, if there are any, as a member of JSON."""
    return {"errors": {name: str(error) for name, error in errors.items()}} if errors else {}


def _report_fetch(session: CommandSession, result: FetchResult, errors: Collection[ParamClientError]) -> int:
    """Print notes, a summary, the errors of names, and what is missing; return the exit code."""
    client, label = session.client, session.label
    for note in result.notes:
        report(f"{session.prefix}{note}")
    if not session.options.json:
        of = f"{result.received} of " if result.missing else ""
        crc = "" if result.hash is None else f"; hash {hash_text(result.hash)}"
        lost = "" if result.source == "cache" else f"{result.lost} lost, {result.repeated} repeated, "
        trip = "" if result.round_trip is None else f"round trip {output.milliseconds(result.round_trip)}, "
        link = " on the whole link" if len(client.components) > 1 else ""
        fetched = f"{of}{counted(result.count, noun_of(session.component))} of {label} from {result.source}"
        traffic = f"{client.bytes_received:,} bytes received, {client.bytes_sent:,} sent{link}"
        say(f"{fetched} in {result.elapsed:.2f} s, {lost}{trip}{traffic}{crc}")
    return max(report_all(errors, session.prefix), session.report_missing(result.missing))


def _report_get(session: CommandSession, errors: Collection[ParamClientError], missing: list[int]) -> int:
    """Print a doubt about the values, the errors, and what is missing; return the exit code."""
    if doubt := session.component.session.encoding_doubt:
        report(f"{session.prefix}{doubt}")
    return max(report_all(errors, session.prefix), session.report_missing(missing))


# watch


async def watch(url: str, /, *names: str, options: LinkOptions = LinkOptions()) -> int:
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
    noun, size = noun_of(component), len(component.params)
    lead = f"{session.label}: " if session.shown_address else ""
    everything = f"all {noun}s" if is_first is None else counted(size, noun)
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
                    _print(session, item, f"{lead}{text}")
    return ExitCode.DONE


def _print(session: CommandSession, item: JsonObject, text: str) -> None:
    """Print with the current time; in a log, that of the last frame read from it."""
    link = session.client.link
    now = (link.at if isinstance(link, ReplayLink) else None) or time.time()
    if session.options.json:
        output.print_json({"time": time_text(now)} | session.ids | item)
    else:
        output.print_line(f"{output.local_time(now)}  {text}")


def _change(change: Change) -> tuple[JsonObject, str]:
    """Return a change as JSON and in words."""
    found = {"name": change.name, "old": param_value(change.old), "new": param_value(change.new)}
    old, new = ("none" if found[side] is None else found[side] for side in ("old", "new"))
    return found | taken(change, "by", "kind"), f"{change.name}  {old} -> {new}  ({change.by})"


def _event(event: Event) -> tuple[JsonObject, str]:
    """Return an event as JSON and in words."""
    found = {"event": event.kind, **taken(event.component, "system", "component")}
    words = f"{found['system']}/{found['component']} {event.kind}"
    if event.silence is not None:
        found["silence_s"] = rounded(event.silence)
        words += f" after {event.silence:.1f} s without a message"
    if event.kind == "resynced":
        found |= {"changed": event.changed, "hash": hash_text(event.hash)}
        words += f": {counted(len(event.changed), 'value')} had changed"
    return found, words
