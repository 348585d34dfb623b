"""Recordings of real autopilots: decoded, and compared with the simulated ones."""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Callable

import pytest

from paramclient.model.values import Encoding, ParamType, Value, decode_value, encode_value, from_bits
from paramclient.protocol import param_pck
from paramclient.protocol.ftp import Opcode, Packet
from paramclient.sim import ArduPilotVehicle, PX4Vehicle, SimParam, Vehicle, ardupilot_table, px4_table
from paramclient.wire import messages
from tests.recordings import (
    NAMES,
    Messages,
    differences,
    from_ground,
    from_vehicle,
    last_list,
    param_values,
    replay,
)

PX4_HASH = 0xCF579589
BAROMETER = ("CAL_BARO0_ID", "CAL_BARO0_OFF", "CAL_BARO0_PRIO")
"""Parameters that the recorded PX4 sets during boot, and saves only after the first change by a user."""


# Messages that a replay leaves out

OTHER_TEXTS = ("GPS 1:", "EKF", "Field Elevation", "[logger]")
"""Prefixes of texts that other parts of the firmware send; parameter clients ignore them."""
UNASKED = (
    *("STAT_RUNTIME", "BARO1_GND_PRESS", "BARO2_GND_PRESS"),
    *("CAL_BARO0_ID", "CAL_BARO0_OFF", "CAL_BARO0_PRIO"),
)
"""Values that the firmware changes and announces on its own; only those in a list are compared."""


COMMITS = {b"fbb78585": b"5eed5eed", bytes.fromhex("0000009383550aa7"): bytes.fromhex("ed5eed5eed5eed5e")}
"""The commits of the recorded autopilots, and those that the simulated ones report instead."""


def compared(recorded: Messages) -> Messages:
    """Return the messages that a replay must reproduce, without unsolicited values.

    The first 3 s after a start PX4's heartbeat has the state 0; the simulated one has been on for longer.
    Recorded commits are replaced with the simulated ones.
    """
    kept: Messages = []
    for time, message in recorded:
        if isinstance(message, messages.StatusText) and message.text.startswith(OTHER_TEXTS):
            continue
        if isinstance(message, messages.Heartbeat) and message.system_status == 0:
            message = dataclasses.replace(message, system_status=3)
        if isinstance(message, messages.AutopilotVersion):
            message = dataclasses.replace(message, git_hash=COMMITS.get(message.git_hash, message.git_hash))
        kept.append((time, message))
    return kept


# Values of the recorded vehicles that differ from the packaged tables


def px4_of(name: str) -> PX4Vehicle:
    """Return a PX4 with the parameters of a list: its logger uses five more, none of them volatile."""
    volatile = {row.name for row in px4_table() if row.volatile}
    rows = []
    for value in last_list(name):
        number, _ = decode_value(value.raw, value.param_type, Encoding.BYTEWISE)
        rows.append(SimParam(value.param_id, value.param_type, number, value.param_id in volatile))
    return PX4Vehicle(table=rows)


def ardupilot_of(name: str) -> ArduPilotVehicle:
    """Return an ArduPilot with the values of a list."""
    vehicle = ArduPilotVehicle(live_period=0.0)
    for value in last_list(name):
        take(vehicle, value)
    return vehicle


def take(vehicle: ArduPilotVehicle, value: messages.ParamValue) -> None:
    """Store a received value, if it differs."""
    param = vehicle.param(value.param_id)
    if encode_value(param.value, param.type, Encoding.C_CAST) != value.raw:
        (number,) = struct.unpack("<f", value.raw)
        vehicle.set_param(value.param_id, number if param.type == ParamType.REAL32 else int(number))


def ardupilot_of_file(name: str) -> ArduPilotVehicle:
    """Return an ArduPilot with the values and defaults of a file in the log."""
    blocks = {}
    for _, message in from_vehicle(name):
        if isinstance(message, messages.FileTransfer):
            packet = Packet.unpack(message.payload)
            if packet.requested == Opcode.BURST_READ_FILE and packet.opcode == Opcode.ACK:
                blocks[packet.offset] = packet.data
    shipped = {row.name: row for row in ardupilot_table()}
    rows = []
    for entry in param_pck.decode(b"".join(blocks[at] for at in sorted(blocks))).entries:
        value = from_bits(entry.bits, entry.type)
        default = value if entry.default is None else from_bits(entry.default, entry.type)
        assert isinstance(default, int | float)
        is_shipped = shipped[entry.name].bits == entry.bits
        rows.append(
            shipped[entry.name] if is_shipped else SimParam(entry.name, entry.type, value, default=default)
        )
    return ArduPilotVehicle(table=rows, live_period=0.0)


def with_groups(name: str) -> ArduPilotVehicle:
    """Return an ArduPilot before two groups are shown, with parameters that the packaged table lacks."""
    shipped = {row.name for row in ardupilot_table()}
    groups: dict[str, list[SimParam]] = {"GRIP_ENABLE": [], "SCR_ENABLE": []}
    for value in last_list(name):
        if value.param_id not in shipped:
            (number,) = struct.unpack("<f", value.raw)
            kind = ParamType(value.param_type)
            group = groups[f"{value.param_id.split('_')[0]}_ENABLE"]
            group.append(SimParam(value.param_id, kind, number if kind == ParamType.REAL32 else int(number)))
    vehicle = ArduPilotVehicle(live_period=0.0, groups=groups)
    for value in last_list(name):
        if not value.param_id.endswith("_ENABLE"):
            take(vehicle, value)
    return vehicle


def without_pushes(name: str, recorded: Messages, start: float) -> Messages:
    """Leave out PARAM_VALUEs after a time, except the first one after a set of its name."""
    sets = [record.message for record in from_ground(name) if record.time >= start]
    awaited = {message.param_id for message in sets if isinstance(message, messages.ParamSet)}
    kept: Messages = []
    for time, message in recorded:
        if isinstance(message, messages.ParamValue) and time >= start:
            if message.param_id not in awaited:
                continue
            awaited.remove(message.param_id)
        kept.append((time, message))
    return kept


def quiet(_: str) -> ArduPilotVehicle:
    return ArduPilotVehicle(live_period=0.0)


def px4(_: str) -> PX4Vehicle:
    return PX4Vehicle()


ARDUPILOT: dict[str, tuple[Callable[[str], Vehicle], float]] = {
    "ardupilot_30_sets": (quiet, 0.9968),
    "ardupilot_checksums": (ardupilot_of, 0.9970),
    "ardupilot_enable_groups": (with_groups, 0.0019),
    "ardupilot_ftp_closed_by_others": (ardupilot_of_file, 0.9971),
    "ardupilot_ftp_session_left_open": (ardupilot_of_file, 0.0030),
    "ardupilot_ftp_three_downloads": (ardupilot_of_file, 0.0030),
    "ardupilot_full_download": (quiet, 0.0041),
    "ardupilot_list_beside_100_reads": (ardupilot_of, 0.0010),
    "ardupilot_list_beside_50_reads": (ardupilot_of, 0.0022),
    "ardupilot_list_beside_ftp": (ardupilot_of_file, 0.0010),
    "ardupilot_list_restarted": (ardupilot_of, 0.0080),
}
"""Recordings with their vehicle, and the phase of its loop."""

PX4: dict[str, tuple[Callable[[str], Vehicle], float]] = {
    "px4_hash_hit_and_stop": (px4, 0.7681),
    "px4_list_beside_reads": (px4_of, 0.0074),
    "px4_list_restarted": (px4_of, 0.0124),
    "px4_restart_mid_stream": (px4, 0.7770),
}


# The same messages, in the same order, at the same times; see `tests.recordings` for tolerances.


def test_every_recording_is_replayed() -> None:
    alone = {name for name in NAMES if f"test_{name}" in globals()}
    assert set(NAMES) == set(ARDUPILOT) | set(PX4) | alone


@pytest.mark.parametrize("name", [*ARDUPILOT, *PX4])
def test_a_recording_of_a_quiet_vehicle_is_replayed(name: str) -> None:
    make, phase = (ARDUPILOT | PX4)[name]
    recorded, sent = compared(from_vehicle(name)), compared(replay(make(name), name, phase=phase))
    assert differences(name, recorded, sent, burst=10 if name in ARDUPILOT else 20, unasked=UNASKED) == []


def test_px4_full_download() -> None:
    """The barometer, found 1.4 s into the log and sent unsolicited, is replayed as an event."""
    name = "px4_full_download"
    vehicle = PX4Vehicle()
    found = [vehicle.param(each) for each in BAROMETER]
    for param in found:
        vehicle.set_param(param.name, -1)
    sent = replay(vehicle, name, phase=0.19, on_board=[(1.4147, each.name, each.value) for each in found])
    assert differences(name, compared(from_vehicle(name)), compared(sent), burst=20) == []


def test_px4_get_set() -> None:
    """Including the barometer's parameters, unsaved since boot, which the first set pushes as well."""
    name = "px4_get_set"
    vehicle = PX4Vehicle(unsaved=BAROMETER)
    recorded = compared(from_vehicle(name))
    assert differences(name, recorded, compared(replay(vehicle, name, phase=0.004)), burst=20) == []
    assert int.from_bytes(param_values(recorded)[-1].raw, "little") == vehicle.announced_hash() != PX4_HASH


def test_px4_20_sets() -> None:
    """From 3.34 s on, the real vehicle pushes no set again. Pushes of sets in quick succession are
    missing at random, so only the acknowledgements are compared there."""
    name = "px4_20_sets"
    recorded = without_pushes(name, compared(from_vehicle(name)), 3.34)
    sent = without_pushes(name, compared(replay(px4_of("px4_list_beside_reads"), name, phase=0.0095)), 3.34)
    assert differences(name, recorded, sent, burst=20, unasked=UNASKED) == []


def test_ardupilot_get_set() -> None:
    """The ground pressures of two barometers are live sensor values: replayed as events with the
    recorded values."""
    name = "ardupilot_get_set"
    recorded = compared(from_vehicle(name))
    events: list[tuple[float, str, Value]] = [
        (time - 0.005, message.param_id, struct.unpack("<f", message.raw)[0])
        for time, message in recorded
        if isinstance(message, messages.ParamValue)
        and message.param_id in ("BARO1_GND_PRESS", "BARO2_GND_PRESS")
    ]
    assert len(events) == 2
    sent = compared(replay(ArduPilotVehicle(live_period=0.0), name, phase=0.005, on_board=events))
    assert differences(name, recorded, sent, burst=10) == []


def test_ardupilot_ftp_download() -> None:
    """Both files, with every block, and the end of each."""
    name = "ardupilot_ftp_download"
    recorded = compared(from_vehicle(name))
    sent = compared(replay(ArduPilotVehicle(live_period=0.0), name, phase=0.003))
    assert differences(name, recorded, sent, burst=10) == []
    answers = [message for _, message in sent if isinstance(message, messages.FileTransfer)]
    assert len(answers) == 2 * (2 + 64 + 1 + 1)
