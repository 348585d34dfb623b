"""The ways to a vehicle: a client with a link of its own, one over a service that has it, a blocking one.

A test module that imports `pytest_generate_tests` and `way` runs each of its tests in all ways, as far as
they open their clients with `a_client`: what users see must be the same.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Collection, Mapping
from types import TracebackType
from typing import Any, TypeVar

import pytest

from paramclient import Component, Event, Events, ParamClient
from paramclient.cache import ParamCache
from paramclient.client.client import implementation_of
from paramclient.client.link_component import LinkComponent
from paramclient.client.local import local
from paramclient.client.subscription import Changes
from paramclient.remote import RemoteClient, RemoteComponent
from paramclient.remote.component import mirrored_of
from paramclient.remote.service_client import ServiceClient
from paramclient.service import Hub, create_app
from tests import shell
from tests.asgi import ASGITransport
from tests.awaitable_blocking import BlockedClient, BlockedStream, block, unblocked

__all__ = [
    "DIRECT",
    "ServedClient",
    "direct_only",
    "drained",
    "event_listeners",
    "listeners",
    "looks",
    "push",
    "pytest_generate_tests",
    "served",
    "way",
]

DIRECT = "direct"
SERVICE = "service"
BLOCKING = "blocking"

Test = TypeVar("Test", bound=Callable[..., object])


def direct_only(reason: str) -> Callable[[Test], Test]:
    """This test makes sense with a link of one's own alone, for this reason."""
    assert reason

    def mark(test: Test) -> Test:
        test.direct_only = reason  # type: ignore[attr-defined]  # a mark of our own
        return test

    return mark


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run each test in all ways, but for those that are marked."""
    is_direct = hasattr(metafunc.function, "direct_only")
    metafunc.parametrize("way", [DIRECT] if is_direct else [DIRECT, SERVICE, BLOCKING], indirect=True)


@pytest.fixture(autouse=True)
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The way that this test goes."""
    chosen: str = request.param
    if chosen == SERVICE:
        monkeypatch.setattr(shell, "client_of", ServedClient)
        monkeypatch.setattr(shell, "machine_of", lambda component: local(served(component)).machine)
    if chosen == BLOCKING:
        block(monkeypatch)
        monkeypatch.setattr(shell, "client_of", BlockedClient)
        monkeypatch.setattr(shell, "machine_of", lambda component: local(unblocked(component)).machine)
    return chosen


class ServedClient(RemoteClient):
    """A client over a service in this process that has this link, and ends with it.

    Args:
        link: the link.
        others: what further links of the service lead to, by their names.
        kept: the cache of the service; None without one.
        options: of the client that the service makes for the link.

    Attributes:
        hub: of the service.
        own: the client that the service has made for the link; None before.
        roster: the components that it mirrors.
    """

    def __init__(
        self,
        link: Any,
        *,
        others: Mapping[str, Any] | None = None,
        kept: ParamCache | None = None,
        **options: Any,
    ) -> None:
        self.own: ParamClient | None = None
        self._is_served = False
        OPENED.add(self)
        if kept is not None:
            options["cache"] = kept
        first = ParamClient(link, **options)
        unused = [first]

        def make() -> ParamClient:
            self.own = unused.pop() if unused else ParamClient(link, **options)
            return self.own

        more = [
            (name, lambda link=link: ParamClient(link, **options)) for name, link in (others or {}).items()
        ]
        self.hub = Hub([(first.link.name, make), *more], cache=kept or False, fetches=False)
        super().__init__("http://127.0.0.1:8765", transport=ASGITransport(create_app(self.hub)))
        implementation = implementation_of(self)
        assert isinstance(implementation, ServiceClient)
        self.roster = implementation._roster

    async def __aenter__(self) -> ServedClient:
        if self._is_served:
            return await super().__aenter__()  # it refuses
        self._is_served = True
        await self.hub.__aenter__()
        try:
            await super().__aenter__()
        except BaseException:
            await self.hub.__aexit__(None, None, None)
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            await super().__aexit__(kind, error, trace)
        finally:
            await self.hub.__aexit__(None, None, None)


OPENED: weakref.WeakSet[ServedClient] = weakref.WeakSet()
"""The clients over a service that were made here."""


def listeners(component: Component) -> Collection[Changes]:
    """Who listens to the changes of a component."""
    component = unblocked(component)
    if isinstance(component, RemoteComponent):
        return mirrored_of(component)._subscriptions
    assert isinstance(component, LinkComponent)
    return component._subscriptions


def event_listeners(client: ParamClient) -> Collection[Events]:
    """Who listens to the events of a client."""
    return implementation_of(unblocked(client))._subscriptions


def drained(events: Events) -> list[Event]:
    """What waits for a listener, which does not get it any more."""
    stream: Events = unblocked(events)
    waiting = list(stream._waiting)
    stream._waiting.clear()
    return [events.shown(each) for each in waiting] if isinstance(events, BlockedStream) else waiting


def push(events: Events, event: Event) -> None:
    """Let something happen, for one listener alone."""
    stream: Events = unblocked(events)
    stream.push(unblocked(event))


def looks(component: Component) -> str:
    """Its `repr`, without a word on where its link is."""
    return repr(component).replace("<Remote", "<")


def served(component: Component) -> Component:
    """The component as the program with the link has it."""
    if not isinstance(component, RemoteComponent):
        return component
    (client,) = (each for each in OPENED if each.roster is component._service)
    assert client.own is not None
    return client.own.components[component.system, component.component]
