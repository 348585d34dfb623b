"""The recordings of real autopilots: decoded, and held against the simulated ones."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable

import pytest

from paramclient.protocol import wire
from paramclient.sim import ArduPilotVehicle, PX4Vehicle, Vehicle, ardupilot_table, px4_table
from paramclient.values import Encoding, Param, ParamType, Value, decode, known_type, px4_hash
from tests.recordings import NAMES, from_ground, from_vehicle, param_values, read

PX4_HASH = 0xCF579589
BAROMETER = ("CAL_BARO0_ID", "CAL_BARO0_OFF", "CAL_BARO0_PRIO")
"""What the PX4 vehicle's firmware sets while it boots, and saves only after the first change by a user."""

UNKNOWN_IDS = {8, 380, 410, 411}
"""Messages in the logs that pymavlink's dialect does not define."""


def message_id(data: bytes) -> int:
    return int.from_bytes(data[7:10], "little")


def params(values: Iterable[wire.ParamValue], encoding: Encoding) -> list[Param]:
    """What a full download says, without the hash."""
    found = []
    for value in values:
        if value.param_index != wire.NO_INDEX:
            number, bits = decode(value.raw, value.param_type, encoding)
            found.append(Param(value.param_id, number, known_type(value.param_type), value.param_index, bits))
    return found


class TestDecoding:
    def test_there_are_nineteen(self) -> None:
        assert len(NAMES) == 19

    @pytest.mark.parametrize("name", NAMES)
    def test_every_frame_of_a_known_message_is_found_and_checked(self, name: str) -> None:
        records = read(name)
        assert {message_id(record.data) for record in records if record.frame is None} <= UNKNOWN_IDS
        for record in records:
            if record.frame is not None:
                assert record.frame.message_id == message_id(record.data)
                assert record.frame.system == record.system
        assert {record.system for record in records} == {1, 255}

    @pytest.mark.parametrize("name", NAMES)
    def test_the_session_as_one_stream_gives_the_same_frames(self, name: str) -> None:
        records = [record for record in read(name) if record.frame is not None]
        framer = wire.Framer()
        stream = b"".join(record.data for record in records)
        frames = [
            frame for at in range(0, len(stream), 100) for frame in framer.receive(stream[at : at + 100])
        ]
        assert frames == [record.frame for record in records]
        assert framer.skipped == 0

    @pytest.mark.parametrize("name", NAMES)
    def test_encoding_what_was_decoded_gives_the_bytes_of_the_log(self, name: str) -> None:
        """For the messages of the protocol itself, which `wire` holds in full."""
        values = wire.ParamValue | wire.ParamSet | wire.ParamRequestRead | wire.ParamRequestList
        kinds = values | wire.FileTransfer
        for record in read(name):
            message = record.message
            if isinstance(message, kinds):
                assert record.frame is not None
                _, system, component, sequence, _, version = record.frame
                again = wire.encode(
                    message, system=system, component=component, sequence=sequence, version=version
                )
                assert again == record.data

    def test_px4_gives_the_table_and_its_hash(self) -> None:
        values = param_values(from_vehicle("px4_full_download"))
        first = next(at for at, value in enumerate(values) if value.param_id == wire.HASH_CHECK)
        announced = values[first]
        assert [value.param_id for value in values[:first]] == list(BAROMETER)
        assert announced[1:] == (PX4_HASH.to_bytes(4, "little"), ParamType.UINT32, 903, wire.NO_INDEX)
        found = params(values[first:], Encoding.BYTEWISE)
        assert found == [
            Param(row.name, row.value, row.type, index, row.bits) for index, row in enumerate(px4_table())
        ]
        assert len(found) == 903
        assert {value.param_count for value in values} == {903}
        volatile = [row.name for row in px4_table() if row.volatile]
        assert len(volatile) == 58
        assert px4_hash(found, leave_out=volatile) == PX4_HASH
        assert px4_hash(found) != PX4_HASH

    def test_ardupilot_gives_the_table(self) -> None:
        values = param_values(from_vehicle("ardupilot_full_download"))
        found = params(values, Encoding.C_CAST)
        assert len(found) == len(values) == 1382
        assert found == [
            Param(row.name, row.value, row.type, index, row.bits)
            for index, row in enumerate(ardupilot_table())
        ]
        assert {value.param_count for value in values} == {1382}


def replay(
    vehicle: Vehicle, name: str, on_board: Iterable[tuple[float, str, Value]] = ()
) -> list[tuple[float, wire.Message]]:
    """Let the vehicle hear the ground station of a log at the recorded times; what it sent meanwhile.

    Args:
        on_board: what happened inside the vehicle: when, which parameter, and the value that it took.
    """
    inputs: list[tuple[float, bytes | tuple[str, Value]]] = [
        *((record.time, record.data) for record in from_ground(name)),
        *((time, (param, value)) for time, param, value in on_board),
        (read(name)[-1].time + 0.05, b""),
    ]
    framer = wire.Framer(stream=False)
    sent: list[tuple[float, wire.Message]] = []

    def collect(now: float) -> None:
        for data in vehicle.data_to_send():
            (frame,) = framer.receive(data)
            message = wire.decode(frame)
            assert message is not None
            sent.append((now, message))

    vehicle.tick(0.0)
    for time, action in sorted(inputs, key=lambda item: item[0]):
        while (due := vehicle.next_deadline()) is not None and due <= time:
            vehicle.tick(due)
            collect(due)
        if isinstance(action, bytes):
            vehicle.receive(action, time)
        else:
            vehicle.tick(time)
            vehicle.set_param(*action)
        collect(time)
    return sent


def stream_time(messages: list[tuple[float, wire.Message]]) -> float:
    """Seconds from the first parameter of the last list to its last."""
    listed = [
        (time, message.param_index)
        for time, message in messages
        if isinstance(message, wire.ParamValue) and message.param_index != wire.NO_INDEX
    ]
    return listed[-1][0] - next(time for time, index in reversed(listed) if index == 0)


class TestReplay:
    def test_px4_full_download(self) -> None:
        """The barometer, found 1.4 s into the log and told of unasked, is replayed as an event."""
        vehicle = PX4Vehicle()
        found = [vehicle.param(name) for name in BAROMETER]
        for name in BAROMETER:
            vehicle.set_param(name, -1)
        recorded = from_vehicle("px4_full_download")
        events = [(1.4147, param.name, param.value) for param in found]
        sent = replay(vehicle, "px4_full_download", events)
        assert param_values(sent) == param_values(recorded)
        assert stream_time(sent) == pytest.approx(stream_time(recorded), rel=0.1)

    def test_px4_hash_hit_and_stop(self) -> None:
        sent = replay(PX4Vehicle(), "px4_hash_hit_and_stop")
        assert param_values(sent) == param_values(from_vehicle("px4_hash_hit_and_stop"))
        assert len(param_values(sent)) == 1 + 20

    def test_px4_restart_mid_stream(self) -> None:
        """How much was sent before the restart hangs on the phase of the vehicle's loop: up to one burst."""
        vehicle = PX4Vehicle()
        recorded_messages = from_vehicle("px4_restart_mid_stream")
        sent_messages = replay(vehicle, "px4_restart_mid_stream")
        recorded, sent = param_values(recorded_messages), param_values(sent_messages)
        assert recorded[-903:] == sent[-903:]
        assert [value.param_index for value in sent[-903:]] == list(range(903))
        before, before_too = recorded[:-903], sent[:-903]
        shorter = min(len(before), len(before_too))
        assert before[:shorter] == before_too[:shorter]
        assert abs(len(before) - len(before_too)) <= 20
        assert before_too[0].param_id == wire.HASH_CHECK
        assert [value.param_id for value in sent].count(wire.HASH_CHECK) == 1
        assert stream_time(sent_messages) == pytest.approx(stream_time(recorded_messages), rel=0.1)

    def test_px4_get_set(self) -> None:
        """Including the barometer's parameters, unsaved since boot, which the first set pushes as well."""
        vehicle = PX4Vehicle(unsaved=BAROMETER)
        sent = replay(vehicle, "px4_get_set")
        recorded = param_values(from_vehicle("px4_get_set"))
        assert param_values(sent) == recorded
        assert int.from_bytes(recorded[-1].raw, "little") == vehicle.announced_hash() != PX4_HASH

    def test_ardupilot_full_download(self) -> None:
        recorded = from_vehicle("ardupilot_full_download")
        sent = replay(ArduPilotVehicle(live_period=0.0), "ardupilot_full_download")
        assert param_values(sent) == param_values(recorded)
        assert stream_time(sent) == pytest.approx(stream_time(recorded), rel=0.1)

    def test_ardupilot_get_set(self) -> None:
        """The ground pressures of two barometers are live sensor values: replayed as events with the
        recorded values."""
        recorded = from_vehicle("ardupilot_get_set")
        events: list[tuple[float, str, Value]] = [
            (time - 0.005, message.param_id, struct.unpack("<f", message.raw)[0])
            for time, message in recorded
            if isinstance(message, wire.ParamValue)
            and message.param_id in ("BARO1_GND_PRESS", "BARO2_GND_PRESS")
        ]
        assert len(events) == 2
        sent = replay(ArduPilotVehicle(live_period=0.0), "ardupilot_get_set", events)
        assert param_values(sent) == param_values(recorded)

    def test_ardupilot_ftp_download(self) -> None:
        """Both files, every block of them, and the end of each."""

        def answers(messages: list[tuple[float, wire.Message]]) -> list[tuple[float, wire.FileTransfer]]:
            return [(time, message) for time, message in messages if isinstance(message, wire.FileTransfer)]

        recorded = answers(from_vehicle("ardupilot_ftp_download"))
        sent = answers(replay(ArduPilotVehicle(live_period=0.0), "ardupilot_ftp_download"))
        assert [message for _, message in sent] == [message for _, message in recorded]
        assert len(sent) == 2 * (2 + 64 + 1 + 1)
        assert sent[66][0] - sent[2][0] == pytest.approx(recorded[66][0] - recorded[2][0], rel=0.1)

    @pytest.mark.parametrize(
        ("kind", "name"), [(PX4Vehicle, "px4_full_download"), (ArduPilotVehicle, "ardupilot_full_download")]
    )
    def test_identity_and_banner(self, kind: Callable[[], Vehicle], name: str) -> None:
        """The texts of ArduPilot's GPS driver are left out: it has nothing to do with parameters."""

        def told(messages: list[tuple[float, wire.Message]]) -> list[wire.Message]:
            return [
                message
                for _, message in messages
                if isinstance(message, wire.AutopilotVersion | wire.CommandAck)
                or (isinstance(message, wire.StatusText) and not message.text.startswith("GPS 1:"))
            ]

        recorded = from_vehicle(name)
        sent = replay(kind(), name)
        assert told(sent) == told(recorded)
        beats = [message for _, message in recorded if isinstance(message, wire.Heartbeat)]
        assert {message for _, message in sent if isinstance(message, wire.Heartbeat)} == {beats[-1]}
