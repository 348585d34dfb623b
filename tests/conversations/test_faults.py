"""Faults by seed, frames of noise, and components that bend the protocol: no wrong value, and an end."""

from __future__ import annotations

import struct
from collections.abc import Awaitable
from random import Random
from typing import Any, TypeAlias

import anyio
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from paramclient.errors import ParamClientError
from paramclient.protocol.fetch import fetch_all
from paramclient.protocol.reads import read
from paramclient.protocol.writes import write
from paramclient.sim import Air, ArduPilotVehicle, GenericVehicle, PX4Vehicle, Vehicle
from paramclient.wire import messages
from tests.conversations.virtual import converse, jump, meanwhile, talking, virtual, virtual_on_both

Faults: TypeAlias = dict[str, Any]

KINDS = {
    "loss in bursts": Faults(loss=0.2, loss_burst=5.0, delay=0.05),
    "duplicates": Faults(duplicate=0.5, delay=0.03),
    "reordering": Faults(reorder=0.4, jitter=0.05, delay=0.02),
    "bit errors": Faults(bit_errors=2e-4, delay=0.02),
    "a radio": Faults(loss=0.05, delay=0.06, rate=5_760, queue=4_000),
    "everything": Faults(loss=0.1, duplicate=0.1, reorder=0.2, jitter=0.05, delay=0.05, bit_errors=5e-5),
}
RADIO = {"px4": {"burst": 3, "period": 0.02}, "ardupilot": {"burst": 1, "period": 0.025, "ftp_rate": 1_920.0}}


def vehicle_on(kind: str, faults: str) -> Vehicle:
    """Return a vehicle, on a radio with the rates that it has there."""
    options = RADIO[kind.removesuffix(" by list")] if faults == "a radio" else {}
    if kind == "px4":
        return PX4Vehicle(**options)  # type: ignore[arg-type]  # either
    return ArduPilotVehicle(ftp=kind == "ardupilot", **options)  # type: ignore[arg-type]  # either


@pytest.mark.parametrize(
    ("make", "seed"), [*((PX4Vehicle, n) for n in range(3)), *((ArduPilotVehicle, n) for n in (8, 23))]
)
async def test_a_radio_that_the_vehicle_does_not_know_costs_seconds(make: type[Vehicle], seed: int) -> None:
    """At 57600 baud: answers wait behind a whole list for 6 s, and the first block of a file is late."""
    vehicle = make()
    async with talking(Air.symmetric([vehicle], loss=0.05, delay=0.02, rate=5_760, seed=seed)) as (
        _,
        session,
    ):
        result = await fetch_all(session)
        assert (result.source, result.missing) == ("ftp" if make is ArduPilotVehicle else "stream", ())
        assert result.elapsed < 10.0
        check_right(vehicle, session.table.params)


@pytest.mark.parametrize("kind", ["px4", "ardupilot", "ardupilot by list"])
@pytest.mark.parametrize("faults", KINDS)
async def test_a_session_on_a_faulty_link_is_right(kind: str, faults: str) -> None:
    vehicle = vehicle_on(kind, faults)
    seed = Random(kind + faults).randrange(1000)
    async with talking(Air.symmetric([vehicle], seed=seed, **KINDS[faults])) as (_, session):
        result = await fetch_all(session)
        assert not result.missing
        assert result.elapsed < (90.0 if faults == "a radio" else 40.0)
        check_right(vehicle, session.table.params)
        name = "MC_ROLL_P" if kind == "px4" else "ATC_ANG_RLL_P"
        for value in (2.25, 3.5):
            assert (await write(session, name, value)).actual == value == vehicle.param(name).value
        await fetch_all(session)
        check_right(vehicle, session.table.params)
        assert not session.channel.inboxes


def check_right(vehicle: Vehicle, params: object) -> None:
    """Check every value but those that change on board meanwhile."""
    assert isinstance(params, dict)
    wrong = [each.name for each in vehicle.listed if not params[each.name].same_value(each)]
    assert set(wrong) <= {"STAT_RUNTIME", "BARO1_GND_PRESS", "BARO2_GND_PRESS"}


# bytes and messages of any kind


names = st.text(st.characters(min_codepoint=1, max_codepoint=255), max_size=16)
number, short, word = st.integers(0, 255), st.integers(0, 65535), st.integers(0, 2**32 - 1)
index = st.integers(-32768, 32767)
raw = st.binary(min_size=4, max_size=4)
any_message = st.one_of(
    st.builds(messages.ParamValue, names, raw, number, st.integers(0, 40), short),
    st.builds(messages.ParamError, number, number, names, index, number),
    st.builds(messages.ParamExtValue, names, st.binary(max_size=128), number, st.integers(0, 40), short),
    st.builds(messages.ParamExtAck, names, st.binary(max_size=128), number, number),
    st.builds(messages.ParamSet, number, number, names, raw, number),
    st.builds(messages.Heartbeat, number, number, number, word, number, number),
    st.builds(messages.SystemTime, st.integers(0, 2**64 - 1), word),
    st.builds(messages.CommandAck, short, number, number, number),
    st.builds(messages.FileTransfer, number, number, number, st.binary(max_size=251)),
    st.builds(messages.AutopilotVersion, st.integers(0, 2**64 - 1), word, uid=word),
    st.builds(messages.StatusText, number, st.text(st.characters(max_codepoint=255), max_size=50)),
)


@settings(max_examples=25, deadline=None)
@given(st.lists(any_message, max_size=60), st.lists(st.binary(max_size=60), max_size=5))
@example([messages.ParamExtValue("", b"", 0, *each) for each in ((2, 0), (2, 0), (1, 32768))], [])
@virtual
async def test_no_message_or_byte_raises_in_a_call(heard: list[messages.Message], noise: list[bytes]) -> None:
    async with converse(PX4Vehicle(table={"A": 1, "B": 2.5})) as conversation:
        node = await conversation.node()
        calls: list[Awaitable[object]] = [fetch_all(node.plain), fetch_all(node.extended)]
        calls += [write(node.plain, "A", 5), read(node.plain, "B")]
        async with meanwhile(*calls) as ends:
            for message in heard:
                conversation.hear(message)
                await anyio.sleep(0.003)
            for data in noise:
                conversation.station.receive(data, "sim", anyio.current_time())
        assert all(isinstance(each, ParamClientError) for each in ends if isinstance(each, Exception))


@virtual_on_both
async def test_hostile_values_change_no_table() -> None:
    vehicle = GenericVehicle({"A": 1, "B": 2.5})
    async with talking(vehicle) as (conversation, session):
        await fetch_all(session)
        before = dict(session.table.params)
        raw = struct.pack("<i", 66)
        for name in ("A\nB", "A B", "\x1b[2J", "A,B", "\xb5", "\x7f", ""):
            for index in (0, 1, messages.NO_INDEX):
                conversation.hear(messages.ParamValue(name, raw, 6, 2, index))
        for system, number in ((1, 2), (2, 1), (255, 190)):
            conversation.hear(messages.ParamValue("A", raw, 6, 2, 0), system=system, component=number)
        frame = messages.encode(messages.ParamValue("A", raw, 6, 2, 0), system=1, component=1, sequence=0)
        for place in range(len(frame)):
            now = anyio.current_time()
            conversation.station.receive(frame[:place], "sim", now)
            conversation.station.receive(
                frame[:place] + bytes((frame[place] ^ 1,)) + frame[place + 1 :], "sim", now
            )
        assert (dict(session.table.params), session.table.count) == (before, 2)
        for count, index in ((0xFFFF, 5), (0xFFFF, messages.NO_INDEX), (2, 40), (0, 0)):
            conversation.hear(messages.ParamValue("A", struct.pack("<i", 1), 6, count, index))
        result = await fetch_all(session, refresh=True)
        assert (result.complete, result.elapsed < 3.0) == (True, True)
        check_right(vehicle, dict(result.params))


@virtual_on_both
@pytest.mark.parametrize("kind", ["px4", "ardupilot", "ardupilot by list"])
@pytest.mark.parametrize("at", [0.03, 0.1])
async def test_calls_go_on_after_the_computer_was_suspended(kind: str, at: float) -> None:
    vehicle = vehicle_on(kind, "")
    async with converse(Air.symmetric([vehicle], delay=0.02)) as conversation:
        node = await conversation.node()
        await node.identification.settled()
        for call in (
            fetch_all(node.plain, refresh=True),
            read(node.plain, vehicle.listed[1].name),
            write(node.plain, vehicle.listed[2].name, 1),
        ):
            async with meanwhile(call) as ends:
                await anyio.sleep(at)
                jump(60.0)
                resumed_at = anyio.current_time()
            assert anyio.current_time() - resumed_at < 3.0
            assert not isinstance(ends[0], Exception)
            await anyio.sleep(3.0)
        assert not node.presence.is_lost
        assert not node.channel.inboxes
        check_right(vehicle, dict(node.plain.table.params))


# components that bend the protocol


async def test_a_slow_vehicle_is_waited_for() -> None:
    vehicle = ArduPilotVehicle(
        ftp=False, burst=1, period=0.3, table={f"P{number}": number for number in range(40)}
    )
    async with converse(Air.symmetric([vehicle], delay=0.5)) as conversation:
        result = await fetch_all((await conversation.node()).plain)
        assert (len(result.params), result.missing) == (40, ())
        assert len(conversation.sent_of(messages.ParamRequestList)) <= 3


async def test_a_vehicle_that_restarts_in_the_middle_of_its_list_is_fetched_whole() -> None:
    for vehicle in (PX4Vehicle(), ArduPilotVehicle(ftp=False)):
        async with talking(vehicle) as (_, session):
            vehicle.when_listed(300, lambda vehicle=vehicle: vehicle.reboot(down=1.5))  # type: ignore[misc]  # a default
            assert not (await fetch_all(session)).missing
            await anyio.sleep(3.0)
            await fetch_all(session)
            check_right(vehicle, dict(session.table.params))
