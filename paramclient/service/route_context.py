"""Shared parts of routes: component, author and quota of a request, values, cancellation."""

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
from paramclient.model.values import Param, WireValue, from_bits, type_name
from paramclient.service import access
from paramclient.service.followed_component import FollowedComponent
from paramclient.service.hub import Hub
from paramclient.service.link import COMPONENTS_PER_TURN
from paramclient.service.problems import ServiceError

if TYPE_CHECKING:
    from paramclient.metadata import Metadata

__all__ = [
    "Bits",
    "Finite",
    "LinkName",
    "Raw",
    "Seconds",
    "Target",
    "HubArgument",
    "ValueInput",
    "run_until_disconnect",
    "author_of",
    "holder_of",
    "require_write",
    "parse_value",
    "resolve_value",
]

Result = TypeVar("Result")


async def hub_of(request: Request) -> Hub:
    """Return the hub of the application."""
    hub: Hub = request.app.state.hub
    return hub


HubArgument = Annotated[Hub, Depends(hub_of)]

LinkName = Annotated[
    str | None,
    Query(max_length=200, description="Name of the link, needed if several links have the same ids."),
]
Seconds = Annotated[
    float | None,
    Field(
        gt=0, le=86_400, description="Timeout in seconds; null derives it from the measured round-trip time."
    ),
]


async def target_of(
    hub: HubArgument,
    system: Annotated[int, Path(ge=1, le=255)],
    component: Annotated[int, Path(ge=0, le=255)],
    link: LinkName = None,
) -> FollowedComponent:
    """Return the component with the ids in the path."""
    return hub.find_component(system, component, link)


Target = Annotated[FollowedComponent, Depends(target_of)]


def author_of(request: Request) -> str:
    """Return the author of a request for the history."""
    author: str = request.scope["state"]["author"]
    return author


def holder_of(request: Request) -> str:
    """Return the holder of the quotas of a request: of its token, else its address."""
    holder: str = request.scope["state"]["quota"]
    return holder


async def require_write(request: Request) -> None:
    """Reject a request without write permission, on paths that do not always require it.

    Raises:
        ServiceError: 403, write permission is missing.
    """
    if not access.may_write(request):
        raise ServiceError(403, "forbidden", "This request requires write permission.")


async def run_until_disconnect(
    request: Request, work: Callable[[], Awaitable[Result]], *about: FollowedComponent
) -> Result:
    """Run the work of a request, and cancel it if the client disconnects.

    Events of its changes are published before the response, also after an error.

    Args:
        request: a request whose body is received.
        work: the work.
        about: components that it may change.

    Raises:
        ServiceError: 429, too many requests wait, of this holder or in total; the work is not started.
    """
    outcome: Result | Exception = ServiceError(499, "gone", "The client has disconnected.")
    hub = await hub_of(request)
    with hub.waiting_requests[access.may_write(request)].hold(holder_of(request)):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(_cancel_on_disconnect, request, tasks.cancel_scope)
            try:
                outcome = await work()
            except Exception as error:  # the task group would wrap it
                outcome = error
            tasks.cancel_scope.cancel()
    for number, followed in enumerate(about, 1):
        followed.publish_changes()
        if not number % COMPONENTS_PER_TURN:
            await anyio.lowlevel.checkpoint()
    if isinstance(outcome, Exception):
        raise outcome
    return outcome


class Bits(Body):
    """A value by its bits, as in the member `bits` of a parameter."""

    bits: Annotated[str, Field(pattern="^[0-9a-fA-F]{1,16}$")]


class Raw(Body):
    """A value by the four bytes of the message."""

    raw: Annotated[str, Field(pattern="^[0-9a-fA-F]{8}$")]


Finite = Annotated[StrictFloat, Field(allow_inf_nan=False)]
"""A finite JSON number: 1e400 would become infinity, which has a word of its own."""

ValueInput = Annotated[
    StrictInt | Finite | Annotated[str, Field(max_length=400)] | Bits | Raw,
    Field(description='A number, "NaN", "Infinity", the name of a value or of bits, or {"bits": …}.'),
]


async def resolve_value(
    followed: FollowedComponent, name: str, given: int | float | str | Bits | Raw
) -> WireValue:
    """Return the value of a request.

    Raises:
        UsageError: no value has this name, or the bits do not fit the type.
        ParamClientError: the vehicle did not send the type of the parameter.
    """
    if not isinstance(given, Bits):
        return parse_value(followed.metadata, name, given)
    known = followed.component.params.get(name)
    if known is None:
        known = await followed.component.get(name)
    return _of_bits(int(given.bits, 16), known)


def parse_value(metadata: Metadata | None, name: str, given: int | float | str | Raw) -> WireValue:
    """Return a value that is not given by bits, which would need the vehicle's type.

    Raises:
        UsageError: no value has this name.
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
        raise UsageError(
            f"{name}: {given!r} is not a number, and the service has no metadata with value names"
        )
    return info.parse(given)


def _of_bits(bits: int, known: Param) -> WireValue:
    """Return the value with these bits in the type of a parameter.

    Raises:
        UsageError: the bits do not fit the type.
    """
    if bits >> (32 if known.is_raw else 8 * known.type.size):
        raise UsageError(f"{known.name}: {bits:x} has more bits than {type_name(known.type_number)}")
    return from_bits(bits, known.type_number, is_raw=known.is_raw)


async def _cancel_on_disconnect(request: Request, scope: anyio.CancelScope) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass
    scope.cancel()
