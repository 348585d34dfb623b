"""Parameters that arguments name: by names in upper or lower case, and by patterns."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

import anyio

from paramclient.cli.output import Status
from paramclient.cli.session import CommandSession
from paramclient.client.component import Component
from paramclient.errors import ParamClientError, UnknownParameter, UsageError
from paramclient.model.names import NameChoice, first_of, is_pattern
from paramclient.model.values import Param, Trust, check_name

AWAITED_NAMES_MAX: Final = 3
"""Parameters that the line about awaited values names."""
_CAPITALS: Final = ("px4", "ardupilot")
"""Autopilots whose parameters all have names in capitals."""


async def get_chosen(
    session: CommandSession, given: Sequence[str], *, is_fetched: bool = False
) -> tuple[list[Param], dict[str, ParamClientError]]:
    """Read the parameters that names and patterns choose; return them, and the errors by name.

    With a pattern, the table is fetched, unless it is already. Values that were received or confirmed by that
    are not read again.
    """
    component = session.component
    if not is_fetched and (is_fetched := any(map(is_pattern, given))):
        await session.fetch()
    known = component.params if is_fetched else {}
    fresh = {name: param for name, param in known.items() if param.trust is not Trust.CACHED}
    found: dict[str, Param | ParamClientError | None] = {}
    for text in given:
        names = [spelling(text, component)]
        if is_pattern(text):
            names = sorted(NameChoice([text]).divide(component.params)[0])
        if not names:
            what = f"{session.address} has no parameter that matches {text}"
            found[text] = UnknownParameter(what, *component.address, name=text)
        found |= {name: fresh.get(name) for name in names}
    requested = [name for name, each in found.items() if each is None]

    async def read(name: str) -> None:
        try:
            found[name] = await component.get(name, timeout=session.deadline.left())
        except ParamClientError as error:
            found[name] = error

    with Status(f"waiting for {first_of(requested, AWAITED_NAMES_MAX)} of {session.label}"):
        async with anyio.create_task_group() as tasks:
            for name in requested:
                tasks.start_soon(read, name)
    errors = {name: each for name, each in found.items() if isinstance(each, ParamClientError)}
    return [each for each in found.values() if isinstance(each, Param)], errors


def check_given(given: Iterable[str]) -> list[str]:
    """Return names and patterns without repetitions.

    Raises:
        UsageError: a name is not a valid param_id, or a pattern has other than printable ASCII characters.
    """
    chosen = list(dict.fromkeys(given))
    for text in chosen:
        if not is_pattern(text):
            check_name(text)
        elif not (text.isascii() and text.isprintable()):
            raise UsageError(f"pattern {text!r}: only printable ASCII characters are allowed")
    return chosen


def spelling(name: str, component: Component) -> str:
    """Return the vehicle's spelling of a name in upper or lower case.

    A name that fits several parameters in upper and lower case, and is none of them, is returned unchanged:
    the vehicle has no such parameter.
    """
    if name in component.params:
        return name
    upper = name.upper()
    known = [each for each in component.params if each.upper() == upper]
    if known:
        return known[0] if len(known) == 1 else name
    return upper if component.autopilot in _CAPITALS else name
