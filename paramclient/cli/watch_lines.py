"""The lines that `watch` prints: changes of parameters and events of the component, as text or JSON."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator
from contextlib import aclosing
from typing import Final, TypeAlias

from paramclient.cli.json_output import ExtParamJson
from paramclient.cli.output import local_time, print_json, print_line, printable
from paramclient.cli.session import CommandSession
from paramclient.client.events import (
    Contested,
    Discovered,
    Event,
    Events,
    Found,
    Lost,
    Rebooted,
    Resynced,
    Uncontested,
)
from paramclient.client.subscription import Changes, ExtChanges
from paramclient.model.ext_params import ExtParam, ExtValue, format_ext_value
from paramclient.model.notation import hash_text, time_text, value_json
from paramclient.model.patterns import NameChoice
from paramclient.model.values import Param, format_value
from paramclient.protocol.ext.change import ExtChange
from paramclient.protocol.params.change import Added, Change

__all__ = ["HEX", "ext_value_text", "print_changes_and_events"]

HEX: Final = "hex:"
"""The prefix of a value that is given as bytes in hexadecimal."""

_ComponentEvent: TypeAlias = Lost | Found | Rebooted | Resynced | Contested | Uncontested


async def print_changes_and_events(
    session: CommandSession,
    changes: Changes | ExtChanges,
    events: Events,
    known: set[str] | None,
    choice: NameChoice | None,
) -> None:
    """Print changes and events of the component until cancelled.

    Args:
        session: the session.
        changes: the changes of the component, or of its extended parameters.
        events: the events of the client.
        known: names of the table at the start. The first value of any other parameter is not a change. None:
            the first value of every parameter is not a change.
        choice: the names to watch; None for all.
    """
    async with aclosing(_merged(changes, events)) as merged:
        async for each in merged:
            if isinstance(each, Change | ExtChange):
                is_first = each.old is None and not _is_added(each)
                if is_first and (known is None or each.name in known):
                    known = known and known - {each.name}
                    continue
                if choice is not None and not choice.has(each.name):
                    continue
                text = _change_text(each)
            elif isinstance(each, Discovered) or each.component is not session.component:
                continue
            else:
                text = _event_text(each)
            at = session.now
            if session.options.json:
                print_json(_line(each, at))
            else:
                print_line(f"{local_time(at)}  {text}")


async def _merged(
    changes: Changes | ExtChanges, events: Events
) -> AsyncGenerator[Change | ExtChange | Event]:
    """Yield changes and events in the order of their arrival."""
    waiting: dict[asyncio.Future[Change | ExtChange | Event], Changes | ExtChanges | Events] = {}

    def wait(feed: Changes | ExtChanges | Events) -> None:
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


def _line(item: Change | ExtChange | _ComponentEvent, at: float) -> dict[str, object]:
    """Return the JSON of a change or an event."""
    if isinstance(item, Change | ExtChange):
        old, new = (None if param is None else _value_json(param) for param in (item.old, item.new))
        kind = "removed" if item.new is None else "added" if _is_added(item) else "changed"
        return {"time": time_text(at), "name": item.name, "old": old, "new": new, "by": item.by, "kind": kind}
    event: dict[str, object] = {
        "time": time_text(at),
        "event": type(item).__name__.lower(),
        "system": item.component.system,
        "component": item.component.component,
    }
    if isinstance(item, Lost | Found):
        event["silence_s"] = round(item.silence, 4)
    if isinstance(item, Contested):
        contest = item.contest
        event["contest"] = {"claimants": list(contest.claimants), "difference": contest.difference}
    if isinstance(item, Resynced):
        event |= {"changed": list(item.changed), "hash": hash_text(item.hash)}
    return event


def _value_json(param: Param | ExtParam) -> object:
    if isinstance(param, ExtParam):
        return ExtParamJson.of(param)
    return value_json(param.settable, param.type_number)


def _change_text(change: Change | ExtChange) -> str:
    if isinstance(change, Change):
        old, new = (
            "none" if param is None else format_value(param.settable, param.type_number)
            for param in (change.old, change.new)
        )
    else:
        old, new = (
            "none" if param is None else printable(ext_value_text(param.value, param.type))
            for param in (change.old, change.new)
        )
    if _is_added(change):
        return f"{change.name}  added: {new}  ({change.by})"
    if change.new is None:
        return f"{change.name}  removed, was {old}  ({change.by})"
    return f"{change.name}  {old} -> {new}  ({change.by})"


def _is_added(change: Change | ExtChange) -> bool:
    return change.is_added if isinstance(change, ExtChange) else isinstance(change, Added)


def _event_text(event: _ComponentEvent) -> str:
    match event:
        case Lost():
            text = f"lost: nothing received for {event.silence:.1f} s"
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


def ext_value_text(value: ExtValue, number: int) -> str:
    """Return the text of an extended value, as subcommands print and take it."""
    return f"{HEX}{value.hex()}" if isinstance(value, bytes) else format_ext_value(value, number)
