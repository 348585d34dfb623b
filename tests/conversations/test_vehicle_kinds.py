"""Vehicles that serve only part of the protocol, count wrongly, or are not what they seem."""

from __future__ import annotations

import struct
from collections.abc import Callable
from contextlib import suppress
from functools import partial

import anyio
import pytest

from paramclient import Encoding, ParamClient, ParamType, errors
from paramclient.model.values import encode_value
from paramclient.protocol.fetch import Policy, fetch_all
from paramclient.protocol.reads import read
from paramclient.protocol.set_results import SetStatus
from paramclient.protocol.writes import write, write_many
from paramclient.sim import Air, ArduPilotVehicle, GenericVehicle, PX4Vehicle
from paramclient.wire import messages
from tests.conversations.partial import EVERYTHING, TABLE, Partial
from tests.conversations.virtual import QUIET, Puppet, losing, meanwhile, talking, virtual_on_both
from tests.shell import Eventful, Tap

ARDUPILOT = messages.Heartbeat(2, 3, system_status=4)
PX4 = messages.Heartbeat(2, 12, system_status=4)
RADIO = messages.Heartbeat(49, 0, system_status=4)
CAMERA = messages.Heartbeat(30, 0, system_status=4)

PARTS = [
    ("list", "sets", "acks", "commands"),
    ("list", "sets", "acks"),
    ("list", "sets"),
    ("list", "indices", "sets", "acks", "commands"),
    ("list", "indices", "sets"),
    ("indices", "sets", "acks"),
    ("names", "sets"),
    ("names", "indices", "sets", "acks"),
]


@pytest.mark.parametrize("parts", PARTS, ids="+".join)
@pytest.mark.parametrize(
    ("delay", "loss", "heartbeat"), [(0.0, 0.0, PX4), (0.05, 0.1, QUIET), (0.3, 0.0, ARDUPILOT)]
)
async def test_any_part_suffices_to_read_and_to_prove_a_set(
    parts: tuple[str, ...], delay: float, loss: float, heartbeat: messages.Heartbeat
) -> None:
    encoding = Encoding.C_CAST if heartbeat is ARDUPILOT else Encoding.BYTEWISE
    vehicle = Partial(serves=parts, heartbeat=heartbeat, encoding=encoding)
    async with talking(Air.symmetric([vehicle], delay=delay, loss=loss, seed=1)) as (_, session):
        with anyio.fail_after(15.0):
            result = await write(session, "MODE", 4)
            assert (result.status, result.actual) == ("accepted", 4)
            assert vehicle.values["MODE"] == encode_value(4, ParamType.INT32, encoding)
        assert vehicle.number_of(messages.ParamSet) <= 12
        if "list" in parts or "names" in parts:
            await read(session, "OFFSET")
            assert session.table.params["OFFSET"].value == -7
        if "list" in parts:
            with pytest.raises(errors.UnknownParameter):
                await read(session, "OFFSETS")


PARTS_WITHOUT_SETS = ["list", "list+names", "list+acks", "list+indices", "indices", "names", "names+acks"]


@pytest.mark.parametrize("delay", [0.0, 0.15, 0.3])
@pytest.mark.parametrize("policy", [Policy.CACHE_ONLY, Policy.AUTO])
@pytest.mark.parametrize("parts", [*PARTS_WITHOUT_SETS, "list+indices+acks", "indices+acks"])
async def test_a_set_that_changes_nothing_is_told_as_that_within_a_dozen(
    parts: str, delay: float, policy: Policy
) -> None:
    vehicle = Partial(serves=parts.split("+"))
    async with talking(Air.symmetric([vehicle], delay=delay)) as (_, session):
        with suppress(errors.NoReply):
            await fetch_all(session, policy=policy)
        with pytest.raises(errors.ValueNotApplied, match="1/1 keeps MODE at 5") as caught:
            with anyio.fail_after(15.0):
                await write(session, "MODE", 4)
        assert (caught.value.requested, caught.value.actual) == (4, 5)
        assert vehicle.number_of(messages.ParamSet) <= 12


@pytest.mark.parametrize("seed", range(60))
async def test_sets_that_a_burst_of_losses_takes_are_not_told_as_kept(seed: int) -> None:
    air = Air.symmetric([Partial(serves=("list", "sets"))], delay=0.3, loss=0.2, loss_burst=4, seed=seed)
    async with talking(air) as (_, session):
        with suppress(errors.NoReply):
            assert (await write(session, "MODE", 4)).status == "accepted"


async def test_an_acknowledgement_in_another_type_changes_neither_the_type_nor_the_history() -> None:
    for kind in (ParamType.REAL32, ParamType.UINT32, ParamType.INT8):
        air = Air.symmetric([Partial(ack_type=kind)], delay=0.3)
        async with talking(air) as (conversation, session):
            await fetch_all(session)
            conversation.changes.clear()
            with anyio.move_on_after(0.2):  # its acknowledgement comes later
                await write(session, "MODE", 9)
            await anyio.sleep(1.0)
            result = await write(session, "MODE", 4)
            assert (result.status, result.actual, result.param.type) == ("accepted", 4, ParamType.INT32)
            changes = [(each.name, each.new and each.new.value) for each in conversation.changes]
            assert changes == [("MODE", 9), ("MODE", 4)]


async def test_an_integer_is_not_written_in_the_type_of_a_repeated_acknowledgement() -> None:
    for seed in range(12):
        vehicle = Partial(ack_type=ParamType.REAL32)
        air = Air.symmetric([vehicle], duplicate=0.5, reorder=0.3, delay=0.1, seed=seed)
        async with talking(air) as (_, session):
            await write(session, "MODE", 9)
            assert vehicle.values["MODE"] == encode_value(9, ParamType.INT32, Encoding.BYTEWISE)


async def test_a_value_in_another_type_after_a_set_is_taken() -> None:
    async with talking(vehicle := Partial()) as (_, session):
        await write(session, "MODE", 4)
        vehicle.types["MODE"], vehicle.values["MODE"] = ParamType.REAL32, struct.pack("<f", 2.5)
        assert (await fetch_all(session)).params["MODE"].value == 2.5


INDICES = ("indices", "commands")
FORTY = {f"P{number:02}": (number, ParamType.INT32) for number in range(40)}
COUNTS: dict[str, Callable[[int], int]] = {
    "right": lambda index: 40,
    "growing": lambda index: index + 1,
    "its index": lambda index: index,
    "0": lambda index: 0,
    "65535": lambda index: 65_535,
    "5": lambda index: 5,
    "39": lambda index: 39,
}


@pytest.mark.parametrize("heartbeat", [QUIET, PX4], ids=["generic", "PX4"])
@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize(
    ("serves", "loss"),
    [(EVERYTHING, 0.0), (EVERYTHING, 0.1), (("list",), 0.0), (("indices",), 0.0), (INDICES, 0.1)],
    ids=["all", "all, loss", "list only", "reads by index only", "reads by index only, loss"],
)
async def test_odd_indices_and_counts_make_a_complete_table(
    serves: tuple[str, ...], loss: float, count: str, first: int, heartbeat: messages.Heartbeat
) -> None:
    vehicle = Partial(FORTY, serves=serves, count=COUNTS[count], first=first, heartbeat=heartbeat)
    async with talking(Air.symmetric([vehicle], delay=0.05, loss=loss, seed=3)) as (conversation, session):
        result = await fetch_all(session)
        assert (result.complete, len(result.params), result.count, result.missing) == (True, 40, 40, ())
        assert {name: (each.value, each.index) for name, each in result.params.items()} == {
            f"P{number:02}": (number, number + first) for number in range(40)
        }
        assert bool(result.lost) <= bool(loss)
        conversation.hear(
            messages.ParamValue("P02", bytes(4), ParamType.INT32, COUNTS[count](2 + first), 2 + first)
        )
        assert session.table.is_complete


@pytest.mark.parametrize("serves", [EVERYTHING, ("list",), INDICES])
@pytest.mark.parametrize("loss", [0.1, 0.2])
async def test_a_growing_count_is_complete_at_its_end_only(loss: float, serves: tuple[str, ...]) -> None:
    for seed in range(12):
        vehicle = Partial(FORTY, serves=serves, count=lambda index: index + 1)
        async with talking(Air.symmetric([vehicle], delay=0.05, loss=loss, seed=seed)) as (_, session):
            result = await fetch_all(session)
            assert not result.complete or len(result.params) == 40


@pytest.mark.parametrize("step", [0, 1])
@pytest.mark.parametrize("changed", [lambda at: 40 + at % 2, lambda at: 40 - at, lambda at: 0, lambda at: 1])
async def test_no_value_is_dropped_that_has_just_come(step: int, changed: Callable[[int], int]) -> None:
    """Where the count changes within the list, or all have the index 0."""
    vehicle = Partial(FORTY, serves=("list",), step=step, count=changed)
    async with talking(Air.symmetric([vehicle], rate=3_000.0)) as (_, session):
        assert (await fetch_all(session)).params.keys() == FORTY.keys()


@pytest.mark.parametrize("count", [9, 3_008, 32_768])
async def test_a_count_that_is_too_large_costs_seconds_and_no_value(count: int) -> None:
    async with talking(Partial(count=lambda index: count)) as (conversation, session):
        result = await fetch_all(session)
        assert (set(result.params), result.received, result.lost) == (set(TABLE), len(TABLE), 0)
        assert result.count == count
        assert result.missing == tuple(range(len(TABLE), result.count))
        assert anyio.current_time() < 20.0
        assert len(conversation.sent) < 1_000


@pytest.mark.parametrize("seed", range(6))
async def test_a_list_of_firmware_without_reads_is_requested_until_it_is_complete(seed: int) -> None:
    vehicle = Partial(serves=("list",), heartbeat=QUIET)
    async with talking(Air.symmetric([vehicle], delay=0.01, loss=0.2, seed=seed)) as (_, session):
        assert (await fetch_all(session)).missing == ()


@pytest.mark.parametrize("seed", range(8))
async def test_many_are_set_at_once_where_no_name_is_read(seed: int) -> None:
    vehicle = Partial(FORTY, serves=("list", "indices", "sets", "acks", "commands"))
    async with talking(Air.symmetric([vehicle], delay=0.05, loss=0.1, seed=seed)) as (_, session):
        assert (await write_many(session, [(name, 4) for name in FORTY])).counts == {SetStatus.ACCEPTED: 40}


@pytest.mark.parametrize("seed", range(8))
async def test_reads_by_index_alone_suffice_on_a_lossy_link(seed: int) -> None:
    vehicle = Partial(serves=("indices", "sets"), first=1, heartbeat=QUIET)
    async with talking(Air.symmetric([vehicle], delay=0.15, loss=0.1, seed=seed)) as (_, session):
        with anyio.fail_after(15.0):
            assert (await write(session, "MODE", 4)).status == "accepted"


async def test_a_slow_answer_costs_no_value_of_a_later_fetch() -> None:
    air = Air.symmetric([Partial(FORTY, serves=INDICES)], delay=0.02, loss=0.1, seed=1)
    async with talking(air) as (conversation, session):
        async with meanwhile(read(session, 3)):
            conversation.station.interrupt()
            await anyio.sleep(15.0)
            conversation.station.resume(anyio.current_time())
        assert (await fetch_all(session)).missing == ()


@pytest.mark.parametrize("count", [lambda index: index + 1, lambda index: 0])
@pytest.mark.parametrize("serves", [("list", "indices", "ends"), ("indices", "ends")])
async def test_a_nameless_answer_ends_the_table(serves: tuple[str, ...], count: Callable[[int], int]) -> None:
    """As of DroneCAN nodes, to reads beyond the end."""
    async with talking(Partial(FORTY, serves=serves, count=count)) as (_, session):
        assert (await fetch_all(session)).params.keys() == FORTY.keys()
        assert anyio.current_time() < 15.0


async def test_there_are_no_parameters_where_a_list_has_no_name() -> None:
    """As of INAV."""
    none = messages.ParamValue("", bytes(4), ParamType.REAL32, 0, 0)
    inav = Puppet(lambda message: [none] * isinstance(message, messages.ParamRequestList), heartbeat=PX4)
    async with talking(inav) as (_, session):
        with pytest.raises(errors.NoReply):
            await fetch_all(session)
        assert not session.table.left_out


async def test_the_first_value_of_a_list_that_is_lost_is_missing_and_no_other() -> None:
    vehicle = Tap(Partial(serves=("list",)), down=lambda message: getattr(message, "param_index", None) != 0)
    async with talking(vehicle) as (_, session):
        result = await fetch_all(session)
        assert (result.missing, result.received) == ((0,), len(TABLE) - 1)


async def test_the_last_value_of_a_list_from_1_that_is_lost_is_read_at_once() -> None:
    lost = losing(1, lambda message: getattr(message, "param_index", None) == len(TABLE))
    async with talking(Air.symmetric([Tap(Partial(first=1), down=lost)], delay=0.02)) as (_, session):
        assert (await fetch_all(session)).complete
        assert anyio.current_time() < 1.0


async def test_listed_names_that_differ_in_case_alone_are_two_parameters() -> None:
    """On an ArduPilot too, which repeats the case of a request in its answer."""
    table = {"I_A": (5.0, ParamType.REAL32), "i_a": (9.0, ParamType.REAL32)}
    async with talking(Partial(table, serves=("list",), heartbeat=ARDUPILOT)) as (_, session):
        params = (await fetch_all(session)).params
        assert {name: param.value for name, param in params.items()} == {"I_A": 5.0, "i_a": 9.0}


@pytest.mark.parametrize(("delay", "idle"), [(0.05, 0.0), (0.3, 0.0), (0.3, 3.0)])
@pytest.mark.parametrize("first", [0, 1, messages.NO_INDEX])
@pytest.mark.parametrize("serves", [EVERYTHING, *((by, "sets", "commands") for by in ("names", "indices"))])
async def test_names_in_lower_case_are_found_whatever_the_autopilot(
    serves: tuple[str, ...], first: int, delay: float, idle: float
) -> None:
    table = {"gain": (0.5, ParamType.REAL32), "mode": (5, ParamType.REAL32)}
    serves = serves if first < 2 else ("names", "sets")
    vehicle = Partial(table, serves=serves, first=first, step=first < 2, heartbeat=ARDUPILOT)
    async with talking(Air.symmetric([vehicle], delay=delay)) as (_, session):
        await anyio.sleep(idle)
        with anyio.fail_after(15.0):
            result = await write(session, "mode", 4)
        assert (result.name, result.actual) == ("mode", 4)
        assert session.table.params.keys() <= table.keys()
        if "list" in serves:
            await fetch_all(session)
            assert set(session.table.params) == {"mode", "gain"}


@pytest.mark.parametrize("name", ["RC MAP", "A,B", "42", "\xff\x01"])
async def test_a_name_that_no_file_can_hold_is_noted_and_not_missed(name: str) -> None:
    async with talking(Partial({**TABLE, name: (1.0, ParamType.REAL32)})) as (_, session):
        result = await fetch_all(session)
        assert (result.missing, set(result.params)) == ((), set(TABLE))
        assert any(repr(name) in note for note in result.notes)


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("count", [2, 4])
async def test_a_name_that_an_ardupilot_does_not_list_is_unknown(first: int, count: int) -> None:
    table = {"abc_def": (5.0, ParamType.REAL32), "ghi": (1.0, ParamType.REAL32)}
    vehicle = Partial(table, serves=("list",), first=first, count=lambda index: count, heartbeat=ARDUPILOT)
    async with talking(vehicle) as (_, session):
        with pytest.raises(errors.UnknownParameter, match=r"1/1 has no ABC_DEF; did you mean abc_def"):
            await read(session, "ABC_DEF")
        assert (await read(session, "abc_def")).param_id == "abc_def"
        assert anyio.current_time() < 20.0


@pytest.mark.parametrize("step", [1, 2])
@pytest.mark.parametrize("serves", [EVERYTHING, ("list", "indices")], ids=["all reads", "by index"])
async def test_an_unknown_name_of_a_px4_without_hash_is_unknown(serves: tuple[str, ...], step: int) -> None:
    vehicle = Partial(serves=serves, step=step, heartbeat=PX4, count=lambda index: len(TABLE) + 2)
    async with talking(vehicle) as (_, session):
        lacks = "" if serves is EVERYTHING else rf" \(its list has {len(TABLE)} of "
        with pytest.raises(errors.UnknownParameter, match=f"no MODES.*{lacks}"):
            await read(session, "MODES")
        assert vehicle.number_of(messages.ParamRequestList) == (serves is not EVERYTHING)
        assert anyio.current_time() < 15.0


async def test_a_misspelt_name_costs_seconds_where_others_are_answered() -> None:
    async with talking(Air.symmetric([PX4Vehicle()], delay=0.15)) as (_, session):
        await read(session, "MC_ROLL_P")
        with pytest.raises(errors.UnknownParameter):
            await read(session, "NOPE")
        assert anyio.current_time() < 10.0


async def test_an_unknown_name_beside_a_fetch_costs_no_list_of_its_own() -> None:
    vehicle = PX4Vehicle()
    async with talking(Air.symmetric([vehicle], delay=0.05)) as (_, session):
        async with meanwhile(read(session, "NOPE"), read(session, "MC_ROLL_P")) as outcomes:
            await fetch_all(session)
        assert isinstance(outcomes[1], errors.UnknownParameter)
        assert vehicle.requests["PARAM_REQUEST_LIST"] == 1


@pytest.mark.parametrize("beat", [QUIET, PX4], ids=["generic", "PX4"])
async def test_values_of_a_repeated_list_are_no_answers_to_reads(beat: messages.Heartbeat) -> None:
    vehicle = Partial(serves=("list", "sets", "acks"), heartbeat=beat)

    def down(message: messages.Message) -> bool:
        lost_in = {"MODE": 3, "OFFSET": 1}.get(getattr(message, "param_id", ""), -1)
        return vehicle.number_of(messages.ParamRequestList) > lost_in

    async with talking(Air.symmetric([Tap(vehicle, down=down)], delay=0.15)) as (_, session):
        assert (await write(session, "MODE", 4)).status == "accepted"


async def test_a_known_parameter_that_a_list_lost_is_not_unknown() -> None:
    lost: set[str] = set()
    vehicle = Tap(Partial(serves=("list",)), down=lambda message: getattr(message, "param_id", 0) not in lost)
    async with talking(Air.symmetric([vehicle])) as (_, session):
        await read(session, "NODE_ID")
        lost.add("NODE_ID")
        with pytest.raises(errors.NoReply):
            await read(session, "NODE_ID")


async def test_a_parameter_is_not_unknown_where_the_list_was_cut_off() -> None:
    vehicle = Partial(serves=("list",))

    def down(message: messages.Message) -> bool:
        is_first = vehicle.number_of(messages.ParamRequestList) == 1
        return not isinstance(message, messages.ParamValue) or (is_first and message.param_index < 3)

    async with talking(Air.symmetric([Tap(vehicle, down=down)])) as (_, session):
        with pytest.raises(errors.NoReply):
            await read(session, "MODE")


async def test_a_component_with_one_parameter_and_no_list_is_fetched() -> None:
    async with talking(Partial({"A": (5, ParamType.INT32)}, serves=("indices",))) as (_, session):
        assert (await fetch_all(session)).complete


async def test_an_acknowledgement_with_an_index_is_known_where_reads_have_none() -> None:
    def on_set(message: messages.ParamSet) -> list[messages.Message]:
        return [messages.ParamValue("MODE", message.raw, ParamType.INT32, 8, 5)]

    vehicle = Partial(serves=("names",), first=messages.NO_INDEX, step=0, on_set=on_set)
    async with talking(vehicle) as (_, session):
        await write(session, "MODE", 4)
        assert session.table.params["MODE"].value == 4


@pytest.mark.parametrize(("reads", "delay"), [(["names"], 0.15), (["list", "indices"], 0.0)])
async def test_late_acknowledgements_in_another_type_are_no_new_type(reads: list[str], delay: float) -> None:
    vehicle = Partial(serves=(*reads, "sets", "commands"))
    ack = messages.ParamValue("MODE", struct.pack("<i", 9), ParamType.REAL32, 8, 5)
    late = Eventful(vehicle, *((at, partial(vehicle.say, ack)) for at in (0.9, 1.1)))
    async with talking(Air.symmetric([late], delay=delay)) as (_, session):
        assert (await write(session, "MODE", 9)).status == "accepted"
    assert vehicle.values["MODE"] == ack.raw


async def test_a_list_ends_while_others_poll_a_parameter() -> None:
    vehicle = PX4Vehicle()
    request = messages.encode(messages.ParamRequestRead(1, 1, "", 400), system=254, component=190, sequence=5)
    up = losing(1, lambda message: isinstance(message, messages.ParamRequestList))
    poll = partial(vehicle.receive, request, 0.0)
    polled = Eventful(Tap(vehicle, up=up), *((at / 5, poll) for at in range(200)))
    async with talking(Air.symmetric([polled], delay=0.01)) as (_, session):
        assert (await fetch_all(session)).complete
        assert anyio.current_time() < 20.0


async def test_a_parameter_that_goes_within_a_list_is_gone() -> None:
    before, after = (Partial(dict([*FORTY.items()][first:]), serves=["list"]) for first in (0, 1))
    puppet = Puppet(lambda each: [*[*before.answers(each)][:20], *after.answers(each)], heartbeat=QUIET)
    async with talking(puppet) as (_, session):
        assert (await fetch_all(session)).params.keys() == FORTY.keys() - {"P00"}


async def test_an_ardupilot_may_answer_reads_by_name_only() -> None:
    vehicle = Partial(heartbeat=ARDUPILOT, encoding=Encoding.C_CAST)
    async with talking(vehicle) as (_, session):
        await fetch_all(session)
        vehicle.serves = {"names", "sets"}
        session.table.doubt()
        assert (await write(session, "MODE", 4)).actual == 4


async def test_the_answer_to_a_control_read_is_none_to_another_read() -> None:
    vehicle = Partial(serves=("list", "indices", "sets", "acks", "commands"))
    async with talking(Air.symmetric([vehicle], delay=0.05)) as (_, session):
        async with meanwhile(read(session, "GAIN_0")) as outcomes:
            await anyio.sleep(0.5)
            await read(session, "GAIN_1")
        assert outcomes[0].param_id == "GAIN_0"


@pytest.mark.parametrize("heartbeat", [ARDUPILOT, QUIET, PX4], ids=["AP", "generic", "PX4"])
@pytest.mark.parametrize("parts", [("list", "sets"), ("list", "sets", "acks")], ids="+".join)
@virtual_on_both
async def test_a_listed_value_counts_at_once(heartbeat: messages.Heartbeat, parts: tuple[str, ...]) -> None:
    count = len(TABLE) + 3_000
    table = {name: (value, ParamType.REAL32) for name, (value, _) in TABLE.items()}
    vehicle = Partial(table, serves=parts, heartbeat=heartbeat, count=lambda index: count)
    async with talking(vehicle) as (_, session):
        began = anyio.current_time()
        await read(session, "OFFSET")
        assert anyio.current_time() - began < 8.5
        assert (await write(session, "MODE", 4)).status == "accepted"
        assert anyio.current_time() - began < 12.0
        assert not session.listing.is_running


# the encoding


@pytest.mark.parametrize(
    ("heartbeat", "capabilities", "encoding"),
    [
        (ARDUPILOT, None, Encoding.BYTEWISE),
        (ARDUPILOT, messages.CAPABILITY_FTP, Encoding.BYTEWISE),
        (QUIET, None, Encoding.C_CAST),
        (PX4, messages.CAPABILITY_PARAM_ENCODE_BYTEWISE, Encoding.C_CAST),
    ],
    ids=["AP", "AP with version", "generic", "PX4 with version"],
)
@pytest.mark.parametrize("name", ["MODE", "OFFSET", "ZERO"])
async def test_integers_in_another_encoding_are_told_and_not_written(
    heartbeat: messages.Heartbeat, capabilities: int | None, encoding: Encoding, name: str
) -> None:
    floats = [f"F{number}" for number in range(8 if name == "OFFSET" else 40)]
    table = {"ZERO": (0, ParamType.INT32), **dict.fromkeys(floats, (0.0, ParamType.REAL32)), **TABLE}
    version = None if capabilities is None else messages.AutopilotVersion(capabilities, uid=7)
    vehicle = Partial(table, heartbeat=heartbeat, encoding=encoding, version=version)
    async with talking(vehicle) as (_, session):
        with pytest.raises(errors.UsageError, match=rf"was not written.*--encoding {encoding}"):
            await write(session, name, 9)
        assert (await write(session, "GAIN_1", 2.5)).status == "accepted"
        assert vehicle.number_of(messages.ParamSet) == 1
        assert any(f"--encoding {encoding}" in note for note in (await fetch_all(session)).notes)
    async with talking(vehicle, encoding=encoding) as (_, session):
        asked = vehicle.number_of(messages.ParamRequestRead)
        assert (await write(session, name, 9)).status == "accepted"
        assert vehicle.number_of(messages.ParamRequestRead) == asked + 1
        assert (await fetch_all(session)).params["NODE_ID"].value == 3
        assert not session.encoding_doubt


@pytest.mark.parametrize("serves", [("list", "sets", "acks"), ("list", "names", "sets", "acks")])
async def test_a_list_in_progress_may_still_show_another_encoding(serves: tuple[str, ...]) -> None:
    table = {"ZERO": (0.0, ParamType.INT32), **TABLE}
    vehicle = Partial(table, serves=serves, heartbeat=QUIET, encoding=Encoding.C_CAST)
    async with talking(Air.symmetric([vehicle], rate=1_000.0)) as (_, session):
        with pytest.raises(errors.UsageError, match=r"was not written.*--encoding c-cast"):
            await write(session, "ZERO", 9)
    table = {name: table[name] for name in ("ZERO", "GAIN_1")}
    async with talking(Partial(table, serves=("names", "sets"), heartbeat=QUIET)) as (_, session):
        session.serves_reads[int] = False  # nothing shows it, and no list is served
        assert (await write(session, "ZERO", 9)).status == "accepted"


class BytewiseArduPilot(ArduPilotVehicle):
    encoding = Encoding.BYTEWISE


async def test_a_file_shows_which_integers_tell_the_encoding() -> None:
    table = {**{f"F{number}": number / 2 for number in range(50)}, "Z_A": 0, "Z_B": 77}
    async with talking(BytewiseArduPilot(table=table, live=())) as (_, session):
        await fetch_all(session)
        with pytest.raises(errors.UsageError, match=r"was not written.*--encoding bytewise"):
            await write(session, "Z_A", 9)


async def test_a_whole_list_is_requested_once_for_the_encoding() -> None:
    async with talking(vehicle := Partial(dict.fromkeys("ABCDEFGHI", (0, ParamType.INT32)))) as (_, session):
        await fetch_all(session)
        await write(session, "A", 0)
        assert vehicle.number_of(messages.ParamRequestList) == 1


async def test_right_encodings_are_not_doubted() -> None:
    for heartbeat, encoding in ((ARDUPILOT, Encoding.C_CAST), (QUIET, Encoding.BYTEWISE)):
        large = 2**24 if encoding is Encoding.C_CAST else 2**31 - 1
        table = {**TABLE, "LARGE": (large, ParamType.INT32), "ID": (1_310_988, ParamType.INT32)}
        async with talking(Partial(table, heartbeat=heartbeat, encoding=encoding)) as (_, session):
            await fetch_all(session)
            assert not session.encoding_doubt


@pytest.mark.parametrize("maker", [PX4Vehicle, ArduPilotVehicle])
async def test_the_encoding_is_looked_for_once_and_within_a_round_trip(maker: type[PX4Vehicle]) -> None:
    vehicle = maker()
    zeros = [each.name for each in vehicle.listed if each.type is ParamType.INT32 and not each.value][:20]
    async with talking(Air.symmetric([vehicle], delay=0.1)) as (_, session):
        await anyio.sleep(1.0)
        outcomes = (await write_many(session, [(name, 1) for name in zeros])).outcomes
        assert {each.status for each in outcomes} <= {SetStatus.ACCEPTED, SetStatus.REFUSED}
        asked = vehicle.requests["PARAM_REQUEST_READ"]
        assert len(zeros) < asked <= len(zeros) + 8
        await write(session, zeros[0], 0)
        assert vehicle.requests["PARAM_REQUEST_READ"] == asked


# addresses


@pytest.mark.parametrize(("first", "delay"), [(0, 0.0), (1, 0.0), (0, 0.8)])
@pytest.mark.parametrize("serves", [EVERYTHING, ("list",), ("names", "indices"), ("indices",)], ids="+".join)
async def test_a_silent_component_is_found_by_both_ids(
    serves: tuple[str, ...], first: int, delay: float
) -> None:
    bridge = Partial(serves=serves, first=first, heartbeat=None, component=240)
    air = Air.symmetric([GenericVehicle({"A": 1}), bridge], delay=delay)
    async with ParamClient(air, cache=False) as client:
        async with meanwhile(*(client.component(1, 240) for _ in range(8))):
            component = await client.component(1, 240)
        assert (await component.get("MODE")).value == 5
        assert client.autopilots == [client.components[1, 1]]
        with pytest.raises(errors.NoReply):
            await client.component(1, 241)
        with pytest.raises(errors.NoReply):
            await client.component(component=242)
        assert await client.only_component(1, 240) is component


async def test_a_component_that_starts_late_is_asked_under_its_own_id() -> None:
    def is_on(message: messages.Message) -> bool:
        return anyio.current_time() > 5.0  # its heartbeat arrives behind a probe of the autopilot's id

    late = Tap(Partial(component=240), up=is_on, down=is_on)
    async with ParamClient(Air.symmetric([GenericVehicle({"A": 1}), late]), cache=False) as client:
        assert (await (await client.component(1, 240, timeout=20)).get("MODE")).value == 5


async def test_values_under_another_id_are_named_and_can_be_read() -> None:
    both = [Puppet(lambda message: ()), Partial(component=50, asked_as=1, heartbeat=None)]
    async with ParamClient(Air.symmetric(both), cache=False) as client:
        with pytest.raises(errors.NoReply, match="values came from 1/50"):
            await (await client.component(1, 1)).fetch_all()
    async with ParamClient(Air.symmetric(both, delay=0.8), cache=False) as client:
        result = await (await client.component(1, 50)).fetch_all()
        assert (result.complete, set(result.params)) == (True, set(TABLE))


async def test_a_component_1_that_claims_no_autopilot_is_the_vehicle_where_no_other_is() -> None:
    vehicle = Partial(heartbeat=messages.Heartbeat(2, 8, system_status=4))
    async with ParamClient(vehicle, cache=False) as client:
        assert (await client.component()).address == (1, 1)
        assert (await client.only_component(1)).address == (1, 1)
    pilot = GenericVehicle({"A": 1}, component=2)
    async with ParamClient(Air.symmetric([vehicle, pilot]), cache=False) as client:
        await anyio.sleep(2.0)
        assert (await client.only_component()).address == (1, 2)


@pytest.mark.parametrize(("heartbeat", "is_vehicle"), [(QUIET, True), (CAMERA, False)])
async def test_a_vehicle_with_system_id_0_is_told(heartbeat: messages.Heartbeat, is_vehicle: bool) -> None:
    async with ParamClient(Partial(system=0, heartbeat=heartbeat), cache=False) as client:
        with pytest.raises(errors.NoReply) as caught:
            await client.component(timeout=3.0)
        assert ("A vehicle with system id 0" in str(caught.value)) == is_vehicle


@pytest.mark.parametrize(
    ("heartbeat", "component"),
    [
        (messages.Heartbeat(18, 0, system_status=4), 191),
        (CAMERA, 100),
        (messages.Heartbeat(26, 3, system_status=4), 1),
        (QUIET, 154),
        (RADIO, 68),
    ],
    ids=["companion", "camera", "gimbal", "gimbal by its id", "radio"],
)
async def test_part_of_a_vehicle_is_never_the_vehicle(heartbeat: messages.Heartbeat, component: int) -> None:
    part = Partial(heartbeat=heartbeat, system=2, component=component)
    async with ParamClient(part, cache=False) as client:
        for choose in (client.component, client.only_component):
            with pytest.raises(errors.NoReply, match="None is an autopilot"):
                await choose(timeout=3.0)
        assert (await client.component(2, component)).address == (2, component)
    late = Tap(GenericVehicle({"A": 1}), down=lambda message: anyio.current_time() > 4.0)
    async with ParamClient(Air.symmetric([part, late]), cache=False) as client:
        assert (await client.component()).address == (1, 1)
        assert (await client.only_component()).address == (1, 1)


async def test_a_component_with_the_id_0_is_a_component() -> None:
    async with ParamClient(Partial(component=0, asked_as=0), cache=False) as client:
        assert (await (await client.component(1, 0)).fetch_all()).complete
        with pytest.raises((errors.NoReply, errors.AmbiguousVehicle)):
            await client.component(1, 7, timeout=3.0)
    async with ParamClient(Air([Partial(component=0), Partial(component=191)]), cache=False) as client:
        component = await client.component(1, 0)
        await client.component(1, 191)
        with pytest.raises(errors.UsageError, match="component 0 means all 2 of its system"):
            await component.set("MODE", 4)


@virtual_on_both
async def test_the_chosen_encoding_counts_from_the_first_value_on() -> None:
    vehicle = Partial(encoding=Encoding.C_CAST, heartbeat=None, component=240)
    async with ParamClient(vehicle, cache=False, encoding=Encoding.C_CAST) as client:
        await (await client.component(1, 240)).set("MODE", 9)
        assert vehicle.values["MODE"] == encode_value(9, ParamType.INT32, Encoding.C_CAST)
