"""What every simulated vehicle has in common: a table, a list that is sent in bursts, identity, heartbeat."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from typing import TypedDict

from paramclient.errors import ParamErrorCode, UsageError
from paramclient.model.values import Encoding, Param, Value, bits_of
from paramclient.protocol import wire
from paramclient.protocol.ftp.param_pck import PackedParam
from paramclient.sim.device import Device
from paramclient.sim.ftp import FileServer
from paramclient.sim.param_table import Entry, SimParam

__all__ = ["Vehicle", "VehicleOptions"]


class VehicleOptions(TypedDict, total=False):
    """What every kind of vehicle takes beside its own arguments; `Vehicle` says what each is."""

    boot_time: float
    param_error: bool
    telemetry: float
    mavlink_version: int
    stream: bool
    dead: Iterable[int | str]
    list_stops_at: int | None
    list_stops: float
    repeated_names: bool
    high_latency: bool
    signing_key: wire.SigningKey | None
    signing_timestamp: int
    usb: bool
    armed: bool
    reboot_ack: bool
    reboot_down: float


class Vehicle(Device):
    """A simulated component that speaks the parameter protocol in bytes; an `Endpoint`.

    It does no input or output and reads no clock. What it is asked at `now` it answers in its own time;
    `next_deadline` says when. The first call of `tick` or `receive` switches it on.

    Attributes:
        system, component: its own ids.
        armed: whether its heartbeat says so; it does not start again then. Can be set in flight.
        requests: how many messages of each kind were received that were for this vehicle, by their MAVLink
            names (`requests["PARAM_REQUEST_READ"]`).

    Args of every vehicle:
        burst, period: parameters in one go of the list, and the seconds from one go to the next.
        boot_time: seconds from switching on in which it does not yet send its list; its heartbeat says
            MAV_STATE_BOOT meanwhile.
        param_error: answer what cannot be done with PARAM_ERROR, as newer firmware does.
        telemetry: other messages per second (ATTITUDE), which a client has to step over.
        mavlink_version: 2, or 1 to speak like an old vehicle.
        stream: whether it hangs on a byte stream, where a frame may be spread over several `receive`
            calls; datagrams are never joined.
        dead: indices, and names, that the list leaves out and no read is answered for. They still count,
            and a set of them is answered.
        list_stops_at: after how many values a list falls silent; None for never. It is over then: one that
            is asked for again begins at its start.
        list_stops: how many lists that happens to; `math.inf` for all.
        repeated_names: whether a name may stand in the table more than once, as it does where names are cut
            at 16 bytes. Each has its index; by name the first is meant.
        high_latency, armed: see the attributes.
        reboot_ack: whether it acknowledges the command to start again before it does.
        reboot_down: seconds for which it is off then.
        signing_key: with which it signs what it sends; it takes only frames signed with it, and RADIO_STATUS.
            None: neither, until SETUP_SIGNING brings a key. Of a sender's frames it takes those with a
            rising timestamp, from at most 16 senders and links, until it is switched off.
        signing_timestamp: where its timestamps begin; it has no other clock. They go on from those it hears.
        usb: whether the link counts as safe: it takes whatever comes, as ArduPilot does over USB.
    """

    _ftp: FileServer | None = None
    _position: int | None  # where the list stands, None while it is not being sent
    _last_listed: Entry | None  # what it sent last
    _list_sent: int  # values since its start
    _next_burst: float

    def __init__(
        self,
        table: Iterable[SimParam],
        *,
        system: int,
        component: int,
        encoding: Encoding,
        heartbeat: wire.Heartbeat,
        version: wire.AutopilotVersion,
        burst: int,
        period: float,
        boot_time: float = 0.0,
        param_error: bool = False,
        telemetry: float = 0.0,
        mavlink_version: int = 2,
        stream: bool = False,
        dead: Iterable[int | str] = (),
        list_stops_at: int | None = None,
        list_stops: float = 1,
        repeated_names: bool = False,
        high_latency: bool = False,
        signing_key: wire.SigningKey | None = None,
        signing_timestamp: int = 0,
        usb: bool = False,
        armed: bool = False,
        reboot_ack: bool = True,
        reboot_down: float = 1.0,
    ) -> None:
        rows = tuple(table)
        if not repeated_names and len({row.name for row in rows}) < len(rows):
            raise UsageError("a parameter name stands twice in the table")
        if len(rows) > _LONGEST:
            raise UsageError(f"a table holds at most {_LONGEST} parameters, not {len(rows)}")
        if param_error and mavlink_version == 1:
            raise UsageError("PARAM_ERROR does not exist in MAVLink 1")
        if burst < 1 or not (math.isfinite(period) and period > 0.0):
            raise UsageError("burst is a number from 1 up, and period a number of seconds above 0")
        if list_stops_at is not None and list_stops_at < 0:
            raise UsageError(f"list_stops_at is a number of values from 0 up, not {list_stops_at}")
        if not list_stops >= 0:
            raise UsageError(f"list_stops is a number of lists from 0 up, not {list_stops}")
        self._entries = [Entry(row, order, encoding) for order, row in enumerate(rows)]
        self._by_name = {self._key(entry.name): entry for entry in reversed(self._entries)}
        self._listed: list[Entry] = []
        self._dead: set[int | str] = set()
        for each in dead:
            if isinstance(each, int) and not 0 <= each < _LONGEST:
                raise UsageError(f"an index is a number from 0 to {_LONGEST - 1}, not {each}")
            self._dead.add(self._entry(each).name if isinstance(each, str) else each)
        self._list_stops_at = math.inf if list_stops_at is None else list_stops_at
        self._list_stops = list_stops
        self._when_listed: dict[int, list[Callable[[], object]]] = {}
        self._burst = burst
        self._period = period
        self._param_error = param_error
        super().__init__(
            system=system,
            component=component,
            heartbeat=heartbeat,
            version=version,
            boot_time=boot_time,
            telemetry=telemetry,
            mavlink_version=mavlink_version,
            stream=stream,
            high_latency=high_latency,
            signing_key=signing_key,
            signing_timestamp=signing_timestamp,
            usb=usb,
            armed=armed,
            reboot_ack=reboot_ack,
            reboot_down=reboot_down,
        )

    # The public face

    def param(self, name: str) -> Param:
        """One parameter as the vehicle really holds it, listed or not.

        Raises:
            UsageError: it has no parameter of that name.
        """
        return self._entry(name).param

    @property
    def listed(self) -> list[Param]:
        """The listed parameters in the order of their indices, those with repeated names one by one."""
        return [entry.param for entry in self._listed]

    @property
    def params(self) -> dict[str, Param]:
        """The listed parameters by name, in the order of their indices: what a full download should give.

        Of a repeated name the first one.
        """
        found: dict[str, Param] = {}
        for entry in self._listed:
            found.setdefault(entry.name, entry.param)
        return found

    @property
    def values(self) -> dict[str, Value]:
        """The listed values by name, as `params`."""
        return {name: param.value for name, param in self.params.items()}

    def when_listed(self, count: int, do: Callable[[], object]) -> None:
        """Call something once, as soon as a list has sent so many values since its start.

        For what happens in mid-stream: `px4.when_listed(300, lambda: px4.use("WV_EN"))` moves the count,
        `px4.when_listed(300, px4.reboot)` ends it. The call may change the vehicle in any way; several for
        one count are made in the order given.

        Raises:
            UsageError: the count is below 1.
        """
        if count < 1:
            raise UsageError(f"count is a number of values from 1 up, not {count}")
        self._when_listed.setdefault(count, []).append(do)

    @property
    def files(self) -> dict[str, bytes]:
        """The files that it has besides param.pck, by path; they can be changed at any time.

        Raises:
            UsageError: this vehicle does not speak MAVFTP.
        """
        if self._ftp is None:
            raise UsageError("this vehicle does not speak MAVFTP")
        return self._ftp.files

    @property
    def open_files(self) -> list[str]:
        """The paths of the files that are open in a session of MAVFTP."""
        return [] if self._ftp is None else self._ftp.open_files

    def set_param(self, name: str, value: Value) -> None:
        """Change a value as if on board or by another station; the vehicle tells of it if its kind does.

        Raises:
            UsageError: it has no parameter of that name, or the value does not fit its type.
        """
        entry = self._entry(name)
        self._write(entry, bits_of(value, entry.type))

    # What a kind of vehicle does in its own way

    @abstractmethod
    def _on_list(self) -> None:
        """PARAM_REQUEST_LIST has come."""

    @abstractmethod
    def _on_read(self, request: wire.ParamRequestRead, sender: wire.Frame) -> None:
        """PARAM_REQUEST_READ has come."""

    @abstractmethod
    def _on_set(self, request: wire.ParamSet, sender: wire.Frame) -> None:
        """PARAM_SET has come."""

    @abstractmethod
    def _write(self, entry: Entry, bits: int) -> None:
        """Hold another value, by whomever, and see to what follows from that."""

    def _set_from_file(self, entry: Entry, param: PackedParam) -> None:
        """A parameter has come in a file."""
        if param.type == entry.type:
            self._write(entry, param.bits)

    def _is_listed(self, entry: Entry) -> bool:
        return True

    def _key(self, name: str) -> str:
        """What two names have in common that mean one parameter."""
        return name

    def _next_place(self, position: int) -> int:
        """Which of the listed comes at this position of the list that is being sent."""
        return position

    def _count_in_list(self) -> int:
        """The count that the values of a list carry."""
        return len(self._listed)

    def _send_next(self) -> bool:
        """Send the next item of the list; False when there is none."""
        if self._position is None:
            return False
        index = self._position
        place = self._next_place(index)
        if place >= len(self._listed) or self._falls_silent():
            self._position = None
            return False
        entry = self._last_listed = self._listed[place]
        self._position = index + 1 if place + 1 < len(self._listed) else None
        if not self._is_dead(entry):
            self._send_value(entry, index=index, count=self._count_in_list())
            self._list_sent += 1
            for do in self._when_listed.pop(self._list_sent, ()):
                do()
        return True

    def _falls_silent(self) -> bool:
        """Whether the list breaks off here, where it still has a value to send."""
        if self._list_sent < self._list_stops_at or self._list_stops < 1:
            return False
        self._list_stops -= 1
        return True

    def _is_dead(self, entry: Entry) -> bool:
        return bool(self._dead) and (entry.index in self._dead or entry.name in self._dead)

    def _on_request(self, message: wire.Message, sender: wire.Frame) -> None:
        if isinstance(message, wire.ParamRequestRead):
            self._on_read(message, sender)
        elif isinstance(message, wire.ParamRequestList):
            self._on_list()
        elif isinstance(message, wire.ParamSet):
            self._on_set(message, sender)
        elif isinstance(message, wire.FileTransfer) and self._ftp is not None:
            self._ftp.receive(message.payload, (sender.system, sender.component), self._now)

    def _next_transmission(self) -> float:
        return min(super()._next_transmission(), self._next_burst, self._next_file_work())

    def _next_file_work(self) -> float:
        """When MAVFTP has something to do."""
        return math.inf if self._ftp is None else self._ftp.next_deadline()

    def _skip_what_was_left_out(self) -> None:
        super()._skip_what_was_left_out()
        self._next_burst = max(self._now, self._next_burst)

    def _switch_on(self, at: float) -> None:
        self._next_burst = math.inf
        self._position = None
        self._last_listed = None
        self._list_sent = 0
        if self._ftp is not None:
            self._ftp.reset()
        self._relist()
        super()._switch_on(at)

    def _work(self, now: float) -> None:
        super()._work(now)
        if not self._high_latency:
            self._send_list(now)
            self._serve_files(now)

    def _send_list(self, now: float) -> None:
        """Send what is due of the list."""
        while self._next_burst <= now:
            self._next_burst += self._period
            for _ in range(self._burst):
                if not self._send_next():
                    self._next_burst = math.inf
                    break

    def _serve_files(self, now: float) -> None:
        """Send what is due of MAVFTP."""
        if self._ftp is not None:
            for answer, sender in self._ftp.work(now):
                self._send(wire.FileTransfer(0, *sender, answer.pack()))

    # Tools for the kinds

    def _packed_params(self) -> list[PackedParam] | None:
        """The list for param.pck; None where a type in it has no place there."""
        packed = [each for entry in self._listed if (each := entry.packed) is not None]
        return packed if len(packed) == len(self._listed) else None

    def _apply_packed(self, params: Sequence[PackedParam]) -> None:
        for param in params:
            entry = self._find(param.name)
            if entry is not None:
                self._set_from_file(entry, param)

    def _take_system_id(self, entry: Entry | None) -> None:
        """Speak under the system id that a parameter says, if it is there and can be one."""
        if entry is not None and isinstance(entry.value, int) and 1 <= entry.value <= 255:
            self.system = entry.value

    def _start_list(self, at: float) -> None:
        """Send the list from its start, from `at` on, and not before the vehicle has booted."""
        self._position = 0
        self._last_listed = None
        self._list_sent = 0
        self._next_burst = max(at, self._on_at + self._boot_time)

    def _entry(self, name: str) -> Entry:
        entry = self._find(name)
        if entry is None:
            raise UsageError(f"this vehicle has no parameter {name!r}")
        return entry

    def _find(self, name: str) -> Entry | None:
        return self._by_name.get(self._key(name))

    def _by_index(self, index: int) -> Entry | None:
        return self._listed[index] if 0 <= index < len(self._listed) else None

    def _relist(self) -> None:
        """Number the listed parameters anew."""
        for entry in self._listed:
            entry.index = None
        self._listed = [entry for entry in self._entries if self._is_listed(entry)]
        for index, entry in enumerate(self._listed):
            entry.index = index

    def _send_value(
        self, entry: Entry, *, index: int | None = None, count: int | None = None, kind: int | None = None
    ) -> None:
        """Send a PARAM_VALUE with the entry's own index and type and the list's count, or others."""
        if index is None:
            index = wire.NO_INDEX if entry.index is None else entry.index
        if count is None:
            count = len(self._listed)
        self._send(wire.ParamValue(entry.name, entry.raw, entry.type if kind is None else kind, count, index))

    def _refuse(
        self, code: ParamErrorCode, request: wire.ParamRequestRead | wire.ParamSet, sender: wire.Frame
    ) -> None:
        """Send PARAM_ERROR, if this vehicle does that."""
        if self._param_error:
            index = request.param_index if isinstance(request, wire.ParamRequestRead) else -1
            name = request.param_id if index < 0 else ""
            self._send(wire.ParamError(sender.system, sender.component, name, index, code))


_LONGEST = 65535  # param_count has 16 bits, and index 65535 means none
