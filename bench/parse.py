"""Frames per second from bytes to messages: this library compared with pymavlink's `parse_buffer`.

    python bench/parse.py [--frames N] [--seconds N]

Both parsers get the same stream in every run: 10 % PARAM_VALUE, and other messages in the proportions of a
PX4 vehicle's telemetry. Both get it in one call. pymavlink is set up as in a program without a signing key:
`MAVLink(None)` of its `common` dialect, unchanged. This library gets the ids that the client uses, and
decodes every frame. The rounds alternate, so that a machine that slows down slows both. Both must find the
same PARAM_VALUEs.
"""

from __future__ import annotations

import argparse
import gc
import random
import struct
import sys
import time
from collections.abc import Callable
from statistics import median
from typing import Any

from pymavlink.dialects.v20 import common

from paramclient.wire.frames import Framer
from paramclient.wire.messages import DECODED_IDS, ParamValue, decode

FRAMES = 30_000
ROUNDS = 7
SECONDS = 0.5
SEED = 1
PARAM_COUNT = 903

TELEMETRY = {
    "ATTITUDE": 322,
    "ATTITUDE_QUATERNION": 322,
    "ATTITUDE_TARGET": 322,
    "GLOBAL_POSITION_INT": 322,
    "LOCAL_POSITION_NED": 322,
    "POSITION_TARGET_LOCAL_NED": 322,
    "SERVO_OUTPUT_RAW": 322,
    "GPS_RAW_INT": 32,
    "VFR_HUD": 25,
    "HEARTBEAT": 14,
    "ALTITUDE": 7,
    "EXTENDED_SYS_STATE": 7,
    "MISSION_CURRENT": 7,
    "SCALED_PRESSURE": 7,
    "SYS_STATUS": 7,
    "BATTERY_STATUS": 4,
    "DISTANCE_SENSOR": 4,
    "ESTIMATOR_STATUS": 4,
    "HOME_POSITION": 4,
    "STATUSTEXT": 1,
    "VIBRATION": 1,
}
"""Approximate number of messages of a PX4 vehicle in 6.5 s: `tests/data/px4_full_download.tlog`."""

Messages = list[Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--seconds", type=float, default=SECONDS, help="of each round")
    options = parser.parse_args()
    frames, seconds = options.frames, options.seconds
    stream = build_stream(frames, random.Random(SEED))
    print(f"{frames:,} frames, {len(stream):,} bytes; {ROUNDS} rounds of {seconds} s each")

    theirs = [
        (m.param_id, struct.pack("<f", m.param_value), m.param_type, m.param_count, m.param_index)
        for m in parse_with_pymavlink(stream)
        if m.get_type() == "PARAM_VALUE"
    ]
    ours = [tuple(m) for m in parse_with_paramclient(stream) if isinstance(m, ParamValue)]
    if ours != theirs or not ours:
        sys.exit(f"the PARAM_VALUEs are not the same: pymavlink {len(theirs):,}, paramclient {len(ours):,}")
    print(f"both found the same {len(ours):,} PARAM_VALUEs\n")

    parsers = {"pymavlink": parse_with_pymavlink, "paramclient": parse_with_paramclient}
    rates: dict[str, list[float]] = {name: [] for name in parsers}
    for _ in range(ROUNDS):
        for name, parse in parsers.items():
            rates[name].append(frames * passes_per_second(parse, stream, seconds))

    print(f"{'frames per second':<20}{'median':>12}{'best':>12}")
    for name, measured in rates.items():
        print(f"{name:<20}{median(measured):>12,.0f}{max(measured):>12,.0f}")
    slow, fast = rates["pymavlink"], rates["paramclient"]
    print(f"{'ratio':<20}{median(fast) / median(slow):>12.1f}{max(fast) / max(slow):>12.1f}")


def parse_with_pymavlink(stream: bytes) -> Messages:
    messages: Messages = common.MAVLink(None).parse_buffer(stream)
    return messages


def parse_with_paramclient(stream: bytes) -> Messages:
    return [decode(frame) for frame in Framer(DECODED_IDS).receive(stream)]


def passes_per_second(parse: Callable[[bytes], Messages], stream: bytes, seconds: float) -> float:
    """Return the passes per second. Both parsers run for the same time, so that other load affects both."""
    gc.collect()
    passes = 0
    start = time.perf_counter()
    while (elapsed := time.perf_counter() - start) < seconds:
        parse(stream)
        passes += 1
    return passes / elapsed


def build_stream(frames: int, rng: random.Random) -> bytes:
    """Return unsigned MAVLink 2: every tenth frame is a PARAM_VALUE, all others have random field values."""
    kinds = {message.msgname: message for message in common.mavlink_map.values()}
    names = rng.choices(list(TELEMETRY), list(TELEMETRY.values()), k=frames)
    mav = common.MAVLink(None, 1, 1)
    parts = []
    for number, name in enumerate(names):
        mav.seq = number % 256
        if number % 10 == 0:
            index = number // 10 % PARAM_COUNT
            param_id = f"TEST_PARAM_{index}".encode()
            value = common.MAVLink_param_value_message(param_id, rng.uniform(-9, 9), 9, PARAM_COUNT, index)
            parts.append(value.pack(mav))
        else:
            kind = kinds[name]
            payload = (
                rng.randbytes(kind.unpacker.size - 1) + b"\1"
            )  # not ending with zero bytes, which MAVLink 2 truncates
            body = (
                struct.pack("<6B", len(payload), 0, 0, mav.seq, 1, 1)
                + kind.id.to_bytes(3, "little")
                + payload
            )
            checksum = common.x25crc(body + bytes((kind.crc_extra,))).crc
            parts.append(b"\xfd" + body + struct.pack("<H", checksum))
    return b"".join(parts)


if __name__ == "__main__":
    main()
