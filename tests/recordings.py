"""Reader and comparison of the telemetry logs in tests/data: both directions of real sessions, frame by
frame.

`replay` sends a simulated vehicle the ground station's frames of a log at the recorded times. `differences`
returns the differences between the vehicle's messages and the recorded ones, by these rules:

Series: Each message belongs to one series: the values of a list; the other PARAM_VALUEs of each name (index
65535) or index; the responses of MAVFTP; the texts of the banner; each further message type. A value belongs
to the list if its index is one more than that of the list's last value, or 0 after another list request.

Order: A series has the same messages in the same order. Two messages of different series that were recorded
more than 50 ms apart are in the same order, within the tolerance of the phase.

Time: The time from a request to each message is that of the log, within 20 ms or 20 %, whichever is larger.
The request of a list's value is the PARAM_REQUEST_LIST that started its pass; of another PARAM_VALUE, the
latest read or set of that parameter; of a response of MAVFTP, the latest request of that kind with a lower
number, which for each block of a burst is the burst's request; of the banner, the latest request for the list
or for a file; of other messages, the latest command. Heartbeats have no request: their spacing is that of the
log within 20 %.

Phase: A log does not contain the phase of the vehicle's loop at which a request arrived. Each replay
therefore states the phase of the loop, and a value of a list may be in the burst before or after (10 values
of ArduPilot, 20 of PX4), a block of a file up to two blocks earlier or later. A pass of a list that another
request ends may have as many values more or less.
"""

from __future__ import annotations

import math
import re
import struct
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Collection, Iterable
from functools import cache
from heapq import heappop, heappush
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple, TypeAlias

from paramclient.model.identity import Identity, commit_text, hardware_id
from paramclient.model.values import Value
from paramclient.protocol.ftp import Opcode, Packet
from paramclient.sim import Vehicle
from paramclient.wire import frames, messages

Messages: TypeAlias = list[tuple[float, messages.Message]]
"""Messages, each with the time since the log's first frame in seconds."""

DATA = Path(__file__).parent / "data"
NAMES = tuple(sorted(path.stem for path in DATA.glob("*.tlog")))
GROUND_STATION = 255


class Record(NamedTuple):
    """One frame of a log.

    Attributes:
        time: seconds since the first frame of the log.
        data: the frame as on the wire.
        system: the sender's system id.
        frame: the frame with a valid checksum; None for a message that the dialect does not define.
    """

    time: float
    data: bytes
    system: int
    frame: frames.Frame | None

    @property
    def message(self) -> messages.Message | None:
        return None if self.frame is None else messages.decode(self.frame)


@cache
def read(name: str) -> tuple[Record, ...]:
    """Return all frames of `tests/data/{name}.tlog`: 8 bytes of time (big-endian µs) before each frame."""
    content = (DATA / f"{name}.tlog").read_bytes()
    framer = frames.Framer(stream=False)
    records: list[Record] = []
    at = 0
    start = None
    while at < len(content):
        (time,) = struct.unpack_from(">Q", content, at)
        at += 8
        start = time if start is None else start
        if content[at] == 0xFD:
            length = 12 + content[at + 1] + (13 if content[at + 2] & 1 else 0)
            system = content[at + 5]
        else:
            length = 8 + content[at + 1]
            system = content[at + 3]
        data = content[at : at + length]
        at += length
        found = framer.receive(data)
        records.append(Record((time - start) / 1e6, data, system, found[0] if found else None))
    return tuple(records)


def identity_in(name: str, autopilot: int) -> Identity:
    """Return the identity of the vehicle of a log, as the client makes it of AUTOPILOT_VERSION."""
    version = next(
        message for _, message in from_vehicle(name) if isinstance(message, messages.AutopilotVersion)
    )
    return Identity(
        system=1,
        link="udpin:0.0.0.0:14550",
        uid=hardware_id(version.uid, version.uid2),
        autopilot=autopilot,
        vehicle_type=2,
        firmware=version.flight_sw_version,
        git_hash=commit_text(version.git_hash),
        board=version.board_version,
        vendor_id=version.vendor_id,
        product_id=version.product_id,
        capabilities=version.capabilities,
    )


def from_ground(name: str) -> list[Record]:
    """Return the frames of the ground station."""
    return [record for record in read(name) if record.system == GROUND_STATION]


def from_vehicle(name: str) -> Messages:
    """Return the vehicle's messages that `wire` decodes, with their times."""
    return [
        (record.time, message)
        for record in read(name)
        if record.system != GROUND_STATION and (message := record.message) is not None
    ]


def param_values(items: Iterable[tuple[float, messages.Message]]) -> list[messages.ParamValue]:
    """Return the PARAM_VALUEs among the messages, in order."""
    return [message for _, message in items if isinstance(message, messages.ParamValue)]


def replay(
    vehicle: Vehicle, name: str, *, phase: float = 0.0, on_board: Iterable[tuple[float, str, Value]] = ()
) -> Messages:
    """Send the vehicle the ground station's frames of a log; return its messages that `wire` decodes.

    Args:
        phase: seconds into the log at which the vehicle's heartbeats, and with them the slots of ArduPilot,
            are due. The vehicle has then been on for a second.
        on_board: changes on board: time, parameter, and new value.
    """
    inputs: list[tuple[float, bytes | tuple[str, Value]]] = [
        *((record.time, record.data) for record in from_ground(name)),
        *((time, (param, value)) for time, param, value in on_board),
        (read(name)[-1].time + 0.05, b""),
    ]
    framer = frames.Framer(stream=False)
    sent: Messages = []

    def collect(now: float) -> None:
        for data in vehicle.data_to_send():
            (frame,) = framer.receive(data)
            if (message := messages.decode(frame)) is not None:
                sent.append((now, message))

    vehicle.tick(phase - 1.0)
    collect(phase - 1.0)
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
    return [(time, message) for time, message in sent if time >= 0.0]


def differences(
    name: str, recorded: Messages, sent: Messages, *, burst: int, unasked: Collection[str] = ()
) -> list[str]:
    """Return the differences between a replay and the log by the rules above; an empty list if there are
    none.

    Args:
        burst: values of a list that the vehicle sends in one burst.
        unrequested: parameters whose values outside lists are left out.
    """
    expected, actual = _series(name, recorded, unasked), _series(name, sent, unasked)
    if len(_passes(expected["list"])) != len(_passes(actual["list"])):
        return [
            f"{len(_passes(expected['list']))} passes of a list recorded, {len(_passes(actual['list']))} sent"
        ]
    found = _beats(expected.pop("Heartbeat", []), actual.pop("Heartbeat", []))
    pairs = []
    requested = requests_in(name)
    for key in sorted(expected.keys() | actual.keys()):
        parts = [(expected[key], actual[key])]
        if key == "list":
            parts = list(zip(_passes(expected[key]), _passes(actual[key]), strict=True))
        slack = {"list": burst, "FileTransfer": 2}.get(key, 0)
        for number, (one, other) in enumerate(parts):
            if number < len(parts) - 1 and abs(len(one) - len(other)) <= burst:
                shorter = min(len(one), len(other))
                one, other = one[:shorter], other[:shorter]
            if [message for _, message in one] != [message for _, message in other]:
                found.append(f"{key}: other messages: {len(one)} recorded, {len(other)} sent")
                continue
            requests = [_request_of(one[0] if key == "list" else each, requested) for each in one]
            for at, (time, message) in enumerate(other):
                allowed = max(0.02, 0.2 * (one[at][0] - requests[at]))
                first = max(at - slack, requests.index(requests[at]))
                last = min(at + slack, bisect_right(requests, requests[at]) - 1)
                pair = _Pair(one[first][0], one[last][0], time)
                pairs.append(pair)
                if not pair.first - allowed <= time <= pair.last + allowed:
                    found.append(f"{key}: recorded at {one[at][0]:.4f}, sent at {time:.4f}: {message}")
    return found + _order(pairs)


def last_list(name: str) -> list[messages.ParamValue]:
    """Return the values of the last list of a log, in order."""
    return param_values(_passes(_series(name, from_vehicle(name), ())["list"])[-1])


class _Pair(NamedTuple):
    """The earliest and latest time that the phase allows for a message, and its time in the replay."""

    first: float
    last: float
    sent: float


def _series(name: str, log: Messages, unasked: Collection[str]) -> defaultdict[str, Messages]:
    """Return the messages by series; index 0 starts a pass if a list was requested since the last pass."""
    lists = [time for time, request in requests_in(name) if isinstance(request, messages.ParamRequestList)]
    series: defaultdict[str, Messages] = defaultdict(list)
    last, passes = None, 0
    for time, message in log:
        key = type(message).__name__
        if isinstance(message, messages.ParamValue):
            index = message.param_index
            key = f"value {message.param_id.upper() if index == messages.NO_INDEX else index}"
            is_first = index == 0 and passes < sum(requested <= time for requested in lists)
            if is_first or (last is not None and index == last + 1):
                key, last = "list", index
                passes += is_first
            elif message.param_id in unasked:
                continue
        elif isinstance(message, messages.StatusText):
            message = messages.StatusText(message.severity, re.sub(r"\([0-9a-f]{8}\)", "(crc)", message.text))
        series[key].append((time, message))
    return series


def _passes(values: Messages) -> list[Messages]:
    passes: list[Messages] = []
    for time, message in values:
        assert isinstance(message, messages.ParamValue)
        if message.param_index == 0:
            passes.append([])
        passes[-1].append((time, message))
    return passes


def requests_in(name: str) -> Messages:
    """Return the requests of the ground station."""
    return [(record.time, message) for record in from_ground(name) if (message := record.message) is not None]


def _request_of(answer: tuple[float, messages.Message], requests: Messages) -> float:
    """Return the time of the request that a message answers; without a request, the message's own time."""
    received, message = answer
    times = [time for time, request in requests if time <= received and answers(message, request)]
    return max(times, default=received)


def answers(message: messages.Message, request: messages.Message) -> bool:
    match request:
        case messages.ParamRequestList():
            return isinstance(message, messages.StatusText) or (
                isinstance(message, messages.ParamValue) and message.param_index in (0, messages.NO_INDEX)
            )
        case messages.ParamRequestRead(param_index=index) if index >= 0:
            return isinstance(message, messages.ParamValue) and message.param_index == index
        case messages.ParamRequestRead(param_id=wanted) | messages.ParamSet(param_id=wanted):
            return isinstance(message, messages.ParamValue) and message.param_id.upper() == wanted.upper()
        case messages.FileTransfer():
            packet = Packet.unpack(request.payload)
            if isinstance(message, messages.StatusText):
                return packet.opcode == Opcode.OPEN_FILE_RO
            if not isinstance(message, messages.FileTransfer):
                return False
            answer = Packet.unpack(message.payload)
            return answer.requested == packet.opcode and answer.sequence > packet.sequence
        case messages.CommandLong():
            return isinstance(message, messages.CommandAck | messages.AutopilotVersion)
    return False


def _beats(recorded: Messages, sent: Messages) -> list[str]:
    found = []
    if {message for _, message in recorded} != {message for _, message in sent}:
        found.append("Heartbeat: other messages")
    spacings = [[then - now for (now, _), (then, _) in pairwise(each)] for each in (recorded, sent)]
    for one, other in zip(*spacings, strict=False):
        if not math.isclose(one, other, rel_tol=0.2):
            found.append(f"Heartbeat: {one:.3f} s apart, sent {other:.3f} s apart")
    return found if abs(len(recorded) - len(sent)) <= 1 else [*found, "Heartbeat: another number of them"]


def _order(pairs: list[_Pair]) -> list[str]:
    """Return messages in another order, though they were recorded far from each other."""
    found = []
    near: list[tuple[float, float]] = []
    ahead = -math.inf  # the replay time of the last message that was recorded long before
    for pair in sorted(pairs):
        while near and near[0][0] < pair.first - 0.05:
            ahead = max(ahead, heappop(near)[1])
        if pair.sent < ahead:
            found.append(f"recorded from {pair.first:.4f} on, sent at {pair.sent:.4f}, before an earlier one")
        heappush(near, (pair.last, pair.sent))
    return found
