"""A simulated component that follows the MAVLink standard."""

from __future__ import annotations

from typing import Unpack

from paramclient.errors import ParamErrorCode
from paramclient.model.values import Encoding, ParamType
from paramclient.sim.param_table import Entry, Table, as_table
from paramclient.sim.vehicle import Vehicle, VehicleOptions
from paramclient.wire import frames, messages

__all__ = ["BytewiseVehicle", "GenericVehicle"]


class BytewiseVehicle(Vehicle):
    """Common base of PX4 and the standard component: byte-wise values, immediate responses."""

    def _on_list(self) -> None:
        self._start_list(self._now)

    def _on_read(self, request: messages.ParamRequestRead, sender: frames.Frame) -> None:
        entry = self._requested_entry(request)
        if entry is None:
            self._refuse(ParamErrorCode.DOES_NOT_EXIST, request, sender)
        elif not self._is_dead(entry):
            self._send_value(entry)

    def _on_set(self, request: messages.ParamSet, sender: frames.Frame) -> None:
        entry = self._find(request.param_id)
        if entry is None:
            self._refuse(ParamErrorCode.DOES_NOT_EXIST, request, sender)
        elif entry.type != request.param_type:
            self._on_wrong_type(entry, request, sender)
        else:
            size = entry.type.size if isinstance(entry.type, ParamType) else 4
            self._write(entry, int.from_bytes(request.raw[:size], "little"))
            self._send_value(entry)

    def _on_wrong_type(self, entry: Entry, request: messages.ParamSet, sender: frames.Frame) -> None:
        if self._param_error:
            self._refuse(ParamErrorCode.TYPE_MISMATCH, request, sender)
        else:
            self._send_value(entry)

    def _requested_entry(self, request: messages.ParamRequestRead) -> Entry | None:
        if request.param_index < 0:
            return self._find(request.param_id)
        return self._by_index(request.param_index)

    def _write(self, entry: Entry, bits: int) -> None:
        entry.store(bits)


class GenericVehicle(BytewiseVehicle):
    """A component as in the MAVLink guide: byte-wise, all types, no hash, immediate responses.

    A set with another type changes nothing; the response is the current value or, with `param_error`,
    PARAM_ERROR. Of a 64-bit type, the lower four bytes are sent.

    Args:
        table: the parameters (see `Table`), listed in the given order.
        system, component: the component's ids, 1 to 255.
        uid: the reported hardware id; by default unique for every system.
        autopilot: MAV_AUTOPILOT in the heartbeat.
        capabilities: as in AUTOPILOT_VERSION; by default MAVLink 2 and byte-wise parameters.
        burst, period: see `Vehicle`.
        options: those of every `Vehicle`.

    Raises:
        UsageError: an argument is invalid.
    """

    def __init__(
        self,
        table: Table,
        *,
        system: int = 1,
        component: int = 1,
        uid: int | None = None,
        autopilot: int = messages.MAV_AUTOPILOT_GENERIC,
        capabilities: int = 8192 | messages.CAPABILITY_PARAM_ENCODE_BYTEWISE,
        burst: int = 10,
        period: float = 0.01,
        **options: Unpack[VehicleOptions],
    ) -> None:
        super().__init__(
            as_table(table),
            system=system,
            component=component,
            encoding=Encoding.BYTEWISE,
            heartbeat=messages.Heartbeat(0, autopilot, system_status=messages.MAV_STATE_ACTIVE),
            version=messages.AutopilotVersion(capabilities, uid=0x5EED_0000 + system if uid is None else uid),
            burst=burst,
            period=period,
            **options,
        )
