"""Extended parameters over a service: exact values, several programs, and services that restart."""

from __future__ import annotations

import asyncio
import json
import math
import random
from collections.abc import Awaitable, Mapping
from typing import Any, TypeVar

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from paramclient import (
    Component,
    ExtParam,
    ExtParamType,
    ExtSetManyResult,
    ExtSettable,
    LinkError,
    SetStatus,
    Trust,
    UsageError,
    ValueUnsupported,
)
from paramclient.documents.extended_param import ExtParamDoc
from paramclient.model.ext_params import own_bytes
from paramclient.remote.decoding import ext_param_of
from paramclient.sim import Camera
from tests.remote.test_client import Network, Station, a_program, a_service
from tests.shell import Tap, in_simulated_time, outcome, settled, until

T = TypeVar("T")
MANY = {f"PARAM_{number:02}": number for number in range(40)}


def values(component: Component) -> dict[str, tuple[ExtParam, Trust]]:
    return {name: (param, param.trust) for name, param in component.ext.params.items()}


def trusts(component: Component) -> set[Trust]:
    return {param.trust for param in component.ext.params.values()}


@given(st.integers(1, 255), st.binary(max_size=128), st.sampled_from(Trust))
def test_a_parameter_loses_no_bit_on_the_way(kind: int, data: bytes, trust: Trust) -> None:
    param = ExtParam.of("PARAM", own_bytes(data, kind), kind, 3, trust)
    received = ext_param_of(json.loads(json.dumps(ExtParamDoc.kept(param).as_json(), allow_nan=False)))
    assert received == param
    assert (repr(received.value), received.type) == (repr(param.value), param.type)


@in_simulated_time
async def test_every_value_is_written_as_it_is() -> None:
    kinds = ExtParamType
    camera = Camera(
        {
            "U64": (kinds.UINT64, 1),
            "I64": (kinds.INT64, 1),
            "F32": (kinds.REAL32, 1.0),
            "F64": (kinds.REAL64, 1.0),
            "TEXT": "text",
            "BYTES": b"\xff",
            "ODD": (77, b"\x01"),
        }
    )
    async with a_service(camera) as network, a_program(network) as client:
        ext = (await client.component(1, 100)).ext
        await ext.fetch_all()
        good: list[tuple[str, ExtSettable]] = [
            *(("U64", 2**64 - 1), ("I64", -(2**63)), ("F64", 0.1), ("F64", math.inf), ("F32", -math.inf)),
            *(("TEXT", text) for text in ("NaN", "Infinity", "-Infinity", "5", "", "a,b{[\"\n'", "ü" * 64)),
            *(("BYTES", b"\x80" + 127 * b"\x11"), ("BYTES", b"\x00\xff"), ("ODD", b"\x00\x01")),
        ]
        for name, value in good:
            done = await ext.set(name, value)
            assert done.requested == done.actual == camera.ext_values[name] == ext.params[name].value, name
            assert (await ext.get(name)).value == value
        assert math.isnan(float((await ext.set("F32", math.nan)).actual))
        for name, wrong in (
            *(("TEXT", 5), ("TEXT", math.nan), ("U64", "5"), ("U64", b"\x05"), ("U64", -1), ("F64", "NaN")),
            *(("F64", b"NaN"), ("ODD", "text"), ("I64", 0.5)),
        ):
            before = camera.ext_values[name]
            with pytest.raises(UsageError):
                await ext.set(name, wrong)
            assert camera.ext_values[name] == before


@in_simulated_time
async def test_many_values_go_out_in_several_requests() -> None:
    camera = Camera({f"T{number:04}": "old" for number in range(1000)})
    async with a_service(camera) as network, a_program(network) as client:
        ext = (await client.component(1, 100)).ext
        wanted = {name: f"{number}".ljust(128, ",") for number, name in enumerate(camera.ext_values)}
        result = await ext.set_many([*wanted.items(), ("T0000", "last")])
        assert result.is_complete
        assert len(result.outcomes) == 1001
        assert camera.ext_values == wanted | {"T0000": "last"}
        assert network.requested.count("PATCH /api/v1/components/1/100/extended/params") == 3


@in_simulated_time
async def test_programs_see_the_changes_of_each_other() -> None:
    camera = Camera({"A": 1, "B": "text", "C": 3}, supported={"C": [3]})
    async with a_service(camera) as network, a_program(network) as one, a_program(network) as two:
        first, second = await one.component(1, 100), await two.component(1, 100)
        await first.ext.fetch_all()
        await until(lambda: second.ext.is_complete)
        mine, theirs = first.ext.changes(), second.ext.changes()
        await first.ext.set("A", 2)
        for changes in (mine, theirs):
            change = await anext(changes)
            assert (change.name, change.old and change.old.value, change.new and change.new.value) == (
                *("A", 1),
                2,
            )
        assert values(first) == values(second)
        camera.add_ext_param("D", b"\x00\xff")
        await second.ext.fetch_all()
        for changes in (mine, theirs):
            added = await anext(changes)
            assert (added.name, added.is_added, added.new and added.new.value) == ("D", True, b"\x00\xff")
        with pytest.raises(ValueUnsupported, match="value unsupported") as refused:
            await second.ext.set("C", 4)
        assert (refused.value.name, refused.value.code, refused.value.system) == ("C", 1, 1)


@in_simulated_time
async def test_a_program_has_what_the_service_knows_at_once() -> None:
    async with a_service(Camera()) as network, a_program(network) as first:
        await (await first.component(1, 100)).ext.fetch_all()
        async with a_program(network) as second:
            ext = (await second.component(1, 100)).ext
            assert (len(ext.params), ext.is_complete, ext.count, ext.is_spoken) == (16, True, 16, True)


@in_simulated_time
async def test_a_connection_that_breaks_loses_nothing_and_loads_nothing_anew() -> None:
    camera = Camera(MANY)
    async with a_service(camera) as network, a_program(network) as other, a_program(network) as client:
        component = await client.component(1, 100)
        await component.ext.fetch_all()
        offline = Network(network.app)
        changes = component.ext.changes()
        app = network.app
        network.cut(for_good=True)
        await settled()
        assert trusts(component) == {Trust.CACHED}
        async with a_program(offline) as third:
            await (await third.component(1, 100)).ext.set("PARAM_01", 100)
        network.requested.clear()
        network.app = app
        change = await anext(changes)
        assert (change.name, change.new and change.new.value) == ("PARAM_01", 100)
        assert trusts(component) == {Trust.LIVE}
        assert not [requested for requested in network.requested if requested.endswith("/params")]
        assert other.components


@in_simulated_time
async def test_a_write_whose_answer_is_lost_is_not_sent_again() -> None:
    tap = Tap(Camera(MANY))
    async with a_service(tap) as network, a_program(network) as client:
        ext = (await client.component(1, 100)).ext
        await ext.fetch_all()

        async def lost(call: Awaitable[T]) -> T | Exception:
            tap.is_mute = True
            write = asyncio.create_task(outcome(call))
            await asyncio.sleep(0.05)
            network.cut()
            reported = await write
            tap.is_mute = False
            await asyncio.sleep(3.0)
            return reported

        one = await lost(ext.set("PARAM_01", 5))
        assert isinstance(one, LinkError)
        assert "PARAM_EXT_SET PARAM_01 to 1/100 was done" in str(one)
        many = await lost(ext.set_many({"PARAM_02": 5}))
        assert isinstance(many, ExtSetManyResult)
        assert many.outcomes[0].status is SetStatus.UNKNOWN
        assert "PARAM_EXT_SET to 1/100 was done" in str(many.error)
        assert network.requested.count("PATCH /api/v1/components/1/100/extended/params") == 2


STEPS = ["change", "change", "set", "get", "fetch", "remove", "cut", "down", "up", "restart", "wait", "wait"]


@settings(max_examples=15, deadline=None, phases=[Phase.explicit, Phase.reuse, Phase.generate])
@given(st.lists(st.sampled_from(STEPS), min_size=3, max_size=25), st.integers(0, 2**32))
def test_a_mirror_equals_the_table_of_the_service_after_anything(steps: list[str], seed: int) -> None:
    in_simulated_time(follow)(steps, random.Random(seed))


async def follow(steps: list[str], draw: random.Random) -> None:
    camera = Camera(MANY)
    calls: list[asyncio.Task[Any]] = []
    async with Station(camera) as station:
        network = Network(station.app)
        async with a_program(network) as client:
            component = await client.component(1, 100)
            ext = component.ext
            for step in steps:
                name, value = draw.choice(list(camera.ext_values)), draw.randrange(1000)
                match step:
                    case "change":
                        camera.set_ext_param(name, value)
                    case "remove" if len(camera.ext_values) > 1:
                        camera.remove_ext_param(name)
                    case "set":
                        calls.append(asyncio.create_task(outcome(ext.set(name, value, timeout=3))))
                    case "get":
                        calls.append(asyncio.create_task(outcome(ext.get(name, timeout=3))))
                    case "fetch":
                        calls.append(asyncio.create_task(outcome(ext.fetch_all(timeout=3))))
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
            assert await client.component(1, 100) is component
            await asyncio.sleep(3.0)
            own = station.hub.followed[0].component
            assert values(component) == values(own)
            assert (ext.count, ext.is_complete, ext.is_spoken) == (
                *(own.ext.count, own.ext.is_complete),
                own.ext.is_spoken,
            )


class EarlierService:
    """A service of a version without extended parameters, as far as its documents show it."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        assert "extended" not in scope["path"], "no extended parameters are requested"

        async def send_less(message: Message) -> None:
            lines = message.get("body", b"").decode().split("\n")
            message["body"] = "\n".join(map(line_without_extended, lines)).encode()
            await send(message)

        await self._app(scope, receive, send_less)


def line_without_extended(line: str) -> str:
    head, brace, rest = line.partition("{")
    return head + json.dumps(without_extended(json.loads(brace + rest))) if brace else line


def without_extended(document: Any) -> Any:
    if isinstance(document, Mapping):
        return {key: without_extended(each) for key, each in document.items() if key != "extended"}
    return [without_extended(each) for each in document] if isinstance(document, list) else document


@in_simulated_time
async def test_a_service_of_an_earlier_version() -> None:
    camera = Camera(plain={"A": 1})
    async with a_service(camera) as network:
        assert network.app is not None
        async with a_program(Network(EarlierService(network.app))) as client:
            component = await client.component(1, 100)
            assert (await component.set("A", 2)).actual == 2
            with pytest.raises(UsageError, match="its version is too old"):
                assert component.ext
