"""Writer of telemetry logs: a vehicle and a ground station."""

from __future__ import annotations

from pathlib import Path
from typing import Self

from paramclient.links.tlog import packed_time
from paramclient.model.values import Encoding, ParamType, encode_value
from paramclient.wire import messages

NOW = 1_700_000_000.0
UID = "00000000deadbeef"
KEY = f"uid:{UID}"


class Log:
    """Writes a log of a vehicle with a table of INT32, and of a ground station.

    Attributes:
        at: the time of the next frame.
    """

    def __init__(self, at: float = NOW) -> None:
        self.at = at
        self.values: dict[str, int] = {}
        self.data = b""

    def say(self, *sent: messages.Message, system: int = 1, component: int = 1) -> Self:
        for message in sent:
            self.data += packed_time(self.at) + messages.encode(
                message, system=system, component=component, sequence=0
            )
        return self

    def beat(self) -> Self:
        return self.say(messages.Heartbeat(2, messages.MAV_AUTOPILOT_GENERIC, system_status=4))

    def identify(self) -> Self:
        return self.say(messages.AutopilotVersion(0, uid=0xDEADBEEF, flight_sw_version=7))

    def wait(self, seconds: float) -> Self:
        self.at += seconds
        return self

    def list(self, **values: int) -> Self:
        self.values |= values
        for index, name in enumerate(self.values):
            self.report(name, index)
        return self

    def report(self, name: str, index: int = 65535, **values: int) -> Self:
        self.values |= values
        raw = encode_value(self.values[name], ParamType.INT32, Encoding.BYTEWISE)
        return self.say(messages.ParamValue(name, raw, ParamType.INT32, len(self.values), index))

    def change(self, name: str, value: int) -> Self:
        return self.report(name, **{name: value})

    def set(self, name: str, value: int) -> Self:
        raw = encode_value(value, ParamType.INT32, Encoding.BYTEWISE)
        self.say(messages.ParamSet(1, 1, name, raw, ParamType.INT32), system=255, component=190)
        return self.change(name, value)

    def write(self, path: Path) -> Path:
        path.write_bytes(self.data)
        return path
