"""Reads of single parameters: answers, silence, refusals, the window, and the end of the link."""

from __future__ import annotations

import struct
from collections.abc import Iterable

import anyio
import pytest

from paramclient.errors import LinkError, NoReply, ParamErrorCode, Refused, UnknownParameter
from paramclient.model.values import ParamType, Trust
from paramclient.protocol.fetch import fetch_all
from paramclient.protocol.reads import read, read_many
from paramclient.protocol.writes import write
from paramclient.sim import Air, ArduPilotVehicle, GenericVehicle, PX4Vehicle, Vehicle
from paramclient.wire.messages import NO_INDEX, Message, ParamError, ParamRequestRead, ParamValue
from tests.conversations.virtual import Puppet, converse, meanwhile, talking, virtual_on_both
from tests.shell import Tap

TABLE = {"RTL_ALT": 1500, "MC_ROLL_P": 6.5, "MC_PITCH_P": 6.5}
MAKERS = {
    "px4": PX4Vehicle,
    "ardupilot": ArduPilotVehicle,
    "px4 with errors": lambda: PX4Vehicle(param_error=True),
    "ardupilot with errors": lambda: ArduPilotVehicle(param_error=True),
    "generic": lambda: GenericVehicle(TABLE),
}
EVERY = pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)


@virtual_on_both
@EVERY
@pytest.mark.parametrize("loss", [0.0, 0.3])
async def test_reads_by_name_and_index_bring_the_vehicles_values(make: type[Vehicle], loss: float) -> None:
    vehicle = make()
    async with talking(Air.symmetric([vehicle], loss=loss, delay=0.02, seed=3)) as (_, session):
        for index, param in list(enumerate(vehicle.listed))[::300]:
            by_index = await read(session, index)
            assert (by_index.param_id, by_index.param_index) == (param.name, index)
            await read(session, param.name)
            stored = session.table.params[param.name]
            assert stored.same_value(param)
            assert (stored.index, stored.trust) == (index, Trust.LIVE)


@EVERY
@pytest.mark.parametrize("which", ["MC_ROLLP", 5000])
async def test_silence_to_one_read_of_many_is_no_parameter(make: type[Vehicle], which: str | int) -> None:
    vehicle = make()
    async with talking(vehicle) as (_, session):
        await read(session, vehicle.listed[0].name)
        if vehicle_has_roll := "MC_ROLL_P" in vehicle.params:
            await read(session, "MC_ROLL_P")
        with pytest.raises(UnknownParameter) as caught, anyio.fail_after(3.0):
            await read(session, which)
        assert (caught.value.name if isinstance(which, str) else caught.value.index) == which
        assert ("MC_ROLL_P" in str(caught.value)) is (vehicle_has_roll and which == "MC_ROLLP")


async def test_a_misspelt_name_takes_seconds_after_a_list_with_losses() -> None:
    air = Air.symmetric([ArduPilotVehicle(ftp=False)], loss=0.1, delay=0.005, seed=9)
    async with talking(air) as (_, session):
        await fetch_all(session)
        with pytest.raises(UnknownParameter), anyio.fail_after(10.0):
            await read(session, "NOPE")


async def test_silence_is_no_reply_and_not_an_unknown_parameter() -> None:
    async with talking(endpoint := Tap(PX4Vehicle())) as (_, session):
        endpoint.silent_at = 0.5
        await anyio.sleep(0.6)
        with pytest.raises(NoReply, match="MC_ROLL_P of 1/1") as caught:
            await read(session, "MC_ROLL_P")
        assert caught.value.attempts >= 5
        assert anyio.current_time() < 7.0
        assert not session.channel.inboxes


@pytest.mark.parametrize("delay", [0.0, 0.05, 0.3])
async def test_on_a_clean_link_few_reads_are_repeated_to_ardupilot(delay: float) -> None:
    vehicle = ArduPilotVehicle()
    async with talking(Air.symmetric([vehicle], delay=delay)) as (conversation, session):
        await session.identification.settled()
        await read(session, 0)
        conversation.sent.clear()
        names = [param.name for param in vehicle.listed[10:1210:10]]
        began = anyio.current_time()
        await read_many(session, names)
        assert session.table.params.keys() >= set(names)
        assert len(conversation.sent_of(ParamRequestRead)) <= 140  # the first ones wait in the queue
        assert anyio.current_time() - began < 120 / 49 + 12 * (0.1 + 2 * delay)  # 5 in each 100 ms


async def test_one_value_answers_both_a_read_by_name_and_one_by_index_and_others_none() -> None:
    async with talking(GenericVehicle(TABLE, dead=range(3))) as (conversation, session):
        async with meanwhile(read(session, "MC_ROLL_P"), read(session, 1)) as got:
            await anyio.sleep(0.1)
            conversation.hear(ParamValue("MC_PITCH_P", bytes(4), 9, 3, 2))
            await anyio.sleep(0.01)
            assert not got
            conversation.hear(ParamValue("MC_ROLL_P", bytes(4), 9, 3, 1))
        assert [(each.param_id, each.param_index) for each in got] == [("MC_ROLL_P", 1)] * 2


@pytest.mark.parametrize("which", ["A", 7])
@pytest.mark.parametrize(
    ("code", "kind"),
    [(ParamErrorCode.DOES_NOT_EXIST, UnknownParameter), (ParamErrorCode.READ_FAIL, Refused), (77, Refused)],
)
async def test_a_refusal_tells_its_reason(which: str | int, code: int, kind: type[Exception]) -> None:
    def answer(message: Message) -> Iterable[Message]:
        if isinstance(message, ParamRequestRead):
            yield ParamError(255, 190, message.param_id, message.param_index, code)

    async with converse(Puppet(answer)) as conversation:
        with pytest.raises(kind) as caught:
            await read((await conversation.node()).plain, which)
        assert isinstance(caught.value, UnknownParameter | Refused)
        assert (caught.value.name if isinstance(which, str) else caught.value.index) == which
        if isinstance(caught.value, Refused):
            assert caught.value.reason == ("read fail" if code != 77 else "error code 77")


async def test_an_ardupilot_takes_names_in_any_case_and_its_table_has_one_of_each() -> None:
    async with talking(ArduPilotVehicle()) as (conversation, session):
        assert (await read(session, "rtl_alt")).param_id == "RTL_ALT"
        result = await write(session, "rtl_alt", 1000)
        assert (result.name, result.actual, result.attempts) == ("RTL_ALT", 1000, 1)
        await anyio.sleep(1.0)
        conversation.hear(ParamValue("Rtl_Alt", struct.pack("<f", 900.0), ParamType.INT32, 900, NO_INDEX))
        assert [session.table.params[name].value for name in session.table.params] == [900]


@virtual_on_both
async def test_reads_wait_while_the_link_is_down_and_end_when_it_fails() -> None:
    vehicle = PX4Vehicle()
    async with talking(vehicle) as (conversation, session):
        station = conversation.station
        await anyio.sleep(0.5)
        async with meanwhile(read(session, "MC_ROLL_P")):
            station.interrupt()
            asked = vehicle.requests["PARAM_REQUEST_READ"]
            await anyio.sleep(30.0)
            assert vehicle.requests["PARAM_REQUEST_READ"] == asked
            station.resume(resumed_at := anyio.current_time())
        assert anyio.current_time() - resumed_at < 0.1
        station.interrupt()
        async with meanwhile(read(session, "MC_ROLL_P")) as raised:
            await anyio.sleep(1.0)
            station.fail(LinkError("gone", link="x"), for_good=True)
        assert [type(each) for each in raised] == [LinkError]
        with pytest.raises(LinkError):
            await read(session, "MC_ROLL_P")
        station.resume(anyio.current_time())
        with pytest.raises(LinkError):
            await read(session, "MC_ROLL_P")


@virtual_on_both
@pytest.mark.parametrize("make", [PX4Vehicle, ArduPilotVehicle])
async def test_equal_reads_are_one_request_and_a_cancelled_one_ends_alone(make: type[PX4Vehicle]) -> None:
    vehicle = make()
    name = vehicle.listed[5].name
    async with talking(Air.symmetric([vehicle], delay=0.05)) as (_, session):
        await read(session, vehicle.listed[0].name)
        before = vehicle.requests["PARAM_REQUEST_READ"]
        async with meanwhile(*(read(session, name) for _ in range(7))) as values:
            with anyio.move_on_after(0.01):
                await read(session, name)
        assert {each.param_id for each in values} == {name}
        assert vehicle.requests["PARAM_REQUEST_READ"] - before == 1
        await read(session, name)
        assert vehicle.requests["PARAM_REQUEST_READ"] - before == 2
