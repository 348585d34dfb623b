"""The subcommand watch: changes of parameters and events of the component, as text or JSON."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from typing import Final

import anyio

from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.options import LinkOptions
from paramclient.cli.output import local_time, print_json, print_line, say
from paramclient.cli.param_names import check_given, choose_names, may_appear
from paramclient.cli.read_commands import get_chosen, report_all
from paramclient.cli.session import CommandSession, Sessions, sessions
from paramclient.client.events import Event, Events
from paramclient.client.streams import Changes
from paramclient.errors import CacheError, ParamClientError
from paramclient.model.names import NameChoice, is_pattern
from paramclient.model.notation import hash_text, time_text, value_json
from paramclient.model.values import format_value
from paramclient.model.wording import counted
from paramclient.protocol.channel import task_group
from paramclient.protocol.events import Change

__all__ = ["watch"]

_DEFAULTS: Final = LinkOptions()


async def watch(url: str, /, *names: str, extended: bool = False, options: LinkOptions = _DEFAULTS) -> int:
    """Print changes of values by any source, as they happen, until Ctrl-C or --timeout.

    Updates the table first, and also prints values that have changed since the cache was written. Also prints
    when the vehicle is lost, found or rebooted, and when its table is in sync again. Parameters that appear
    later, such as after a change of an *_ENABLE parameter, are watched too if a name or pattern matches.

    Args:
        url: The link.
        names: The parameters to watch, or patterns such as "MC_*". Default: all.
        extended: Extended parameters (PARAM_EXT_*), such as a camera's.
    """
    given = check_given(names)
    async with sessions(url, options, is_live=True, extended=extended) as found:
        codes = [each.result for each in await found.work(partial(_watch, given=given, found=found))]
    return max(code or ExitCode.DONE for code in codes)


async def _watch(session: CommandSession, given: Sequence[str], found: Sessions) -> int:
    """Watch one vehicle; return the exit code."""
    changes, events = session.component.changes(), session.client.events()
    known: set[str] | None = None
    if not session.client.listens_only:
        code = await _begin(session, given)
        if code:
            return code
        known = set(session.component.params)
    everything = counted(len(session.component.params), session.noun)
    say(f"watching {', '.join(given) or everything} of {session.label}")
    if session is found[0]:
        found.report_others()
    choice = NameChoice(given) if given else None
    async with task_group() as tasks:
        if given and not any(map(is_pattern, given)) and known is not None:
            tasks.start_soon(_follow_groups, session)
        with anyio.move_on_after(session.deadline.left()):
            async with task_group() as printing:  # both end with a log
                printing.start_soon(_print_events, session, events)
                await _print_changes(session, changes, known, choice)
        tasks.cancel_scope.cancel()
    return ExitCode.DONE


async def _begin(session: CommandSession, given: Sequence[str]) -> int:
    """Update the table, and report the names that the vehicle does not have; return the exit code.

    A name or pattern of a group that the vehicle currently hides may appear later, and is no error.
    """
    patterns = [text for text in given if is_pattern(text)]
    if patterns or not given:
        with suppress(CacheError):  # with an empty cache, all received parameters are new
            await session.fetch()
    if not given:
        return ExitCode.DONE
    _, errors = await get_chosen(session, [text for text in given if not is_pattern(text)])
    errors |= choose_names(session.component, patterns)[1]
    hidden = [name for name in errors if may_appear(name, session.component)]
    if hidden:
        say(f"{session.prefix}not there at present: {', '.join(hidden)}")
    return report_all((error for name, error in errors.items() if name not in hidden), session.prefix)


async def _follow_groups(session: CommandSession) -> None:
    """Fetch the table, so that added and removed parameters are noticed. Values were read already."""
    with suppress(ParamClientError):  # the events and the end of the changes report it
        await session.component.fetch_all()


async def _print_changes(
    session: CommandSession, changes: Changes, known: set[str] | None, choice: NameChoice | None
) -> None:
    """Print changes of the component until cancelled.

    Args:
        session: the session.
        changes: the changes of the component.
        known: names of the table at the start. The first value of any other parameter is not a change. None:
            the first value of every parameter is not a change.
        choice: the names to watch; None for all.
    """
    async for change in changes:
        if change.kind == "first" and (known is None or change.name in known):
            known = known and known - {change.name}
        elif choice is None or choice.has(change.name):
            _print(session, change, f"{session.prefix}{_change_text(change)}")


async def _print_events(session: CommandSession, events: Events) -> None:
    async for event in events:
        if event.kind != "discovered" and event.component.node is session.component.node:
            _print(session, event, _event_text(event))


def _print(session: CommandSession, item: Change | Event, text: str) -> None:
    if session.options.json:
        ids = session.ids if session.choice.is_all else {}
        print_json({"time": time_text(session.now)} | ids | _json(item))
    else:
        print_line(f"{local_time(session.now)}  {text}")


def _json(item: Change | Event) -> dict[str, object]:
    """Return the JSON of a change or an event, without its time."""
    if isinstance(item, Change):
        old, new = (
            None if param is None else value_json(param.settable, param.type)
            for param in (item.old, item.new)
        )
        return {"name": item.name, "old": old, "new": new, "by": item.by, "kind": item.kind}
    event: dict[str, object] = {
        "event": item.kind,
        "system": item.component.system,
        "component": item.component.component,
    }
    if item.silence is not None:
        event["silence_s"] = round(item.silence, 4)
    if item.kind == "resynced":
        event |= {"changed": list(item.changed), "hash": hash_text(item.hash)}
    return event


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
    text: str = event.kind
    if event.silence is not None:
        text += (
            f": nothing received for {event.silence:.1f} s"
            if text == "lost"
            else f" after {event.silence:.1f} s"
        )
    elif text == "resynced":
        count = len(event.changed)
        text += f": {count or 'no'} {'value' if count == 1 else 'values'} had changed"
    return f"{event.component.system}/{event.component.component} {text}"
