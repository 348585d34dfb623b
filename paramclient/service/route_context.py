"""What routes have in common: whom a request is about, who asks, and what becomes of it when they leave."""

from __future__ import annotations

import binascii
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Annotated, TypeVar

import anyio
import anyio.lowlevel
from fastapi import Depends, Path, Query, Request
from pydantic import Field, StrictFloat, StrictInt

from paramclient.documents.document import Body
from paramclient.errors import UsageError
from paramclient.metadata.info import number_of
from paramclient.model.values import Param, ParamType, Value, from_bits, type_name
from paramclient.service import access
from paramclient.service.followed_component import Followed
from paramclient.service.hub import Hub
from paramclient.service.link import LOOKED_AT_ONCE
from paramclient.service.problems import ServiceError

if TYPE_CHECKING:
    from paramclient.metadata import Metadata

__all__ = [
    "Bits",
    "LinkName",
    "Raw",
    "Seconds",
    "Target",
    "TheHub",
    "ValueGiven",
    "answered",
    "asker_of",
    "holder_of",
    "may_write",
    "value_meant",
    "value_of",
]

Result = TypeVar("Result")


async def hub_of(request: Request) -> Hub:
    """The hub of the application that a request has come to."""
    hub: Hub = request.app.state.hub
    return hub


TheHub = Annotated[Hub, Depends(hub_of)]

LinkName = Annotated[
    str | None, Query(max_length=200, description="The name of a link, where several carry the same ids.")
]
Seconds = Annotated[
    float | None,
    Field(gt=0, le=86_400, description="Seconds until giving up; null leaves it to the measured round trip."),
]


async def target_of(
    hub: TheHub,
    system: Annotated[int, Path(ge=1, le=255)],
    component: Annotated[int, Path(ge=0, le=255)],
    link: LinkName = None,
) -> Followed:
    """The component that an address names."""
    return hub.find(system, component, link)


Target = Annotated[Followed, Depends(target_of)]


def asker_of(request: Request) -> str:
    """Who asks, as the history names them."""
    asker: str = request.scope["state"]["asker"]
    return asker


def holder_of(request: Request) -> str:
    """Of whose quota a request is: of the token's that came with it, else of the address's."""
    holder: str = request.scope["state"]["quota"]
    return holder


async def may_write(request: Request) -> None:
    """Refuse those who may only read, where the address alone does not tell what is asked for.

    Raises:
        ServiceError: this is one of them.
    """
    if not access.may_write(request):
        raise ServiceError(403, "forbidden", "This may be done by those only who may write.")


async def answered(request: Request, work: Callable[[], Awaitable[Result]], *about: Followed) -> Result:
    """Do what was asked for, unless they leave before it is done; then it is cancelled, for them alone.

    What it has changed is among the events before the answer begins, whatever the outcome.

    Args:
        request: it must have been read to its end.
        work: what to do.
        about: the components that it may change.
    """
    outcome: Result | Exception = ServiceError(499, "gone", "Whoever asked has left.")
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(_cancel_when_gone, request, tasks.cancel_scope)
        try:
            outcome = await work()
        except Exception as error:  # out of the group it would come wrapped
            outcome = error
        tasks.cancel_scope.cancel()
    for number, followed in enumerate(about, 1):
        followed.look()
        if not number % LOOKED_AT_ONCE:
            await anyio.lowlevel.checkpoint()
    if isinstance(outcome, Exception):
        raise outcome
    return outcome


class Bits(Body):
    """A value by the digits of its bits, as `bits` of a parameter has them."""

    bits: Annotated[str, Field(pattern="^[0-9a-fA-F]{1,16}$")]


class Raw(Body):
    """A value by the four bytes of the message, in their order."""

    raw: Annotated[str, Field(pattern="^[0-9a-fA-F]{8}$")]


Finite = Annotated[StrictFloat, Field(allow_inf_nan=False)]
"""A number of JSON: that of 1e400 would be read as an infinity, which only the word for it means."""

ValueGiven = Annotated[
    StrictInt | Finite | Annotated[str, Field(max_length=400)] | Bits | Raw,
    Field(description='A number, "NaN", "Infinity", the name of a value or of bits, or {"bits": …}.'),
]


async def value_of(followed: Followed, name: str, given: int | float | str | Bits | Raw) -> Value:
    """The value that somebody means.

    Raises:
        UsageError: there is none of this name, or the bits are of another type.
        ParamClientError: the type had to be asked for, and did not come.
    """
    if not isinstance(given, Bits):
        return value_meant(followed.metadata, name, given)
    known = followed.component.params.get(name)
    if known is None:
        known = await followed.component.get(name)
    return _of_bits(int(given.bits, 16), known)


def value_meant(metadata: Metadata | None, name: str, given: int | float | str | Raw) -> Value:
    """The same without bits, which mean nothing without the vehicle's type.

    Raises:
        UsageError: there is no value of this name.
    """
    if isinstance(given, Raw):
        return binascii.unhexlify(given.raw)
    if not isinstance(given, str):
        return given
    number = number_of(given)
    if number is not None:
        return number
    info = None if metadata is None else metadata.get(name)
    if info is None:
        raise UsageError(f"{name}: {given!r} is no number, and there is no description with names")
    return info.parse(given)


def _of_bits(bits: int, known: Param) -> Value:
    """The value of a parameter whose bits these would be."""
    size = known.type.size if isinstance(known.type, ParamType) else 4
    if bits >> (32 if known.is_raw else 8 * size):
        raise UsageError(f"{known.name}: {bits:x} has more bits than {type_name(known.type)}")
    return from_bits(bits, known.type, is_raw=known.is_raw)


async def _cancel_when_gone(request: Request, scope: anyio.CancelScope) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass
    scope.cancel()
