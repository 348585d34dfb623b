"""Components of a link: who they are, whether they are there, restarts, rivals, peers, signatures, hints."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from functools import partial

import anyio
import pytest

from paramclient import errors
from paramclient.model.values import Encoding, ParamType, Trust, encode_value
from paramclient.protocol.commands import reboot, request_message, send_command
from paramclient.protocol.fetch import fetch_all
from paramclient.protocol.identity import judge_encoding
from paramclient.protocol.presence import BOOT_CLOCK_WRAP, REORDERING_TIME, Presence
from paramclient.protocol.reads import read
from paramclient.protocol.selection import find, hint_of_link, only_vehicle
from paramclient.protocol.writes import write
from paramclient.sim import Air, ArduPilotVehicle, GenericVehicle, PX4Vehicle, Vehicle
from paramclient.wire import messages
from paramclient.wire.frames import build_frame
from paramclient.wire.signing import Refusal, Signer, SigningKey, Verifier
from tests.conversations.virtual import Puppet, converse, talking, virtual_on_both
from tests.shell import bits, decoded

PX4 = messages.Heartbeat(2, 12, system_status=4)
ARDUPILOT = messages.Heartbeat(10, 3, system_status=4)
GCS = messages.Heartbeat(messages.MAV_TYPE_GCS, messages.MAV_AUTOPILOT_INVALID, system_status=4)
CAMERA = messages.Heartbeat(30, messages.MAV_AUTOPILOT_INVALID, system_status=4)
KEY = SigningKey(bytes(range(32)))
NOW = 36_000_000_000_000


def value_a(value: int) -> messages.ParamValue:
    """Return a value of the parameter A."""
    return messages.ParamValue("A", struct.pack("<i", value), ParamType.INT32, 10, 0)


class Nothing(Puppet):
    """An endpoint that says nothing: the test says everything."""

    def __init__(self) -> None:
        super().__init__(lambda message: (), heartbeat=None)


# identity and encoding


@pytest.mark.parametrize(
    ("chosen", "capabilities", "autopilot", "expected", "reason"),
    [
        (Encoding.C_CAST, messages.CAPABILITY_PARAM_ENCODE_BYTEWISE, 12, Encoding.C_CAST, "user"),
        (None, messages.CAPABILITY_PARAM_ENCODE_BYTEWISE, 3, Encoding.BYTEWISE, "PARAM_ENCODE_BYTEWISE"),
        (None, messages.CAPABILITY_PARAM_ENCODE_C_CAST, 12, Encoding.C_CAST, "PARAM_ENCODE_C_CAST"),
        (None, 64495, 3, Encoding.C_CAST, "ArduPilot"),
        (None, None, 12, Encoding.BYTEWISE, "PX4"),
        (None, 2, 0, Encoding.BYTEWISE, "standard"),
    ],
)
def test_the_first_evidence_of_the_encoding_decides(
    chosen: Encoding | None, capabilities: int | None, autopilot: int | None, expected: Encoding, reason: str
) -> None:
    encoding, why = judge_encoding(chosen, capabilities, autopilot)
    assert encoding is expected
    assert reason in why


@virtual_on_both
@pytest.mark.parametrize("loss", [0.0, 0.3])
async def test_vehicles_are_identified(loss: float) -> None:
    for vehicle, name in (
        (PX4Vehicle(), "px4"),
        (ArduPilotVehicle(), "ardupilot"),
        (GenericVehicle({"A": 1}), ""),
    ):
        async with talking(Air.symmetric([vehicle], loss=loss, delay=0.03, seed=1)) as (
            conversation,
            session,
        ):
            await session.identification.settled()
            assert session.identification.capabilities is not None
            is_which = (session.identification.is_px4, session.identification.is_ardupilot)
            assert is_which == (name == "px4", name == "ardupilot")
            assert session.identification.identity.link == "sim:test"
            assert conversation.of("identified")
            asked = len(conversation.sent_of(messages.CommandLong))
            await anyio.sleep(20.0)
            further = conversation.sent_of(messages.CommandLong)[asked:]
            assert {each.param1 for each in further} <= {messages.message_id(messages.SystemTime)}
            assert loss or len(further) == 2 * (name == "ardupilot")


@pytest.mark.parametrize("refuses", [True, False])
async def test_a_vehicle_without_a_version_is_settled_within_seconds(refuses: bool) -> None:
    def answer(message: messages.Message) -> Iterable[messages.Message]:
        if isinstance(message, messages.CommandLong) and refuses:
            yield messages.CommandAck(message.command, errors.CommandResult.UNSUPPORTED, 255, 190)

    async with talking(Puppet(answer)) as (conversation, session):
        began = anyio.current_time()
        await session.identification.settled()
        assert anyio.current_time() - began < (2.5 if refuses else 45.0)
        assert {each.command for each in conversation.sent_of(messages.CommandLong)} == {512, 520}
        assert session.identification.capabilities is None
        assert session.identification.encoding is Encoding.BYTEWISE
        await anyio.sleep(0.01)
        assert len(conversation.of("identified")) == 1


async def test_values_received_before_the_encoding_is_known_are_decoded_again_and_then_reported() -> None:
    async with converse(Nothing()) as conversation:
        raw = encode_value(1500, ParamType.INT32, Encoding.C_CAST)
        conversation.hear(messages.ParamValue("RTL_ALT", raw, 6, 10, 0))
        table = conversation.station.nodes[1, 1].plain.table
        assert table.params["RTL_ALT"].value != 1500
        assert not conversation.changes
        conversation.hear(ARDUPILOT)
        assert table.params["RTL_ALT"].value == 1500
        changes = [(each.new and each.new.value, each.kind) for each in conversation.changes]
        assert changes == [(1500, "first")]


async def test_the_heartbeat_of_a_vehicle_that_sends_other_messages_is_requested() -> None:
    async with converse(Nothing()) as conversation:
        for number in range(5):
            await anyio.sleep(0.1)
            attitude = build_frame(30, bytes(range(28)), system=7, component=1, sequence=number)
            conversation.station.receive(attitude, "peer", anyio.current_time())
        request = messages.CommandLong(7, 1, messages.MAV_CMD_REQUEST_MESSAGE, 0.0)
        assert conversation.sent_of(messages.CommandLong) == [request] * 2


async def test_another_hardware_id_clears_the_table_and_the_first_one_does_not() -> None:
    async with converse(Nothing()) as conversation:
        conversation.hear(PX4, value_a(0))
        node = conversation.station.nodes[1, 1]
        for uid, replaced in ((0, 0), (7, 0), (7, 0), (8, 1)):
            conversation.hear(messages.AutopilotVersion(0, uid=uid))
            assert len(conversation.of("replaced")) == replaced
        assert node.identification.identity.uid == "0000000000000008"
        assert not node.plain.table.params


async def test_ground_stations_are_asked_nothing_and_own_and_nameless_frames_are_ignored() -> None:
    async with converse(Nothing()) as conversation:
        for message, system, component in (
            (GCS, 254, 190),
            (GCS, 255, 190),
            (PX4, 0, 1),
            (messages.StatusText(6, "x"), 3, 1),
        ):
            conversation.hear(message, system=system, component=component)
        conversation.hear(value_a(0), system=4)
        await anyio.sleep(3.0)
        assert list(conversation.station.nodes) == [(254, 190), (4, 1)]
        assert {each.target_system for each in conversation.sent_of(messages.CommandLong)} == {4}
        assert not conversation.station.nodes[254, 190].identification.has_parameters


async def test_our_heartbeat_is_sent_once_a_second() -> None:
    async with converse(PX4Vehicle()) as conversation:
        await anyio.sleep(9.5)
        assert conversation.sent_of(messages.Heartbeat) == [GCS] * 10


# presence


@pytest.mark.parametrize(
    ("pauses", "message", "is_lost_after"),
    [([], PX4, 5.0), ([4.0], PX4, 12.0), ([4.0, 0.1], PX4, 12.0), ([], messages.HighLatency2(2, 12), 60.0)],
    ids=["each second", "slow", "slow, and a copy", "by satellite"],
)
async def test_a_component_is_lost_after_a_silence_that_its_heartbeats_do_not_have(
    pauses: list[float], message: messages.Message, is_lost_after: float
) -> None:
    async with converse(Nothing()) as conversation:
        conversation.hear(PX4)
        for pause in pauses:
            await anyio.sleep(pause)
            conversation.hear(PX4)
        conversation.hear(message)
        await anyio.sleep(is_lost_after - 0.1)
        assert not conversation.of("lost")
        await anyio.sleep(1.2)
        assert len(conversation.of("lost")) == 1


# reboots


@pytest.mark.parametrize(
    ("clock", "reboots"),
    [
        ([(0.0, 500_000), (1.0, 501_000), (6.0, 1_200), (7.0, 2_200)], [6.0]),
        ([(0.0, 50_000), (5.0, 1_000), (6.0, 2_000), (6.0, 2_000), (20.0, 500), (21.0, 1_500)], [5.0, 20.0]),
        ([(0.0, 3 * BOOT_CLOCK_WRAP // 4), (9.0, 3_000)], [9.0]),
        ([(0.0, 50_000), (0.1, 49_000), (0.2, 51_000), (0.2, 51_000), (1.0, 50_000)], []),
        ([(0.0, int(1000 * REORDERING_TIME) + 100), (0.1, 150)], [0.1]),
        ([(0.0, BOOT_CLOCK_WRAP - 500), (1.0, 500), (2.0, 1_500)], []),
        ([(0.0, 60_000), (2.0, 400), (2.1, 61_000), (2.2, 600), (4.0, 61_500), (4.1, 2_500)], [2.0]),
        ([(0.0, 90_000), (1.0, 0), (2.0, 92_000)], []),
    ],
    ids=["back", "twice", "after weeks", "reordered", "soon", "wrapped", "late frames", "filled with 0"],
)
def test_a_clock_that_goes_back_shows_a_reboot(clock: list[tuple[float, int]], reboots: list[float]) -> None:
    presence = Presence()
    assert [now for now, boot_ms in clock if presence.boot_clock(2, boot_ms, now)] == reboots


async def test_clocks_of_different_messages_are_not_compared_and_two_signs_are_one_reboot() -> None:
    async with converse(Nothing()) as conversation:
        conversation.hear(PX4)
        node = conversation.station.nodes[1, 1]
        for second in range(10):
            conversation.hear(PX4)
            for number, boot_ms in ((30, 90_000 + 1000 * second), (33, 1000 * second + 1), (132, 700)):
                node.boot_clock(number, boot_ms, anyio.current_time())
            await anyio.sleep(1.0)
        assert not conversation.of("rebooted")
        conversation.hear(value_a(0), messages.Heartbeat(2, 12, system_status=messages.MAV_STATE_BOOT))
        node.boot_clock(30, 500, anyio.current_time())
        conversation.hear(
            messages.SystemTime(0, 700), messages.Heartbeat(2, 12, system_status=messages.MAV_STATE_BOOT)
        )
        assert len(conversation.of("rebooted")) == 1
        assert str(node.plain.table.params["A"].trust) == "cached"


@pytest.mark.parametrize("vehicle", [ArduPilotVehicle(), PX4Vehicle(telemetry=10.0)], ids=["AP", "PX4"])
async def test_a_reboot_by_others_is_seen_by_the_clock_in_telemetry_or_requested(vehicle: Vehicle) -> None:
    async with talking(vehicle) as (conversation, session):
        name = vehicle.listed[0].name
        await read(session, name)
        await anyio.sleep(10.0)
        vehicle.reboot(down=1.5)
        await anyio.sleep(8.0)
        assert len(conversation.of("rebooted")) == 1
        assert session.table.params[name].trust == "cached"


MAKES = pytest.mark.parametrize(
    "make",
    [PX4Vehicle, ArduPilotVehicle, partial(ArduPilotVehicle, kind="plane")],
    ids=["px4", "copter", "plane"],
)


@virtual_on_both
@MAKES
@pytest.mark.parametrize("loss", [0.0, 0.2])
async def test_a_reboot_happens_once_and_waits_for_the_vehicle(make: type[Vehicle], loss: float) -> None:
    vehicle = make()
    async with converse(Air.symmetric([vehicle], loss=loss, delay=0.02, seed=5)) as conversation:
        node = await conversation.node()
        await node.identification.settled()
        await reboot(node)
        assert len(conversation.of("rebooted")) == 1
        assert not node.presence.is_lost
        await read(node.plain, vehicle.listed[0].name)
        await anyio.sleep(10.0)
        assert len(conversation.of("rebooted")) == 1


async def test_a_reboot_is_refused_by_an_armed_vehicle_and_waits_for_px4_to_save() -> None:
    vehicle = PX4Vehicle()
    async with converse(vehicle) as conversation:
        node = await conversation.node()
        await node.identification.settled()
        await write(node.plain, "MC_ROLL_P", 3.0)
        vehicle.armed = True
        await anyio.sleep(1.5)
        with pytest.raises(errors.VehicleArmed):
            await reboot(node)
        vehicle.armed = False
        await anyio.sleep(1.5)
        await reboot(node)
        assert vehicle.param("MC_ROLL_P").value == 3.0
        conversation.hear(PX4, system=9)
        with pytest.raises(errors.NoReply):  # it answers nothing
            await send_command(conversation.station.nodes[9, 1].channel, messages.CommandLong(9, 1, 246, 1.0))


async def test_commands_end_with_their_result_and_wait_while_one_is_in_progress() -> None:
    results = [errors.CommandResult.IN_PROGRESS, errors.CommandResult.ACCEPTED]

    def answer(message: messages.Message) -> Iterable[messages.Message]:
        if isinstance(message, messages.CommandLong) and message.command == 400:
            yield from (messages.CommandAck(400, result, 255, 190) for result in results)

    async with converse(Puppet(answer)) as conversation:
        channel = (await conversation.node()).channel
        await send_command(channel, messages.CommandLong(1, 1, 400))
        results[:] = [errors.CommandResult.DENIED]
        with pytest.raises(errors.CommandRefused) as caught:
            await send_command(channel, messages.CommandLong(1, 1, 400))
        assert caught.value.code == errors.CommandResult.DENIED
    async with converse(PX4Vehicle()) as conversation:
        channel = (await conversation.node()).channel
        assert isinstance(await request_message(channel, messages.Heartbeat), messages.Heartbeat)
        assert await request_message(channel, messages.HighLatency2) is None


# peers


async def test_a_vehicle_at_another_peer_may_be_another_one_until_it_is_identified() -> None:
    async with converse(Nothing()) as conversation:
        conversation.hear(messages.HighLatency2(2, 12), peer="a")  # it counts as lost only after a minute
        conversation.hear(messages.AutopilotVersion(0, uid=7), value_a(1), peer="a")
        node = conversation.station.nodes[1, 1]
        await anyio.sleep(5.5)
        asked = len(conversation.sent_of(messages.CommandLong))
        conversation.hear(messages.HighLatency2(2, 12), peer="b")
        await anyio.sleep(0.1)
        assert node.plain.table.params["A"].trust is Trust.CACHED
        assert len(conversation.sent_of(messages.CommandLong)) > asked
        conversation.hear(messages.AutopilotVersion(0, uid=8), peer="b")
        assert (node.peer, len(conversation.of("replaced"))) == ("b", 1)
        conversation.hear(messages.AutopilotVersion(0, uid=9), peer="c")
        assert node.peer == "b"
        conversation.hear(messages.AutopilotVersion(0, uid=8), peer="c")  # which proves that it has moved
        assert (node.peer, node.has_rival(anyio.current_time())) == ("c", False)


async def test_split_peers_are_components_of_their_own() -> None:
    async with converse(Nothing(), split_peers=True) as conversation:
        for peer in (("10.0.0.1", 1), ("10.0.0.2", 1)):
            conversation.hear(PX4, peer=peer)
            conversation.hear(value_a(peer[0] == "10.0.0.1"), peer=peer)
        nodes = list(conversation.station.nodes.values())
        assert [each.plain.table.params["A"].value for each in nodes] == [1, 0]
        assert find(nodes, 1, 1, "10.0.0.2") is nodes[1]
        with pytest.raises(errors.AmbiguousVehicle, match=r"10\.0\.0\.1:1"):
            only_vehicle(nodes, 1, 1, 5.0, listening_since=0.0)


@virtual_on_both
@MAKES
async def test_a_whole_session_in_mavlink_1(make: type[Vehicle]) -> None:
    vehicle = make(mavlink_version=1)
    async with talking(vehicle) as (conversation, session):
        await session.identification.settled()
        conversation.sent.clear()
        assert bits((await fetch_all(session)).params) == bits(vehicle.params)
        assert {
            data[0] for data in conversation.sent if not isinstance(decoded(data)[0][1], messages.Heartbeat)
        } == {0xFE}


async def test_hints_tell_a_link_that_is_down_from_one_without_heartbeats() -> None:
    async with converse(Nothing()) as conversation:
        conversation.hear(messages.StatusText(6, "x"), system=9)
        assert "1 MAVLink frame arrived on sim:test" in hint_of_link(conversation.station, 60)
        conversation.station.interrupt()
        assert "is down" in hint_of_link(conversation.station, 60)


async def test_components_have_a_bound() -> None:
    async with converse(Nothing()) as conversation:
        for system in range(1, 6):
            for component in range(1, 204):
                conversation.hear(CAMERA, system=system, component=component)
        assert len(conversation.station.nodes) == 1_000


# signatures


@virtual_on_both
@pytest.mark.parametrize("make", [PX4Vehicle, ArduPilotVehicle])
async def test_a_signed_session_takes_no_forged_and_no_replayed_value(make: type[PX4Vehicle]) -> None:
    vehicle = make(signing_key=KEY, signing_timestamp=NOW)
    async with converse(vehicle) as conversation:
        signer = Signer(KEY, timestamp=NOW)
        verifier = Verifier(signer)
        conversation.station.begin_signing(signer, verifier)
        session = (await conversation.node()).plain
        result = await fetch_all(session)
        name = vehicle.listed[0].name
        assert not result.missing
        conversation.hear(messages.ParamValue(name, b"\x9a\x02\0\0", vehicle.listed[0].type, 903, 0))
        assert session.table.params[name].same_value(vehicle.listed[0])
        report = verifier.report()
        assert report.signed > 5
        assert report.refused.keys() == {Refusal.UNSIGNED}
        assert vehicle.signing_report is not None
        assert not vehicle.signing_report.refused
