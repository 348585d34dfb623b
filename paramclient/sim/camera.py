"""A simulated camera with extended parameters."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Final, TypeAlias, Unpack

from paramclient.errors import ExtAckResult, UsageError
from paramclient.model.ext_values import check_ext_value, encode_ext_value, ext_bytes, ext_param
from paramclient.model.values import Encoding, Param, ParamType, WireValue, check_name
from paramclient.sim.generic import BytewiseVehicle
from paramclient.sim.param_table import Table, as_table
from paramclient.sim.vehicle import VehicleOptions
from paramclient.wire import frames, messages

__all__ = ["Camera", "ExtEntries", "camera_table"]

MAV_TYPE_CAMERA: Final = 30
CAMERA_COMPONENT: Final = 100
"""MAV_COMP_ID_CAMERA."""

ExtEntries: TypeAlias = Mapping[str, WireValue | tuple[ParamType | int, WireValue]]
"""The extended parameters of a `Camera`: values by name, where an int becomes an INT32, a float a REAL32,
text and bytes CUSTOM, and `(type, value)` gives another type."""


def camera_table() -> ExtEntries:
    """Return the extended parameters of a usual camera, every type among them."""
    kinds = ParamType
    return {
        "CAM_MODE": (kinds.UINT32, 1),
        "CAM_WBMODE": (kinds.UINT32, 0),
        "CAM_EXPMODE": (kinds.UINT8, 0),
        "CAM_ISO": (kinds.UINT32, 100),
        "CAM_SHUTTERSPD": (kinds.REAL32, 1 / 60),
        "CAM_EV": (kinds.REAL32, 0.0),
        "CAM_ROTATION": (kinds.INT16, -90),
        "CAM_TILT": (kinds.INT8, -15),
        "CAM_VIDRES": (kinds.UINT16, 3840),
        "CAM_STORAGE": (kinds.UINT64, 256_060_514_304),
        "CAM_CLOCK": (kinds.INT64, 1_700_000_000_123_456_789),
        "CAM_FOCAL_LEN": (kinds.REAL64, 0.0239999999999999),
        "CAM_OFFSET": (kinds.INT32, -20),
        "CAM_NAME": "Front camera",
        "CAM_STREAM_URI": "rtsp://192.168.42.1:8554/live?profile=high&bitrate=8000000",
        "CAM_LICENSE": bytes(range(1, 33)),
    }


@dataclass(slots=True)
class _Work:
    """A write that takes time: the value it sets, and when it ends."""

    raw: bytes
    ends_at: float


class Camera(BytewiseVehicle):
    """A camera as in the MAVLink guide, "Extended Parameter Protocol".

    Requests for names and indices that it does not have are not answered, and a PARAM_EXT_SET of another type
    is refused with PARAM_ACK_FAILED, as MAVSDK's camera and parameter servers do (measured).

    Args:
        table: the extended parameters, listed in the given order; by default those of `camera_table`.
        system, component: the component's ids, 1 to 255.
        supported: for some names, the only values that the camera supports. Others are refused with
            PARAM_ACK_VALUE_UNSUPPORTED.
        failing: names that cannot be set: PARAM_ACK_FAILED.
        slow: for some names, the seconds that a change takes. Meanwhile the camera answers every
            PARAM_EXT_SET of the name with PARAM_ACK_IN_PROGRESS, and starts no other change.
        limits: for some names, the smallest and the largest value. Others are changed to the nearest.
        plain: plain parameters; by default none.
        burst, period: see `Vehicle`, also for the extended list.
        options: those of every `Vehicle`.

    Raises:
        UsageError: an argument is invalid.
    """

    def __init__(
        self,
        table: ExtEntries | None = None,
        *,
        system: int = 1,
        component: int = CAMERA_COMPONENT,
        supported: Mapping[str, Collection[WireValue]] | None = None,
        failing: Iterable[str] = (),
        slow: Mapping[str, float] | None = None,
        limits: Mapping[str, tuple[float, float]] | None = None,
        plain: Table = (),
        burst: int = 5,
        period: float = 0.01,
        **options: Unpack[VehicleOptions],
    ) -> None:
        self._ext: dict[str, Param] = {}
        for index, (name, entry) in enumerate((camera_table() if table is None else table).items()):
            self._ext[check_name(name)] = _param(name, entry, index)
        self._supported = {
            name: {encode_ext_value(value, self.ext_param(name).type_number) for value in values}
            for name, values in (supported or {}).items()
        }
        self._failing = {self.ext_param(name).name for name in failing}
        self._slow = {self.ext_param(name).name: seconds for name, seconds in (slow or {}).items()}
        self._limits = {self.ext_param(name).name: limit for name, limit in (limits or {}).items()}
        self._at_work: dict[str, _Work] = {}
        self._ext_position: int | None = None
        self._ext_burst_at = math.inf
        super().__init__(
            as_table(plain),
            system=system,
            component=component,
            encoding=Encoding.BYTEWISE,
            heartbeat=messages.Heartbeat(
                MAV_TYPE_CAMERA, messages.MAV_AUTOPILOT_INVALID, system_status=messages.MAV_STATE_ACTIVE
            ),
            version=messages.AutopilotVersion(8192, uid=0xCA3E_0000 + system),
            burst=burst,
            period=period,
            **options,
        )

    @property
    def ext_params(self) -> dict[str, Param]:
        """The extended parameters by name, in the order of their indices."""
        return dict(self._ext)

    @property
    def ext_values(self) -> dict[str, WireValue]:
        """The extended values by name, like `ext_params`."""
        return {name: param.value for name, param in self._ext.items()}

    def ext_param(self, name: str) -> Param:
        """Return one extended parameter with its value on board.

        Raises:
            UsageError: the camera has no extended parameter with that name.
        """
        param = self._ext.get(name)
        if param is None:
            raise UsageError(f"this camera has no extended parameter {name!r}")
        return param

    def set_ext_param(self, name: str, value: WireValue) -> None:
        """Change an extended value as if on board: no message reports it.

        Raises:
            UsageError: the camera has no extended parameter with that name, or the value does not fit its
                type.
        """
        self._store(name, encode_ext_value(value, self.ext_param(name).type_number))

    def add_ext_param(self, name: str, entry: WireValue | tuple[ParamType | int, WireValue]) -> None:
        """Add an extended parameter behind the others; an entry is one of `ExtEntries`.

        Raises:
            UsageError: the name or the value is invalid, or the camera has the parameter already.
        """
        if check_name(name) in self._ext:
            raise UsageError(f"this camera has an extended parameter {name!r} already")
        self._ext[name] = _param(name, entry, len(self._ext))

    def remove_ext_param(self, name: str) -> None:
        """Remove an extended parameter; the indices of later ones move.

        Raises:
            UsageError: the camera has no extended parameter with that name.
        """
        del self._ext[self.ext_param(name).name]
        self._ext = {each.name: replace(each, index=index) for index, each in enumerate(self._ext.values())}

    def respond(self, message: messages.Message, sender: frames.Frame) -> None:
        """See `Device.respond`."""
        if isinstance(message, messages.ParamExtRequestRead):
            self._on_ext_read(message)
        elif isinstance(message, messages.ParamExtRequestList):
            if self._ext:
                self._ext_position = 0
                self._ext_burst_at = max(self._now, self._on_at + self._boot_time)
        elif isinstance(message, messages.ParamExtSet):
            self._on_ext_set(message)
        else:
            super().respond(message, sender)

    def _on_ext_read(self, request: messages.ParamExtRequestRead) -> None:
        found = self._ext.get(request.param_id)
        if request.param_index >= 0:
            found = next((each for each in self._ext.values() if each.index == request.param_index), None)
        if found is not None:
            self._send_ext(found)

    def _on_ext_set(self, request: messages.ParamExtSet) -> None:
        known = self._ext.get(request.param_id)
        if known is None:
            return
        wanted = ext_param(known.name, request.raw, request.param_type)
        is_supported = ext_bytes(wanted) in self._supported.get(known.name, (ext_bytes(wanted),))
        if known.name in self._at_work:
            self._acknowledge(known, ExtAckResult.IN_PROGRESS)
        elif wanted.type != known.type or known.name in self._failing:
            self._acknowledge(known, ExtAckResult.FAILED)
        elif not is_supported:
            self._acknowledge(known, ExtAckResult.VALUE_UNSUPPORTED)
        elif known.name in self._slow and ext_bytes(wanted) != ext_bytes(known):
            self._at_work[known.name] = _Work(ext_bytes(wanted), self._now + self._slow[known.name])
            self._acknowledge(known, ExtAckResult.IN_PROGRESS)
        else:
            self._acknowledge(self._store(known.name, ext_bytes(wanted)), ExtAckResult.ACCEPTED)

    def _acknowledge(self, param: Param, result: ExtAckResult) -> None:
        self.send(messages.ParamExtAck(param.name, ext_bytes(param), param.type_number, result))

    def _store(self, name: str, raw: bytes) -> Param:
        known = self._ext[name]
        param = ext_param(name, raw, known.type_number, known.index)
        if name in self._limits and isinstance(param.value, int | float):
            low, high = self._limits[name]
            value = type(param.value)(min(max(param.value, low), high))
            param = ext_param(
                name, encode_ext_value(value, known.type_number), known.type_number, known.index
            )
        self._ext[name] = param
        return param

    def _send_ext(self, param: Param) -> None:
        index = 0 if param.index is None else param.index
        self.send(
            messages.ParamExtValue(param.name, ext_bytes(param), param.type_number, len(self._ext), index)
        )

    def _switch_on(self, at: float) -> None:
        self._at_work.clear()
        self._ext_position = None
        self._ext_burst_at = math.inf
        super()._switch_on(at)

    def _timers(self) -> tuple[float, ...]:
        return (*super()._timers(), *(work.ends_at for work in self._at_work.values()))

    def _next_transmission(self) -> float:
        return min(super()._next_transmission(), self._ext_burst_at)

    def _skip_suppressed(self) -> None:
        super()._skip_suppressed()
        self._ext_burst_at = max(self._now, self._ext_burst_at)

    def _work(self, now: float) -> None:
        super()._work(now)
        for name, work in list(self._at_work.items()):
            if work.ends_at <= now:
                del self._at_work[name]
                self._acknowledge(self._store(name, work.raw), ExtAckResult.ACCEPTED)
        if self._high_latency:
            return
        while self._ext_burst_at <= now:
            self._ext_burst_at += self._period
            for _ in range(self._burst):
                self._send_next_ext()

    def _send_next_ext(self) -> None:
        """Send the next value of the extended list, or end the list."""
        position = self._ext_position
        entries = list(self._ext.values())
        if position is None or position >= len(entries):
            self._ext_position = None
            self._ext_burst_at = math.inf
            return
        self._ext_position = position + 1
        self._send_ext(entries[position])


def _param(name: str, entry: WireValue | tuple[ParamType | int, WireValue], index: int) -> Param:
    if isinstance(entry, tuple):
        number, value = entry
    else:
        value = check_ext_value(entry)
        kinds = ParamType
        number = kinds.INT32 if isinstance(value, int) else kinds.CUSTOM
        number = kinds.REAL32 if isinstance(value, float) else number
    return ext_param(name, encode_ext_value(value, number), number, index)
