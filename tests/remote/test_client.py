"""Programs that use a service: at once, while it restarts, when it is gone; and what is not given over it."""

from __future__ import annotations

import asyncio
import hashlib
import math
import os
import random
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from typing import Any

import anyio
import httpx
import pytest
from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st
from starlette.types import ASGIApp, Receive, Scope, Send

from paramclient import (
    AnotherVehicle,
    Change,
    Component,
    Discovered,
    Events,
    LinkError,
    NoReply,
    ParamClient,
    Refused,
    Resynced,
    SigningKey,
    SyncState,
    Trust,
    UsageError,
)
from paramclient.client import reconnect_delays
from paramclient.client.client import implementation_of
from paramclient.metadata import metadata_of
from paramclient.protocol import wire
from paramclient.remote import RemoteClient, RemoteComponent
from paramclient.remote.http import STREAM_TIMEOUT
from paramclient.remote.service_client import ServiceClient
from paramclient.service import Hub, Settings, create_app
from paramclient.service.access import AccessSettings
from paramclient.service.tokens import TokenHolder, Tokens
from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle
from tests.asgi import ASGITransport
from tests.shell import (
    FlakyLink,
    Tap,
    a_client,
    generic,
    in_simulated_time,
    outcome,
    settled,
    shorten_feed,
    small_px4,
    until,
)

URL = "http://127.0.0.1:8765"
TOKENS = {"anna": "write", "ben": "read"}


class Network(httpx.AsyncBaseTransport):
    """The way from programs to a service, which may break.

    Attributes:
        app: the service that answers, or None while there is none.
        requested: the requests over it: method and path.
        is_held: no part of a response arrives.
    """

    def __init__(self, app: ASGIApp | None) -> None:
        self.app = app
        self.requested: list[str] = []
        self.is_held = False
        self._cut = asyncio.Event()
        self._released = asyncio.Event()

    def cut(self, *, for_good: bool = False) -> None:
        """Every connection breaks; with `for_good` there is no new one either."""
        if for_good:
            self.app = None
        cut, self._cut = self._cut, asyncio.Event()
        cut.set()

    def release(self) -> None:
        """Let through what was held up."""
        self.is_held = False
        released, self._released = self._released, asyncio.Event()
        released.set()

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        if self.app is None:
            raise httpx.ConnectError("connection refused")
        self.requested.append(f"{request.method} {request.url.path}")
        transport = ASGITransport(self.app)
        cut = self._cut
        response = await self._unless(cut, transport.handle_async_request(request))
        return httpx.Response(
            response.status_code, headers=response.headers, stream=_Stream(self, cut, response)
        )

    async def _unless(self, cut: asyncio.Event, work: Any) -> Any:
        """Do this, unless the connection breaks before it is done."""
        doing, breaking = asyncio.ensure_future(work), asyncio.ensure_future(cut.wait())
        try:
            await asyncio.wait([doing, breaking], return_when=asyncio.FIRST_COMPLETED)
            if not doing.done():
                raise httpx.ReadError("connection reset")
            return doing.result()
        finally:
            for task in (doing, breaking):
                task.cancel()
            with suppress(asyncio.CancelledError, StopAsyncIteration):
                await asyncio.wait([doing, breaking])


class _Stream(httpx.AsyncByteStream):
    def __init__(self, network: Network, cut: asyncio.Event, response: httpx.Response) -> None:
        self._network = network
        self._cut = cut
        self._response = response

    async def __aiter__(self) -> AsyncIterator[bytes]:
        assert isinstance(self._response.stream, httpx.AsyncByteStream)
        chunks = self._response.stream.__aiter__()
        while True:
            try:
                chunk = await self._network._unless(self._cut, anext(chunks))
            except StopAsyncIteration:
                return
            while self._network.is_held:
                await self._network._unless(self._cut, self._network._released.wait())
            yield chunk

    async def aclose(self) -> None:
        await self._response.aclose()


def a_hub(*links: Any, **options: Any) -> Hub:
    """Links by a simulated vehicle or as (name, what gives its client)."""
    named = [
        link if isinstance(link, tuple) else ("sim:custom", lambda link=link: a_client(link))
        for link in links
    ]
    return Hub(named, **{"cache": False, "fetches": False} | options)


@asynccontextmanager
async def a_service(*links: Any, **options: Any) -> AsyncIterator[Network]:
    """A service with these links, and the way to it."""
    async with a_hub(*links, **options) as hub:
        yield Network(create_app(hub))


class Station:
    """A computer with a vehicle on its only link, on which the service may be stopped and started.

    Attributes:
        hub: of the service that runs.
        app: the service itself.
    """

    def __init__(self, vehicle: Any) -> None:
        self._vehicle = vehicle
        self._stop = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Station:
        await self.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.stop()

    async def start(self) -> None:
        """Begin another run of the service."""
        self.hub = a_hub(self._vehicle)
        self.app = create_app(self.hub)
        self._stop, ready = asyncio.Event(), asyncio.Event()
        self._task = asyncio.create_task(self._run(ready))
        await ready.wait()

    async def stop(self) -> None:
        """End the run in good order."""
        self._stop.set()
        assert self._task is not None
        await self._task

    async def _run(self, ready: asyncio.Event) -> None:
        async with self.hub:
            ready.set()
            await self._stop.wait()


def a_program(network: Network, *, link: str = "", token: str | None = None) -> RemoteClient:
    """A client over it."""
    return RemoteClient(URL + (f"?link={link}" if link else ""), transport=network, token=token)


def trusts(component: Any) -> set[Trust]:
    return {param.trust for param in component.params.values()}


def values(component: Any) -> dict[str, Any]:
    return {name: (param.value, param.trust) for name, param in component.params.items()}


# Several programs


@in_simulated_time
async def test_two_programs_that_fetch_at_once_cause_one_download() -> None:
    vehicle = generic(period=0.1)
    async with a_service(vehicle) as network, a_program(network) as one, a_program(network) as other:
        components = [await client.component() for client in (one, other)]
        async with asyncio.TaskGroup() as tasks:
            fetches = [tasks.create_task(component.fetch_all()) for component in components]
            again = tasks.create_task(other.fetch_all())
        assert vehicle.requests["PARAM_REQUEST_LIST"] == 1
        results = [fetch.result() for fetch in fetches] + [again.result().results[1, 1]]
        for result in results:
            assert result.complete
            assert dict(result.params) == vehicle.params


@in_simulated_time
async def test_a_program_that_leaves_ends_no_download_of_another_program() -> None:
    vehicle = generic(burst=1, period=0.1)
    async with a_service(vehicle) as network, a_program(network) as one, a_program(network) as other:
        leaving = asyncio.create_task((await one.component()).fetch_all())
        staying = asyncio.create_task((await other.component()).fetch_all())
        await asyncio.sleep(1.0)
        leaving.cancel()
        assert (await staying).complete
        assert vehicle.requests["PARAM_REQUEST_LIST"] == 1


@in_simulated_time
async def test_a_write_is_watched_and_forced_over_a_service() -> None:
    async with a_service(PX4Vehicle()) as network, a_program(network) as client:
        component = await client.component()
        done = await component.set("MPC_TILTMAX_LND", 80.0, settle=1.2)
        assert (done.status, done.actual) == ("adjusted", 45.0)
        with pytest.raises(UsageError, match="cannot save NaN"):
            await component.set("MC_ROLL_P", math.nan)
        assert (await component.set("MC_ROLL_P", math.nan, force=True)).status == "accepted"
        with pytest.raises(UsageError, match="settle"):
            await component.set("MC_ROLL_P", 1.0, settle=math.nan)


@in_simulated_time
async def test_two_that_set_one_name_are_put_in_order_and_each_learns_what_happened() -> None:
    tap = Tap(generic())
    slow = Air.symmetric([tap], delay=0.1)
    async with a_service(slow) as network, a_program(network) as one, a_program(network) as other:
        first, second = [await client.component() for client in (one, other)]
        await first.fetch_all()
        changes = second.changes()
        results = await asyncio.gather(first.set("PARAM_01", 10), second.set("PARAM_01", 11))
        assert [(result.status, result.actual) for result in results] == [("accepted", 10), ("accepted", 11)]
        sent = [int.from_bytes(each.raw, "little") for each in tap.messages(wire.ParamSetMessage)]
        assert sent == [10, 11]
        assert first.params["PARAM_01"].value == second.params["PARAM_01"].value == 11
        reported = await anext(changes)
        assert (reported.name, reported.new and reported.new.value, reported.by) == ("PARAM_01", 11, "us")


@in_simulated_time
async def test_other_clients_receive_the_author_of_a_change() -> None:
    access = AccessSettings(tokens=tokens())
    async with a_hub(small_px4()) as hub:
        network = Network(create_app(hub, Settings(access=access)))
        async with (
            a_program(network, token="anna-" + SECRET) as anna,
            a_program(network, token="ben-" + SECRET) as ben,
        ):
            hers, his = await anna.component(), await ben.component()
            await hers.get("PARAM_01")
            mine, theirs = hers.changes(), his.changes()
            await hers.set("PARAM_01", 5)
            assert (await anext(mine)).by == "us"
            assert (await anext(theirs)).by == f"us for anna@127.0.0.1 (paramclient {os.getpid()})"
            with pytest.raises(UsageError):
                await his.set("PARAM_01", 6)
            assert hers.params["PARAM_01"].value == 5


SECRET = "0123456789abcdef0123456789abcdef0123456789"


def tokens() -> Tokens:
    return Tokens(
        (TokenHolder(name, role), hashlib.sha256(f"{name}-{SECRET}".encode()).digest())  # type: ignore[arg-type]
        for name, role in TOKENS.items()
    )


# What is known


@in_simulated_time
async def test_a_program_sees_what_the_service_knows_at_once() -> None:
    vehicle = PX4Vehicle()
    async with a_service(vehicle) as network:
        async with a_program(network) as first:
            await (await first.component()).fetch_all()
        requests = vehicle.requests.copy()
        async with a_program(network) as client:
            events = client.events()
            component = await client.component()
            assert len(component.params) == len(vehicle.params)
            assert trusts(component) == {Trust.LIVE}
            assert component.sync_state is SyncState.SYNCED
            assert component.hash == vehicle.announced_hash()
            assert component.identity.uid is not None
            assert repr(component).startswith("<RemoteComponent 1/1 px4 synced 903 params from stream in ")
            assert await anext(events) == Discovered(component)
            assert client.autopilots == [component]
        assert vehicle.requests == requests, "and asks the vehicle for nothing"


@in_simulated_time
async def test_the_numbers_are_those_of_the_links() -> None:
    async with a_service(generic()) as network, a_program(network) as client:
        component = await client.component()
        await component.fetch_all()
        await client.fetch_all(refresh=True)
        stats = client.stats
        assert stats.downloads == 2
        assert client.bytes_received == stats.bytes_received > 24 * 30
        assert (1, 1) in stats.round_trips
        await component.get("PARAM_01")
        await asyncio.sleep(1.0)
        assert client.stats.reads == stats.reads + 1
        assert not client.listens_only


@in_simulated_time
async def test_components_on_several_links() -> None:
    links = [
        ("one", lambda: a_client(Air([generic(), generic(system=2)]))),
        ("two", lambda: a_client(Air([generic(), generic(system=3)]))),
    ]
    async with a_service(*links) as network:
        async with a_program(network) as client:
            await client.component(3)
            await client.component(2)
            assert client.components.keys() == {(2, 1), (3, 1)}
            with pytest.raises(UsageError, match=r"1/1 is on one and two of the service; choose one"):
                await client.component(1)
            assert (await client.fetch_all(2)).results.keys() == {(2, 1)}
        async with a_program(network, link="two") as client:
            component = await client.component(1)
            assert isinstance(component, RemoteComponent)
            assert component.link_name == "two"
            await component.set("PARAM_01", 77)
            assert set(client.components) == {(1, 1), (3, 1)}
            with pytest.raises(NoReply):
                await client.component(2, timeout=0.5)
            assert (await client.fetch_all()).results.keys() == {(1, 1), (3, 1)}
        with pytest.raises(UsageError, match="has no link three; it has one, two"):
            async with a_program(network, link="three"):
                pass


@in_simulated_time
async def test_calls_that_a_service_lacks_raise_usage_errors() -> None:
    async with a_service(small_px4()) as network, a_program(network) as client:
        component = await client.component()
        refused: list[Callable[[], Any]] = [
            lambda: client.ftp(component),
            client.traffic_report,
            client.signing_report,
        ]
        for call in refused:
            with pytest.raises(UsageError, match="a service does not give"):
                call()
        for requested in (
            component.setup_signing(SigningKey(bytes(range(32))), link_is_safe=True),
            metadata_of(component),
            client.link.open(),
            client.link.receive(),
            client.link.send(b"", None),
        ):
            with pytest.raises(UsageError, match="a service does not give"):
                await requested
        assert not hasattr(component, "nothing_such")
        assert not hasattr(client, "nothing_such")


@in_simulated_time
async def test_a_restart_of_a_vehicle_goes_over_the_service() -> None:
    vehicle = PX4Vehicle(table={"MAV_SYS_ID": 1, "PARAM_01": 1}, reboot_down=2.0)
    async with a_service(vehicle) as network, a_program(network) as client:
        component = await client.component()
        await component.set("MAV_SYS_ID", 7)
        changed = await component.reboot(system=7)
        assert (changed.system, changed.component) == (7, 1)
        assert changed is client.components[7, 1]
        with pytest.raises((NoReply, AnotherVehicle)):
            await client.successor(changed, 9, timeout=1.0)
    armed = PX4Vehicle(table={"PARAM_01": 1}, armed=True)
    async with a_service(armed) as network, a_program(network) as client:
        component = await client.component()
        assert component.is_armed is True
        with pytest.raises(Refused) as caught:
            await component.reboot()
        assert type(caught.value).__name__ == "CommandRefused"


# Services that restart


@in_simulated_time
async def test_a_service_that_starts_again_in_the_middle() -> None:
    vehicle = small_px4()
    async with Station(vehicle) as station:
        network = Network(station.app)
        async with a_program(network) as client:
            component = await client.component()
            for _ in range(3):  # so that the next run of the service counts from far below
                await component.fetch_all(refresh=True)
            assert trusts(component) == {Trust.LIVE}
            assert component.state == "synced"
            assert armed(component) is False
            changes, events = component.changes(), client.events()
            network.app = None
            await station.stop()
            await settled()
            assert "reconnecting" in repr(client)
            assert trusts(component) == {Trust.CACHED}
            assert component.state == "cached"
            assert component.sync_state is SyncState.UNSYNCED
            assert armed(component) is None
            waiting = asyncio.create_task(component.get("PARAM_02"))
            vehicle.set_param("PARAM_01", 1001)
            await asyncio.sleep(3.0)
            assert not waiting.done()
            assert component.silence >= 3.0
            await station.start()
            await asyncio.sleep(1.5)
            network.app = station.app
            assert (await waiting).value == 2
            assert component.state == "partial", "another run of the service knows nothing yet"
            assert "open" in repr(client)
            assert (await client.component()) is component
            await component.fetch_all()
            assert component.params["PARAM_01"].value == 1001
            assert trusts(component) == {Trust.LIVE}
            reported = {change.name: change async for change in _waiting(changes)}
            assert reported["PARAM_01"].new is not None
            assert reported["PARAM_01"].new.value == 1001
            assert not [event for event in events._waiting if isinstance(event, Discovered)]


def armed(component: Component) -> bool | None:
    return component.is_armed


async def _waiting(changes: Any) -> AsyncIterator[Change]:
    with suppress(TimeoutError):
        while True:
            yield await asyncio.wait_for(anext(changes), 0.5)


@in_simulated_time
async def test_a_connection_that_breaks_loses_nothing_and_loads_nothing_anew() -> None:
    vehicle = small_px4()
    async with a_service(vehicle) as network, a_program(network) as client:
        component = await client.component()
        await component.fetch_all()
        changes = component.changes()
        read = asyncio.create_task(component.get("PARAM_07"))
        network.requested.clear()
        app = network.app
        network.cut(for_good=True)
        for value in (100, 101):
            vehicle.set_param("PARAM_01", value)
            vehicle.set_param("PARAM_02", value)
            await asyncio.sleep(1.2)
        assert trusts(component) == {Trust.CACHED}
        network.app = app
        assert (await read).value == 7
        assert trusts(component) == {Trust.LIVE}
        reported = [await anext(changes), await anext(changes)]
        assert sorted((each.name, each.new and each.new.value) for each in reported) == [
            ("PARAM_01", 101),
            ("PARAM_02", 101),
        ]
        assert not [requested for requested in network.requested if requested.endswith("/params")]


@in_simulated_time
async def test_a_network_that_falls_silent_is_noticed() -> None:
    async with a_service(small_px4()) as network, a_program(network) as client:
        component = await client.component()
        await component.fetch_all()
        await asyncio.sleep(60.0)
        assert trusts(component) == {Trust.LIVE}, "a service that has nothing to say says that"
        network.is_held = True
        await asyncio.sleep(STREAM_TIMEOUT + 2.1)
        assert trusts(component) == {Trust.CACHED}
        network.release()
        await asyncio.sleep(2.0)
        assert trusts(component) == {Trust.LIVE}


@in_simulated_time
async def test_a_service_that_stays_unreachable(caplog: pytest.LogCaptureFixture) -> None:
    async with a_service(small_px4()) as network, a_program(network) as client:
        component = await client.component()
        app = network.app
        network.cut(for_good=True)
        began = anyio.current_time()
        calls: list[Callable[[], Any]] = [
            lambda: component.get("PARAM_01"),
            lambda: component.set("PARAM_01", 5),
            component.fetch_all,
            component.refreshed,
            lambda: client.component(timeout=None),
            client.fetch_all,
        ]
        limited = asyncio.create_task(outcome(component.get("PARAM_01", timeout=2.0)))
        failed = await asyncio.gather(*(outcome(call()) for call in calls))
        for error in failed:
            assert type(error) is LinkError
            assert "connection refused" in str(error)
        assert abs(anyio.current_time() - began - reconnect_delays.LINK_TIMEOUT) < 0.5
        assert isinstance(await limited, NoReply)
        began = anyio.current_time()
        for call in calls:
            assert type(await outcome(call())) is LinkError
        assert anyio.current_time() - began < 0.01
        network.app = app
        await asyncio.sleep(reconnect_delays.RECONNECT_BACKOFF_MAX + 0.1)
        assert (await component.set("PARAM_01", 5)).actual == 5
    reported = [each.getMessage() for each in caplog.records if each.name.startswith("paramclient.remote")]
    assert len([text for text in reported if "reconnecting" in text]) == 1


@in_simulated_time
async def test_a_write_whose_answer_is_lost_is_not_sent_again() -> None:
    tap = Tap(generic())
    async with a_service(tap) as network, a_program(network) as client:
        component = await client.component()
        await component.fetch_all()
        tap.is_mute = True
        write = asyncio.create_task(outcome(component.set("PARAM_01", 5)))
        await asyncio.sleep(0.05)
        network.cut()
        error = await write
        assert type(error) is LinkError
        assert "it is unknown whether PARAM_SET PARAM_01 to 1/1 was done" in str(error)
        tap.is_mute = False
        await asyncio.sleep(3.0)
        assert network.requested.count("PATCH /api/v1/components/1/1/params") == 1
        assert (await component.get("PARAM_01")).value == 5


@in_simulated_time
async def test_a_slow_listener_that_has_missed_events_loads_anew() -> None:
    vehicle = generic()
    async with a_hub(vehicle) as hub:
        shorten_feed(hub.feed, 8)
        network = Network(create_app(hub))
        async with a_program(network) as client:
            component = await client.component()
            await component.fetch_all()
            own = hub.followed[0].component
            network.is_held = True
            for value in range(2000):
                vehicle.set_param(f"PARAM_{value % 24:02}", value + 100)
                if value % 100 == 99:
                    await own.get(f"PARAM_{value % 24:02}")
            await own.fetch_all(refresh=True)
            assert values(component) != values(own)
            network.requested.clear()
            network.release()
            await asyncio.sleep(1.0)
            assert "GET /api/v1/components/1/1/params" in network.requested
            assert values(component) == values(own)


@in_simulated_time
async def test_the_links_of_a_service_may_be_disconnected() -> None:
    link = FlakyLink(small_px4())
    async with a_service(("tcp:flaky:5760", lambda: a_client(link))) as network, a_program(network) as client:
        component = await client.component()
        await component.fetch_all()
        events = client.events()
        await link.drop(stays_offline=True)
        began = anyio.current_time()
        error = await outcome(component.get("PARAM_01"))
        assert type(error) is LinkError
        assert error.link == "tcp:flaky:5760"
        assert anyio.current_time() - began >= reconnect_delays.LINK_TIMEOUT - 0.5
        link.is_offline = False
        resynced = await next_of(Resynced, events)
        assert resynced.component is component
        await component.refreshed()
        assert component.sync_state is SyncState.SYNCED


async def next_of(kind: Any, events: Events) -> Any:
    async with asyncio.timeout(60):
        async for event in events:
            if isinstance(event, kind):
                return event
    raise AssertionError("events have no end")


# Addresses without a service, or without access


def answering(status: int, body: bytes, kind: str = "text/html", **headers: str) -> ASGIApp:
    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        raw = [(b"content-type", kind.encode())] + [(k.encode(), v.encode()) for k, v in headers.items()]
        await send({"type": "http.response.start", "status": status, "headers": raw})
        await send({"type": "http.response.body", "body": body})

    return app


@pytest.mark.parametrize(
    ("app", "words"),
    [
        (answering(200, b"<h1>Router</h1>"), "not as a service of paramclient"),
        (answering(404, b"not here"), "not as a service of paramclient"),
        (answering(302, b"", location="http://elsewhere/"), "not as a service of paramclient"),
        (answering(200, b'{"a": 1}', "application/json"), "not as a service of paramclient"),
        (answering(404, b'{"detail": "x"}', "application/json"), "127.0.0.1:8765: x"),
        (answering(200, b"data: 5\n\n", "text/event-stream"), "document of the service is not valid"),
        (answering(200, b"data: {x\n\n", "text/event-stream"), "not as a service of paramclient"),
        (answering(200, b"", "text/event-stream"), "has ended the event stream"),
        (answering(502, b"bad gateway"), "a proxy responds with HTTP status 502"),
        (None, "connection refused"),
    ],
    ids=["page", "nothing", "elsewhere", "json", "problem", "number", "noise", "end", "proxy", "nobody"],
)
@in_simulated_time
async def test_an_address_that_is_no_service_is_a_link_error(app: ASGIApp | None, words: str) -> None:
    with pytest.raises(LinkError, match=words) as caught:
        async with a_program(Network(app)):
            pass
    assert caught.value.link == URL


@in_simulated_time
async def test_a_service_that_does_not_respond_is_given_up() -> None:
    async def silent(scope: Scope, receive: Receive, send: Send) -> None:
        while (await receive())["type"] != "http.disconnect":
            pass

    began = anyio.current_time()
    with pytest.raises(LinkError, match="does not respond"):
        async with a_program(Network(silent)):
            pass
    assert anyio.current_time() - began < 11.0


@in_simulated_time
async def test_a_wrong_token_is_reported_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PARAMCLIENT_TOKEN", raising=False)
    async with a_hub(generic()) as hub:
        network = Network(create_app(hub, Settings(access=AccessSettings(tokens=tokens()))))
        for token, words in ((None, "requires a token"), ("nonsense", "refuses the token")):
            with pytest.raises(UsageError, match=words) as caught:
                async with a_program(network, token=token):
                    pass
            assert "PARAMCLIENT_TOKEN" in str(caught.value)
            assert "nonsense" not in str(caught.value)
        monkeypatch.setenv("PARAMCLIENT_TOKEN", f"ben-{SECRET}")
        async with a_program(network) as client:
            component = await client.component()
            assert (await component.fetch_all()).complete, "who may read may fetch"


# Whatever happens


STEPS = ["change", "change", "set", "get", "fetch", "cut", "down", "up", "restart", "wait", "wait"]


@settings(max_examples=15, deadline=None, phases=[Phase.explicit, Phase.reuse, Phase.generate])
@given(st.lists(st.sampled_from(STEPS), min_size=3, max_size=25), st.integers(0, 2**32))
@example(  # a value is read, set and listed while the answer to the read is on its way
    [
        "get",
        "restart",
        "set",
        "change",
        "fetch",
        "change",
        "cut",
        "set",
        "set",
        "cut",
        "cut",
        "change",
        "wait",
        "down",
    ],
    241,
)
def test_a_mirror_equals_the_table_of_the_service_after_anything(steps: list[str], seed: int) -> None:
    in_simulated_time(follow)(steps, random.Random(seed))


async def follow(steps: list[str], draw: random.Random) -> None:
    vehicle = small_px4()
    calls: list[asyncio.Task[Any]] = []
    async with Station(vehicle) as station:
        network = Network(station.app)
        async with a_program(network) as client:
            component = await client.component()
            for step in steps:
                name, value = f"PARAM_{draw.randrange(24):02}", draw.randrange(1000)
                match step:
                    case "change":
                        vehicle.set_param(name, value)
                    case "set":
                        calls.append(asyncio.create_task(outcome(component.set(name, value, timeout=3))))
                    case "get":
                        calls.append(asyncio.create_task(outcome(component.get(name, timeout=3))))
                    case "fetch":
                        calls.append(asyncio.create_task(outcome(component.fetch_all(timeout=3))))
                    case "cut":
                        network.cut()
                    case "down":
                        network.cut(for_good=True)
                    case "up":
                        network.app = station.app
                    case "restart":
                        is_down = network.app is None
                        await station.stop()
                        await station.start()
                        network.app = None if is_down else station.app
                    case "wait":
                        await asyncio.sleep(draw.choice((0.0, 0.01, 0.3, 2.0)))
                if network.app is None:
                    await settled()
                    assert trusts(component) <= {Trust.CACHED}
            network.app = station.app
            await asyncio.gather(*calls)
            await until(lambda: "open" in repr(client))
            assert await client.component() is component
            await asyncio.sleep(3.0)
            own = station.hub.followed[0].component
            assert values(component) == values(own)


def test_a_program_is_one_kind_of_client() -> None:
    client = ParamClient(URL)
    assert isinstance(client, ParamClient)
    assert type(implementation_of(client)) is ServiceClient
    assert not isinstance(ArduPilotVehicle(), ParamClient)
