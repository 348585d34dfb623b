"""The subcommand watch: changes of parameters and events of the component, as text or JSON."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from typing import Final

import anyio

from paramclient.cli.json_output import JsonObject, known_members, param_value
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import ExitCode, local_time, print_json, print_line, report_all, say
from paramclient.cli.param_names import check_given
from paramclient.cli.read_commands import get_chosen
from paramclient.cli.session import CommandSession, Sessions, sessions
from paramclient.client.client import Event
from paramclient.links import ReplayLink
from paramclient.model.names import NameChoice, counted
from paramclient.model.notation import hash_text, rounded, time_text
from paramclient.model.values import format_value
from paramclient.protocol.channel import task_group
from paramclient.protocol.table import Change

_DEFAULTS: Final = LinkOptions()


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
        codes = [each.result for each in await found.work(partial(_watch, given=given, found=found))]
    return max(code or ExitCode.DONE for code in codes)


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
                _print(session, _event_json(event), _event_text(event))

    with anyio.move_on_after(session.deadline.left()):
        async with task_group() as tasks:  # both end with a log
            tasks.start_soon(print_events)
            async for change in changes:
                # the first value of a parameter that the table had, or of any of a log, is no change
                if change.kind == "first" and (is_first is None or change.name in is_first):
                    is_first = is_first and is_first - {change.name}
                elif choice.has(change.name):
                    _print(session, _change_json(change), f"{session.prefix}{_change_text(change)}")
    return ExitCode.DONE


def _print(session: CommandSession, item: JsonObject, text: str) -> None:
    """Print with the current time; in a log, that of the last frame read from it."""
    link = session.client.link
    now = (link.at if isinstance(link, ReplayLink) else None) or time.time()
    if session.options.json:
        print_json({"time": time_text(now)} | (session.ids if session.choice.is_all else {}) | item)
    else:
        print_line(f"{local_time(now)}  {text}")


def _change_json(change: Change) -> JsonObject:
    values = {"old": param_value(change.old), "new": param_value(change.new)}
    return {"name": change.name, **values, "by": change.by, "kind": change.kind}


def _event_json(event: Event) -> JsonObject:
    component, more = event.component, {}
    if event.kind == "resynced":
        more = {"changed": event.changed, "hash": hash_text(event.hash)}
    ids = {"system": component.system, "component": component.component}
    return {"event": event.kind, **ids, **known_members(silence_s=rounded(event.silence)), **more}


def _change_text(change: Change) -> str:
    old, new = (
        "none" if param is None else format_value(param.settable, param.type)
        for param in (change.old, change.new)
    )
    if change.kind == "added":
        return f"{change.name}  added: {new}  ({change.by})"
    if change.kind == "removed":
        return f"{change.name}  removed, was {old}  ({change.by})"
    return f"{change.name}  {old} -> {new}  ({change.by})"


def _event_text(event: Event) -> str:
    more = "" if event.silence is None else f" after {event.silence:.1f} s without a message"
    if event.kind == "resynced":
        more = f": {counted(len(event.changed), 'value')} had changed"
    return f"{event.component.system}/{event.component.component} {event.kind}{more}"
