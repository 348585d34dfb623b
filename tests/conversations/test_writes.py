"""Writes: every value is proven, refused or reported as unknown, whatever the link loses."""

from __future__ import annotations

import math
import struct
from collections.abc import Awaitable, Callable, Iterable
from itertools import pairwise
from typing import Any

import anyio
import pytest

from paramclient import errors
from paramclient.model.values import Encoding, ParamType, Trust, Value
from paramclient.protocol.fetch import fetch_all
from paramclient.protocol.reads import read, read_many, read_param
from paramclient.protocol.session import Session
from paramclient.protocol.set_results import SetOutcome, SetStatus
from paramclient.protocol.writes import write, write_many
from paramclient.sim import Air, ArduPilotVehicle, FaultyLink, GenericVehicle, PX4Vehicle, SimParam, Vehicle
from paramclient.wire.messages import AutopilotVersion, CommandLong, Message, ParamError, ParamSet, ParamValue
from tests.conversations.partial import Partial
from tests.conversations.virtual import converse, losing, meanwhile, talking, virtual_on_both
from tests.shell import Tap

Maker = type[PX4Vehicle] | type[ArduPilotVehicle]
RULED = ("MPC", "LNDMC", "BARO", "STAT", "MIS_", "INS")
EVERY_TYPE = {
    ParamType.UINT8: 255,
    ParamType.INT8: -128,
    ParamType.UINT16: 65535,
    ParamType.INT16: -32768,
    ParamType.UINT32: 2**32 - 1,
    ParamType.INT32: -(2**31),
    ParamType.REAL32: 0.1,
}


async def many(session: Session, pairs: Iterable[tuple[str, Value]]) -> list[SetOutcome]:
    """Set several values; return the outcomes, after checking that each was reported once."""
    done: list[SetOutcome] = []
    result = await write_many(session, list(pairs), progress=done.append)
    assert result.error is None
    assert sorted(each.name for each in done) == sorted(each.name for each in result.outcomes)
    return list(result.outcomes)


def free_names(vehicle: Vehicle) -> list[str]:
    """The names of parameters whose value no rule of a firmware limits or moves."""
    names = [each.name for each in vehicle.listed if each.type is ParamType.REAL32]
    return [name for name in names if not name.startswith(RULED)][:150]


@virtual_on_both
@pytest.mark.parametrize("loss", [0.0, 0.3])
async def test_values_of_every_type_are_set(loss: float) -> None:
    vehicle = GenericVehicle([SimParam(kind.name, kind, 0) for kind in EVERY_TYPE])
    async with talking(Air.symmetric([vehicle], loss=loss, delay=0.02, seed=1)) as (_, session):
        for kind, value in EVERY_TYPE.items():
            result = await write(session, kind.name, value)
            assert (result.status, result.actual, result.param.type) == ("accepted", value, kind)
            assert session.table.params[kind.name].value == vehicle.param(kind.name).value == value
        reads = vehicle.requests["PARAM_REQUEST_READ"]
        assert reads >= len(EVERY_TYPE)  # each type is learnt first
        await write(session, "INT32", 5)
        assert loss or vehicle.requests["PARAM_REQUEST_READ"] == reads  # and is known from then on


@pytest.mark.parametrize(
    ("make", "name", "requested", "actual", "text"),
    [
        (PX4Vehicle, "MC_ROLL_P", 6.1, 6.1, "MC_ROLL_P = 6.1"),
        (ArduPilotVehicle, "ATC_ANG_RLL_P", 6.1, 6.1, "ATC_ANG_RLL_P = 6.1"),
        (ArduPilotVehicle, "RTL_ALT", 1234.7, 1234, "RTL_ALT = 1234 (adjusted from 1234.7)"),
    ],
)
async def test_a_value_is_its_shortest_decimal_and_a_truncated_one_adjusted(
    make: Maker, name: str, requested: float, actual: float, text: str
) -> None:
    async with talking(vehicle := make()) as (_, session):
        await fetch_all(session)
        before = session.table.params[name]
        result = await write(session, name, requested)
        assert (result.requested, result.actual, result.attempts) == (requested, actual, 1)
        assert str(result) == text
        assert result.param.same_value(vehicle.param(name))
        assert session.table.params[name].index == before.index  # ArduPilot's acknowledgement has 65535


async def test_px4_clamps_a_value_later_which_a_watched_write_reports() -> None:
    vehicle = PX4Vehicle()
    async with talking(vehicle) as (_, session):
        most = vehicle.param("MPC_XY_VEL_MAX").value
        at_once = await write(session, "MPC_XY_CRUISE", 90.0)
        assert (at_once.status, at_once.actual) == ("accepted", 90.0)
        watched = await write(session, "MPC_XY_CRUISE", 80.0, settle=1.2)
        assert (watched.status, watched.requested, watched.actual) == ("adjusted", 80.0, most)
        assert session.table.params["MPC_XY_CRUISE"].value == most


# refused


@pytest.mark.parametrize("param_error", [False, True])
async def test_a_read_only_parameter_is_refused_with_its_reason(param_error: bool) -> None:
    vehicle = ArduPilotVehicle(param_error=param_error)
    async with talking(Air.symmetric([vehicle], delay=0.02)) as (conversation, session):
        with pytest.raises(errors.Refused, match="read only") as caught, anyio.fail_after(3.0):
            await write(session, "BARO1_GND_PRESS", 5.0)
        assert (caught.value.code, caught.value.name) == (errors.ParamErrorCode.READ_ONLY, "BARO1_GND_PRESS")
        assert len(conversation.sent_of(ParamSet)) == 1


@pytest.mark.parametrize(
    ("make", "value"),
    [
        *((make, value) for make in (PX4Vehicle, ArduPilotVehicle) for value in (2**31, "text")),
        *((PX4Vehicle, math.nan), (PX4Vehicle, math.inf), (ArduPilotVehicle, 2**24 + 1)),
    ],
)
async def test_a_value_that_does_not_fit_and_an_unknown_name_are_not_sent(make: Maker, value: Any) -> None:
    vehicle, kind = make(), ParamType.REAL32 if isinstance(value, float) else ParamType.INT32
    name = next(param.name for param in vehicle.listed if param.type is kind)
    async with talking(vehicle) as (conversation, session):
        with pytest.raises(errors.UnknownParameter):
            await write(session, "NO_SUCH", 1)
        with pytest.raises(errors.UsageError):
            await write(session, name, value)
        assert not conversation.sent_of(ParamSet)
        assert not session.writing
        if isinstance(value, float):
            assert not math.isfinite(float((await write(session, name, value, force=True)).actual))


NUMBER = {"A": (5, ParamType.INT32)}


@pytest.mark.parametrize(("value", "fits"), [(7, True), (300, False)])
async def test_a_type_that_has_changed_is_taken_or_is_a_mismatch(value: int, fits: bool) -> None:
    def retyped(message: ParamSet) -> Iterable[Message]:
        if message.param_type == ParamType.UINT8:
            vehicle.values["A"] = message.raw
        vehicle.types["A"] = ParamType.UINT8
        yield ParamValue("A", vehicle.values["A"], ParamType.UINT8, 1, 0)

    vehicle = Partial(NUMBER, on_set=retyped)
    async with talking(vehicle) as (_, session):
        if fits:
            result = await write(session, "A", value)
            assert (result.status, result.param.type) == ("accepted", ParamType.UINT8)
        else:
            with pytest.raises(errors.TypeMismatch, match="UINT8"):
                await write(session, "A", value)


@pytest.mark.parametrize(
    ("code", "kind"),
    [
        (errors.ParamErrorCode.VALUE_OUT_OF_RANGE, errors.Refused),
        (errors.ParamErrorCode.DOES_NOT_EXIST, errors.UnknownParameter),
        (99, errors.Refused),
    ],
)
@pytest.mark.parametrize("order", ["E", "VE", "EV"])
async def test_refusals_beat_old_values(code: int, kind: type[errors.ParamClientError], order: str) -> None:
    answers: dict[str, Message] = {
        "V": ParamValue("A", struct.pack("<i", 5), ParamType.INT32, 1, 0),
        "E": ParamError(255, 190, "A", -1, code),
    }
    vehicle = Partial(NUMBER, on_set=lambda message: [answers[each] for each in order])
    async with talking(vehicle) as (conversation, session):
        with pytest.raises(kind):
            await write(session, "A", 6)
        assert len(conversation.sent_of(ParamSet)) == 1


# what the link loses


@virtual_on_both
async def test_a_lost_acknowledgement_is_requested_again_and_a_lost_set_too() -> None:
    for what in (ParamSet, ParamValue):
        vehicle = PX4Vehicle()
        async with talking(endpoint := Tap(Air.symmetric([vehicle], delay=0.02))) as (_, session):
            await read(session, "MC_ROLL_P")
            endpoint.up = endpoint.down = losing(2, lambda message, what=what: isinstance(message, what))  # type: ignore[misc]
            result = await write(session, "MC_ROLL_P", 3.5)
            assert (result.status, vehicle.param("MC_ROLL_P").value) == ("accepted", 3.5)
            assert result.attempts >= (3 if what is ParamSet else 2)


async def test_an_old_value_in_passing_proves_nothing_and_another_ones_is_no_adjustment() -> None:
    for passing in (4.0, 9.0):
        vehicle = PX4Vehicle()
        async with talking(endpoint := Tap(Air.symmetric([vehicle], delay=0.1))) as (conversation, session):
            await read(session, "MC_ROLL_P")
            endpoint.up = losing(1, lambda message: isinstance(message, ParamSet))
            async with meanwhile(write(session, "MC_ROLL_P", 3.5)) as results:
                await anyio.sleep(0.05)
                vehicle.load({"MC_ROLL_P": passing})  # as another station's set
                conversation.hear(ParamValue("MC_ROLL_P", struct.pack("<f", passing), 9, 903, 65535))
            assert [each.status for each in results] == ["accepted"]
            assert vehicle.param("MC_ROLL_P").value == 3.5


async def test_a_set_of_another_station_right_behind_an_acknowledgement_is_the_later_change() -> None:
    answers = [ParamValue("A", struct.pack("<i", each), ParamType.INT32, 1, 0) for each in (6, 7)]
    async with talking(Partial(NUMBER, on_set=lambda message: answers)) as (conversation, session):
        assert (await write(session, "A", 6)).status == "accepted"
        assert [each.new and each.new.value for each in conversation.changes][-2:] == [6, 7]


async def test_an_acknowledgement_counts_however_many_frames_are_sent_before_it() -> None:
    """The numbers of frames wrap: its own seems to be lower than that of the known value."""

    def answers(message: ParamSet) -> list[Message]:
        answer = ParamValue("A", message.raw, ParamType.INT32, 1, 0)
        return [*[answer._replace(param_id="B")] * 200, answer]

    async with talking(Partial(NUMBER, on_set=answers)) as (_, session):
        for value in (6, 7):
            await write(session, "A", value)
            assert session.table.params["A"].value == value


async def test_a_late_answer_with_an_old_value_undoes_no_change() -> None:
    """ArduPilot takes the value of a read when it queues it, and answers up to 100 ms later."""
    vehicle = ArduPilotVehicle(live_period=0.0)
    async with talking(Air.symmetric([vehicle], delay=0.005)) as (conversation, session):
        await fetch_all(session)
        for step in range(8):
            async with meanwhile(read(session, "ATC_ANG_RLL_P")):
                await anyio.sleep(0.013 * step)
                await write(session, "ATC_ANG_RLL_P", 3.0 + step)
            await anyio.sleep(1.0)
            assert session.table.params["ATC_ANG_RLL_P"].value == 3.0 + step
        changes = [each for each in conversation.changes if each.kind == "changed"]
        assert [each.by for each in changes] == ["us"] * 8
        # a write back is no late answer, and a change back by another station is found by a read
        await write(session, "ATC_ANG_RLL_P", 3.5)
        assert (await write(session, "ATC_ANG_RLL_P", 10.0)).status == "accepted"
        await write(session, "ATC_ANG_RLL_P", 3.5)
        vehicle.set_param("ATC_ANG_RLL_P", 10.0)
        await anyio.sleep(1.0)
        assert session.table.params["ATC_ANG_RLL_P"].value == 10.0


async def test_a_busy_program_knows_a_late_answer_by_when_it_was_requested() -> None:
    endpoint = Tap(vehicle := ArduPilotVehicle(live_period=0.0))
    async with talking(endpoint) as (conversation, session):
        await fetch_all(session)
        endpoint.down = lambda message: not isinstance(message, ParamValue)
        old = session.table.params["ATC_ANG_RLL_P"]
        answer = ParamValue(old.name, struct.pack("<f", old.value), 9, 1382, old.index or 0)
        async with meanwhile(read(session, old.name)):
            await anyio.sleep(0.05)
            vehicle.set_param(old.name, 7.0)
            conversation.hear(answer._replace(raw=struct.pack("<f", 7.0), param_index=65535))
            await anyio.sleep(0.4)
            conversation.hear(answer)
            endpoint.down = lambda message: True
        await anyio.sleep(1.0)
        assert [each.new and each.new.value for each in conversation.changes][-1:] == [7.0]


async def test_a_value_that_is_read_again_by_name_undoes_no_later_change() -> None:
    """Without an index, the answer looks like an acknowledgement."""
    async with talking(Air([ArduPilotVehicle()])) as (conversation, session):
        answer = ParamValue("ATC_ANG_RLL_P", bytes(4), ParamType.REAL32, 900, 3)
        conversation.hear(answer._replace(raw=struct.pack("<f", 4.0), param_index=65535), answer)
        assert session.table.params["ATC_ANG_RLL_P"].value == 4.0
        for step in range(0, 100, 4):
            for value, pause in ((0, 0.1), (1, 0.1), (0, 0.2 + step / 500), (2, 1.0)):
                raw = struct.pack("<f", step + value)
                session.channel.send(ParamSet(1, 1, "ATC_ANG_RLL_P", raw, ParamType.REAL32))
                await anyio.sleep(pause)
        values = [float(each.new.value) for each in conversation.changes if each.new]
        assert not any(later == value - 2 for value, later in pairwise(values))


@pytest.mark.parametrize(("vehicle", "reorder"), [(PX4Vehicle(), 0.5), (ArduPilotVehicle(), 0.0)])
async def test_changes_are_received_in_their_order(vehicle: Vehicle, reorder: float) -> None:
    """A value that others overtake, or that an ArduPilot has kept for a read, is none."""
    name = "BAT1_CAPACITY" if isinstance(vehicle, PX4Vehicle) else "ATC_ANG_RLL_P"
    async with talking(Air([vehicle], downlink=FaultyLink(reorder=reorder))) as (conversation, session):
        await fetch_all(session)
        for value in range(100):
            async with meanwhile(read(session, name)):
                vehicle.set_param(name, float(value))
                await anyio.sleep(0.004)
                vehicle.set_param(name, value + 0.5)
        await anyio.sleep(1.0)
        values = [each.new.value for each in conversation.changes if each.new and each.name == name]
        assert values[1:] == sorted(values[1:])
        assert (len(values) > 50, values[-1]) == (True, 99.5)


async def test_no_set_is_sent_before_the_encoding_is_certain() -> None:
    vehicle = Partial(NUMBER, encoding=Encoding.C_CAST)
    async with talking(Tap(vehicle, up=lambda message: not isinstance(message, CommandLong))) as (_, session):
        with anyio.move_on_after(1.0):
            await write(session, "A", 6)
        assert not vehicle.number_of(ParamSet)


async def test_silence_is_no_reply_within_7_s_and_a_cancelled_write_sends_no_more() -> None:
    for maker in (PX4Vehicle, ArduPilotVehicle):
        endpoint = Tap(maker())
        async with talking(endpoint) as (conversation, session):
            axes = ("MC_ROLL_P", "MC_PITCH_P") if maker is PX4Vehicle else ("ATC_ANG_RLL_P", "ATC_ANG_PIT_P")
            cancelled, name = [(await read(session, axis)).param_id for axis in axes]
            endpoint.silent_at = began = anyio.current_time()
            with anyio.move_on_after(1.0):
                await write(session, cancelled, 1.5)
            sent = len(conversation.sent_of(ParamSet))
            await anyio.sleep(0.5)
            assert len(conversation.sent_of(ParamSet)) == sent > 0
            assert session.table.params[cancelled].trust is Trust.CACHED
            with pytest.raises(errors.NoReply, match=f"acknowledgement of {name} by 1/1"):
                await write(session, name, 2.5)
            assert anyio.current_time() - began < 8.5
            assert not session.channel.inboxes
            assert not session.writing


async def test_values_of_one_parameter_are_set_in_the_order_of_the_call() -> None:
    vehicle = ArduPilotVehicle()
    names = ["RTL_ALT", "rtl_alt"]
    async with talking(Air.symmetric([vehicle], delay=0.01)) as (conversation, session):
        values = [1000.0 + number for number in range(12)]
        await many(session, [(names[number % 2], value) for number, value in enumerate(values)])
        assert [struct.unpack("<f", each.raw)[0] for each in conversation.sent_of(ParamSet)] == values
        assert vehicle.param("RTL_ALT").value == values[-1]


@virtual_on_both
@pytest.mark.parametrize("timeout", [None, 2.0], ids=["lost", "at the timeout"])
async def test_values_are_accepted_though_they_could_not_be_watched(timeout: float | None) -> None:
    endpoint = Tap(Air.symmetric([PX4Vehicle()], delay=0.05))
    async with talking(endpoint) as (_, session):
        if timeout is None:
            endpoint.silent_at = anyio.current_time() + 1.0
        pairs = [("MC_ROLL_P", 5.5), ("MC_PITCH_P", 5.5)]
        result = await write_many(session, pairs, settle=30.0, timeout=timeout)
        assert timeout is not None or anyio.current_time() - endpoint.silent_at < 7.0
        assert [each.status for each in result.outcomes] == [SetStatus.ACCEPTED] * 2
        assert [each.reported for each in result.outcomes] == [5.5, 5.5]


# another vehicle


@virtual_on_both
@pytest.mark.parametrize("is_same", [False, True], ids=["another", "the same"])
@pytest.mark.parametrize(
    ("doubt", "said"),
    [
        ("its clock", "before"),
        ("an interrupted link", "before"),
        ("an interrupted link", "meanwhile"),
        ("an interrupted link", "never"),
    ],
)
async def test_a_rebooted_vehicle_gets_the_others_another_none(doubt: str, is_same: bool, said: str) -> None:
    first, other = PX4Vehicle(uid=1), PX4Vehicle(uid=2)
    async with converse(place := Tap(Air.symmetric([first], delay=0.05))) as conversation:
        if said == "never":
            place.down = lambda message: not isinstance(message, AutopilotVersion)
        session = (await conversation.node()).plain
        if said == "before":
            await fetch_all(session)
            await anyio.sleep(30.0)
        names = free_names(first)
        async with meanwhile(write_many(session, [(name, 0.125) for name in names])) as results:
            await anyio.sleep(0.25)
            if doubt == "an interrupted link":
                conversation.station.interrupt()
            if is_same:
                first.reboot(anyio.current_time(), down=1.0)
            place.up = place.down = lambda message: False
            await anyio.sleep(1.0)
            place.up = place.down = lambda message: True
            if not is_same:
                place.endpoint = Air.symmetric([other], delay=0.05)
            if doubt == "an interrupted link":
                conversation.station.resume(anyio.current_time())
        (result,) = results
        if is_same and said != "never":
            assert {each.status for each in result.outcomes} == {SetStatus.ACCEPTED}
            assert all(first.param(name).value == 0.125 for name in names)
            return
        assert not other.requests["PARAM_SET"]
        assert isinstance(result.error, errors.NoReply if said == "never" else errors.AnotherVehicle)
        assert result.counts[SetStatus.ACCEPTED] + result.counts[SetStatus.UNKNOWN] <= 80
        assert result.counts[SetStatus.NOT_TRIED] >= 70
        assert all(each.is_set or each.error is not None for each in result.outcomes)
        assert (await write(session, names[-1], 0.5)).status == "accepted"
        assert (first if is_same else other).param(names[-1]).value == 0.5


@virtual_on_both
async def test_another_vehicle_behind_a_value_ends_a_write_and_no_read() -> None:
    table = {"A": (5.0, ParamType.REAL32), "B": (6.0, ParamType.REAL32)}
    vehicle = Partial(table, version=AutopilotVersion(16, uid=7))
    calls: list[tuple[str, Callable[[Session], Awaitable[object]]]] = [
        ("AnotherVehicle", lambda session: write(session, "A", 1.0)),
        ("Param", lambda session: read_param(session, "A")),
        ("NoneType", lambda session: read_many(session, ["A", "B"])),
    ]
    async with talking(Air.symmetric([vehicle], delay=0.05)) as (conversation, session):
        await anyio.sleep(3.0)
        for uid, (ends_with, call) in enumerate(calls, start=20):
            async with meanwhile(call(session)) as outcomes:
                await anyio.sleep(0.05)
                for index, name in enumerate(table):
                    conversation.hear(ParamValue(name, vehicle.values[name], ParamType.REAL32, 2, index))
                conversation.hear(AutopilotVersion(16, uid=uid))
            assert [type(each).__name__ for each in outcomes] == [ends_with]
        assert not vehicle.number_of(ParamSet)


# several


@virtual_on_both
@pytest.mark.parametrize("loss", [0.0, 0.2])
@pytest.mark.parametrize("maker", [PX4Vehicle, ArduPilotVehicle])
async def test_many_values_are_set_each_with_its_outcome(maker: type[PX4Vehicle], loss: float) -> None:
    vehicle = maker()
    async with talking(Air.symmetric([vehicle], loss=loss, delay=0.02, seed=4)) as (_, session):
        pairs: list[tuple[str, Value]] = [(name, 0.5 + n) for n, name in enumerate(free_names(vehicle))]
        pairs.insert(70, ("NO_SUCH", 1))
        began = anyio.current_time()
        outcomes = await many(session, pairs)
        assert anyio.current_time() - began < (30.0 if loss else 8.0)
        assert [each.name for each in outcomes] == [name for name, _ in pairs]
        refused = outcomes.pop(70)
        assert (refused.status, type(refused.error)) == (SetStatus.REFUSED, errors.UnknownParameter)
        for outcome in outcomes:
            assert outcome.status is SetStatus.ACCEPTED
            assert vehicle.param(outcome.name).value == outcome.requested
            assert session.table.params[outcome.name].value == outcome.requested


async def test_a_switch_and_the_parameters_behind_it_are_set_in_one_call() -> None:
    vehicle = ArduPilotVehicle()
    async with talking(vehicle) as (conversation, session):
        await fetch_all(session)
        count = session.table.count
        hidden = "EK2_GPS_TYPE"
        outcomes = await many(session, [("RTL_ALT", 1600), ("EK2_ENABLE", 1), (hidden, 1), ("RTL_SPEED", 5)])
        assert all(each.status is SetStatus.ACCEPTED for each in outcomes)
        assert vehicle.param(hidden).value == 1
        assert not (await fetch_all(session)).changed, "nothing of it was cached"
        assert session.table.count == (count or 0) + 52
        assert session.table.params[hidden].trust is Trust.LIVE
        await many(session, [("EK2_ENABLE", 0)])
        await fetch_all(session)
        assert (session.table.count, hidden in session.table.params) == (count, False)
        assert [each.kind for each in conversation.changes if each.name == hidden][-1] == "removed"


@pytest.mark.parametrize(("rate", "after"), [(2_000, 1.0), (4_000, 0.3), (8_000, 0.3)])
async def test_sets_behind_a_list_that_fills_a_slow_link(rate: int, after: float) -> None:
    """Answers to reads from before the set arrive for seconds after it, and are no proof against it."""
    vehicle = PX4Vehicle()
    async with talking(Air.symmetric([vehicle], rate=rate)) as (_, session):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(fetch_all, session)
            await anyio.sleep(after)
            for name, value in (("MC_ROLL_P", 6.5), ("BAT1_N_CELLS", 6)):
                tasks.start_soon(write, session, name, value)
        assert vehicle.values["MC_ROLL_P"] == session.table.params["MC_ROLL_P"].value == 6.5
