"""A simulated camera with extended parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Final, TypeAlias

from paramclient.errors import ExtAckResult, UsageError
from paramclient.model.values import (
    Param,
    ParamType,
    Value,
    check_ext_value,
    check_name,
    encode_ext_value,
    ext_bytes,
    ext_param,
    parse_ext_value,
)
from paramclient.sim.param_table import Table, as_table, rows_of, typed
from paramclient.sim.vehicle import Vehicle
from paramclient.wire import frames, messages

CAMERA_COMPONENT: Final = 100
"""MAV_COMP_ID_CAMERA."""
_HEARTBEAT = messages.Heartbeat(30, messages.MAV_AUTOPILOT_INVALID, system_status=messages.MAV_STATE_ACTIVE)

ExtEntries: TypeAlias = Mapping[str, Value | tuple[ParamType | int, Value]]
"""The extended parameters of a `Camera`: values by name, where an int becomes an INT32, a float a REAL32,
text and bytes CUSTOM, and `(type, value)` gives another type."""


def camera_table() -> ExtEntries:
    """Return the extended parameters of a usual camera, every type among them."""
    rows = ((row["name"], ParamType[row["type"]], row["value"]) for row in rows_of("camera.csv"))
    return {name: (kind, parse_ext_value(name, text, kind)) for name, kind, text in rows}


@dataclass(kw_only=True, eq=False, repr=False)
class Camera(Vehicle):
    """A camera as in the MAVLink guide, "Extended Parameter Protocol".

    Requests for names and indices that it does not have are not answered, and a PARAM_EXT_SET of another type
    is refused with PARAM_ACK_FAILED, as MAVSDK's camera and parameter servers do (measured).

    Args:
        table: the extended parameters, listed in the given order; by default those of `camera_table`.
        supported: for some names, the only values that the camera supports. Others are refused with
            PARAM_ACK_VALUE_UNSUPPORTED.
        failing: names that cannot be set: PARAM_ACK_FAILED.
        slow: for some names, the seconds that a change takes. Meanwhile the camera answers every
            PARAM_EXT_SET of the name with PARAM_ACK_IN_PROGRESS, and starts no other change.
        limits: for some names, the smallest and the largest value. Others are changed to the nearest.
        plain: plain parameters; by default none.
        burst, period: see `Vehicle`, also for the extended list.

    Other arguments are those of every `Vehicle`.

    Raises:
        UsageError: an argument is invalid.
    """

    table: ExtEntries | None = field(default=None, kw_only=False)
    component: int = CAMERA_COMPONENT
    supported: Mapping[str, Collection[Value]] = field(default_factory=dict)
    failing: Iterable[str] = ()
    slow: Mapping[str, float] = field(default_factory=dict)
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    plain: Table = ()
    burst: int = 5

    def __post_init__(self) -> None:
        self._ext: dict[str, Param] = {}
        for name, entry in (camera_table() if self.table is None else self.table).items():
            self.add_ext_param(name, entry)
        self._supported = {
            name: {encode_ext_value(value, self.ext_param(name).type) for value in values}
            for name, values in self.supported.items()
        }
        self._set_up_table(
            as_table(self.plain),
            _HEARTBEAT,
            messages.AutopilotVersion(8192, uid=0xCA3E_0000 + self.system),
        )

    @property
    def ext_params(self) -> dict[str, Param]:
        """The extended parameters by name, in the order of their indices."""
        return dict(self._ext)

    @property
    def ext_values(self) -> dict[str, Value]:
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

    def set_ext_param(self, name: str, value: Value) -> None:
        """Change an extended value as if on board: no message reports it.

        Raises:
            UsageError: the camera has no extended parameter with that name, or the value does not fit its
                type.
        """
        self._change(name, encode_ext_value(value, self.ext_param(name).type))

    def add_ext_param(self, name: str, entry: Value | tuple[ParamType | int, Value]) -> None:
        """Add an extended parameter behind the others; an entry is one of `ExtEntries`.

        Raises:
            UsageError: the name or the value is invalid, or the camera has the parameter already.
        """
        if check_name(name) in self._ext:
            raise UsageError(f"this camera has an extended parameter {name!r} already")
        number, value = typed(entry)
        data = encode_ext_value(check_ext_value(value), number)
        self._ext[name] = ext_param(name, data, number, len(self._ext))

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
            if message.param_index < 0:
                self._send_ext(self._ext.get(message.param_id))
            else:
                self._send_ext(*list(self._ext.values())[message.param_index : message.param_index + 1])
        elif isinstance(message, messages.ParamExtRequestList):
            self._ext_position = 0
            self._due[self._send_ext_list] = max(self._now, self._on_at + self.boot_time)
        elif isinstance(message, messages.ParamExtSet) and message.param_id in self._ext:
            self._on_ext_set(self._ext[message.param_id], message)
        else:
            super().respond(message, sender)

    def _on_ext_set(self, known: Param, request: messages.ParamExtSet) -> None:
        name, wanted = known.name, ext_bytes(ext_param(known.name, request.raw, request.param_type))
        if name in self._at_work:
            self._send_ack(name, ExtAckResult.IN_PROGRESS)
        elif request.param_type != known.type or name in self.failing:
            self._send_ack(name, ExtAckResult.FAILED)
        elif wanted not in self._supported.get(name, (wanted,)):
            self._send_ack(name, ExtAckResult.VALUE_UNSUPPORTED)
        elif name in self.slow and wanted != ext_bytes(known):
            self._at_work[name] = (self._now + self.slow[name], wanted)
            self._sooner(self._end_work, self._now + self.slow[name])
            self._send_ack(name, ExtAckResult.IN_PROGRESS)
        else:
            self._change(name, wanted)
            self._send_ack(name, ExtAckResult.ACCEPTED)

    def _send_ack(self, name: str, result: ExtAckResult) -> None:
        param = self._ext[name]
        self.send(messages.ParamExtAck(name, ext_bytes(param), param.type, result))

    def _change(self, name: str, raw: bytes) -> None:
        known = self._ext[name]
        param = ext_param(name, raw, known.type, known.index)
        if name in self.limits and isinstance(param.value, int | float):
            low, high = self.limits[name]
            raw = encode_ext_value(type(param.value)(min(max(param.value, low), high)), known.type)
        self._ext[name] = ext_param(name, raw, known.type, known.index)

    def _send_ext(self, *params: Param | None) -> None:
        for each in filter(None, params):
            data, index = ext_bytes(each), each.index or 0
            self.send(messages.ParamExtValue(each.name, data, each.type, len(self._ext), index))

    def _switch_on(self, at: float) -> None:
        self._at_work: dict[str, tuple[float, bytes]] = {}
        """Writes that take time: when each ends, and the value that it sets."""
        self._ext_position = 0
        super()._switch_on(at)

    def _tasks(self) -> list[Callable[[float], None]]:
        return [*super()._tasks(), self._end_work, self._send_ext_list]

    def _end_work(self, at: float) -> None:
        for name, (ends_at, raw) in list(self._at_work.items()):
            if ends_at <= at:
                del self._at_work[name]
                self._change(name, raw)
                self._send_ack(name, ExtAckResult.ACCEPTED)
        self._due[self._end_work] = min((ends_at for ends_at, _ in self._at_work.values()), default=math.inf)

    def _send_ext_list(self, at: float) -> None:
        """Send one burst of the extended list."""
        start, self._ext_position = self._ext_position, self._ext_position + self.burst
        self._send_ext(*list(self._ext.values())[start : self._ext_position])
        if self._ext_position < len(self._ext):
            self._due[self._send_ext_list] = at + self.period
