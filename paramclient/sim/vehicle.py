"""Vehicle, the base of all simulated vehicles: parameter table, list in bursts, identity, heartbeat."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from typing import Final, Unpack

from paramclient.errors import ParamErrorCode, UsageError
from paramclient.model.values import Encoding, Param, WireValue, bits_of
from paramclient.protocol.param_pck import PackedParam
from paramclient.sim.device import Device, DeviceOptions
from paramclient.sim.ftp import FileServer
from paramclient.sim.param_table import Entry, SimParam
from paramclient.wire import frames, messages

__all__ = ["SIMULATED_COMMIT", "Vehicle", "VehicleOptions"]

SIMULATED_COMMIT: Final = "5eed5eed"
"""The commit that simulated autopilots report, in hexadecimal; a simulated PX4 reports it twice, in 16
digits. Their tables and versions are those of a real firmware, but their descriptions are not: with its
commit, the stored descriptions of one would be used for the other. A real commit has these first 8 digits
with a probability of 1 in 4 billion, and all 16 practically never."""


class VehicleOptions(DeviceOptions, total=False):
    """Arguments of every kind of vehicle; see `Vehicle`."""

    param_error: bool
    dead: Iterable[int | str]
    list_stops_at: int | None
    list_stops: float


class Vehicle(Device, ABC):
    """A simulated component with the parameter protocol in bytes; an `Endpoint`.

    Sans-I/O, without a clock. Requests at `now` are answered with the delays of a real vehicle;
    `next_deadline` returns when. The first call of `tick` or `receive` switches the vehicle on.

    Attributes:
        system, component: the vehicle's ids.
        armed: whether the heartbeat says armed, which prevents reboots; can be changed at any time.
        requests: number of received messages for this vehicle, by their MAVLink names
            (`requests["PARAM_REQUEST_READ"]`).
        version: its AUTOPILOT_VERSION; can be changed while the vehicle is off.
        entries: all parameters, listed or not.
        dead: indices and names as in the argument; can be changed at any time.
        file_server: its MAVFTP, or None; can be taken away and given back at any time.

    Args of every vehicle:
        burst, period: parameters per burst of the list, and the seconds between two bursts.
        boot_time: seconds from switching on in which the vehicle does not send its list; the heartbeat says
            MAV_STATE_BOOT meanwhile.
        param_error: refuse requests with PARAM_ERROR, as newer firmware does.
        telemetry: additional messages per second (ATTITUDE), which a client must skip.
        mavlink_version: 2, or 1 for an old vehicle.
        stream: whether the link is a byte stream, where a frame may be split over several `receive`
            calls; datagrams are never joined.
        dead: indices and names that the list leaves out, and whose reads are not answered. They still count,
            and a set of them is answered.
        list_stops_at: number of values after which a list stops; None for never. The list has then ended: a
            new request starts at the beginning.
        list_stops: the number of lists that stop; `math.inf` for all.
        reboot_ack: whether a reboot command is acknowledged before the reboot.
        reboot_down: seconds for which the vehicle is off during a reboot.
        signing_key: the key that signs sent frames; only frames signed with it, and RADIO_STATUS, are then
            accepted. None: no signing, until SETUP_SIGNING sets a key. A sender's timestamps must rise, and
            at most 16 senders and links are accepted until the vehicle is switched off.
        signing_timestamp: the initial signing timestamp, as the vehicle has no other clock. Received
            timestamps advance it.
        usb: whether the link counts as safe: all frames are accepted, as by ArduPilot over USB.
    """

    file_server: FileServer | None = None
    _position: int | None
    """The next index of the list, None while no list is being sent."""
    _last_listed: Entry | None
    """The last parameter that the list has sent."""
    _list_sent: int
    """Values since the start of the list."""
    _next_burst: float

    def __init__(
        self,
        table: Iterable[SimParam],
        *,
        system: int,
        component: int,
        encoding: Encoding,
        heartbeat: messages.Heartbeat,
        version: messages.AutopilotVersion,
        burst: int,
        period: float,
        param_error: bool = False,
        dead: Iterable[int | str] = (),
        list_stops_at: int | None = None,
        list_stops: float = 1,
        **options: Unpack[DeviceOptions],
    ) -> None:
        rows = tuple(table)
        if len({row.name for row in rows}) < len(rows):
            raise UsageError("the table contains a parameter name twice")
        if len(rows) > _TABLE_SIZE_MAX:
            raise UsageError(f"a table holds at most {_TABLE_SIZE_MAX} parameters, not {len(rows)}")
        if param_error and options.get("mavlink_version") == 1:
            raise UsageError("PARAM_ERROR does not exist in MAVLink 1")
        if burst < 1 or not (math.isfinite(period) and period > 0.0):
            raise UsageError("burst must be a number from 1 up, and period a number of seconds above 0")
        if list_stops_at is not None and list_stops_at < 0:
            raise UsageError(f"list_stops_at must be a number of values from 0 up, not {list_stops_at}")
        if not list_stops >= 0:
            raise UsageError(f"list_stops must be a number of lists from 0 up, not {list_stops}")
        self.entries = [Entry(row, order, encoding) for order, row in enumerate(rows)]
        self._by_name = {self._key(entry.name): entry for entry in reversed(self.entries)}
        self._listed: list[Entry] = []
        self.dead: set[int | str] = set()
        for each in dead:
            if isinstance(each, int) and not 0 <= each < _TABLE_SIZE_MAX:
                raise UsageError(f"an index must be a number from 0 to {_TABLE_SIZE_MAX - 1}, not {each}")
            self.dead.add(self._entry(each).name if isinstance(each, str) else each)
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
            **options,
        )

    # Public interface

    def param(self, name: str) -> Param:
        """Return one parameter with its value on board, listed or not.

        Raises:
            UsageError: the vehicle has no parameter with that name.
        """
        return self._entry(name).param

    @property
    def listed(self) -> list[Param]:
        """The listed parameters in the order of their indices, including repeated names."""
        return [entry.param for entry in self._listed]

    @property
    def params(self) -> dict[str, Param]:
        """The listed parameters by name, in the order of their indices: the expected result of a full
        download.

        Of a repeated name, the first one.
        """
        found: dict[str, Param] = {}
        for entry in self._listed:
            found.setdefault(entry.name, entry.param)
        return found

    @property
    def values(self) -> dict[str, WireValue]:
        """The listed values by name, like `params`."""
        return {name: param.settable for name, param in self.params.items()}

    def when_listed(self, count: int, do: Callable[[], object]) -> None:
        """Call a function once, when a list has sent this many values since its start.

        For events during a list: `px4.when_listed(300, lambda: px4.use("WV_EN"))` changes the count,
        `px4.when_listed(300, px4.reboot)` ends the list. The function may change the vehicle in any way;
        several functions for one count are called in the given order.

        Raises:
            UsageError: the count is below 1.
        """
        if count < 1:
            raise UsageError(f"count must be a number of values from 1 up, not {count}")
        self._when_listed.setdefault(count, []).append(do)

    @property
    def files(self) -> dict[str, bytes]:
        """The vehicle's files besides param.pck, by path; can be changed at any time.

        Raises:
            UsageError: this vehicle has no MAVFTP.
        """
        if self.file_server is None:
            raise UsageError("this vehicle has no MAVFTP")
        return self.file_server.files

    @property
    def open_files(self) -> list[str]:
        """The paths of the files that are open in a MAVFTP session."""
        return [] if self.file_server is None else self.file_server.open_files

    def set_param(self, name: str, value: WireValue) -> None:
        """Change a value as if on board or by another station; announced as this kind of vehicle does.

        Raises:
            UsageError: the vehicle has no parameter with that name, or the value does not fit its type.
        """
        entry = self._entry(name)
        self._write(entry, bits_of(value, entry.type))

    def respond(self, message: messages.Message, sender: frames.Frame) -> None:
        """See `Device.respond`."""
        if isinstance(message, messages.ParamRequestRead):
            self._on_read(message, sender)
        elif isinstance(message, messages.ParamRequestList):
            self._on_list()
        elif isinstance(message, messages.ParamSet):
            self._on_set(message, sender)
        elif isinstance(message, messages.FileTransfer) and self.file_server is not None:
            self.file_server.receive(message.payload, (sender.system, sender.component), self._now)
        else:
            super().respond(message, sender)

    # Implemented by subclasses

    @abstractmethod
    def _on_list(self) -> None:
        """Handle PARAM_REQUEST_LIST."""

    @abstractmethod
    def _on_read(self, request: messages.ParamRequestRead, sender: frames.Frame) -> None:
        """Handle PARAM_REQUEST_READ."""

    @abstractmethod
    def _on_set(self, request: messages.ParamSet, sender: frames.Frame) -> None:
        """Handle PARAM_SET."""

    @abstractmethod
    def _write(self, entry: Entry, bits: int) -> None:
        """Set another value, from any source, and start what follows from the change."""

    def _is_listed(self, entry: Entry) -> bool:
        return True

    def _key(self, name: str) -> str:
        """Return the key of a name: names of the same parameter have the same key."""
        return name

    def _next_place(self, position: int) -> int:
        """Return the index among the listed parameters for a position of the list in progress."""
        return position

    def _count_in_list(self) -> int:
        """Return the param_count of the list's values."""
        return len(self._listed)

    def _send_next(self) -> bool:
        """Send the next item of the list; return False if there is none."""
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
        """Return whether the list stops here, with values left to send."""
        if self._list_sent < self._list_stops_at or self._list_stops < 1:
            return False
        self._list_stops -= 1
        return True

    def _is_dead(self, entry: Entry) -> bool:
        return bool(self.dead) and (entry.index in self.dead or entry.name in self.dead)

    def _next_transmission(self) -> float:
        return min(super()._next_transmission(), self._next_burst, self._next_file_work())

    def _next_file_work(self) -> float:
        """Return the time of the next work of MAVFTP."""
        return math.inf if self.file_server is None else self.file_server.next_deadline()

    def _skip_suppressed(self) -> None:
        super()._skip_suppressed()
        self._next_burst = max(self._now, self._next_burst)

    def _switch_on(self, at: float) -> None:
        self._next_burst = math.inf
        self._position = None
        self._last_listed = None
        self._list_sent = 0
        if self.file_server is not None:
            self.file_server.reset()
        self._relist()
        super()._switch_on(at)

    def _work(self, now: float) -> None:
        super()._work(now)
        if not self._high_latency:
            self._send_list(now)
            self._serve_files(now)

    def _send_list(self, now: float) -> None:
        """Send the due part of the list."""
        while self._next_burst <= now:
            self._next_burst += self._period
            for _ in range(self._burst):
                if not self._send_next():
                    self._next_burst = math.inf
                    break

    def _serve_files(self, now: float) -> None:
        """Send the due MAVFTP responses."""
        if self.file_server is not None:
            for answer, sender in self.file_server.work(now):
                self.send(messages.FileTransfer(0, *sender, answer.pack()))

    # Helpers for subclasses

    def _packed_params(self) -> list[PackedParam] | None:
        """Return the parameters for param.pck; None if it cannot hold one of the types."""
        packed = [each for entry in self._listed if (each := entry.packed) is not None]
        return packed if len(packed) == len(self._listed) else None

    def _take_system_id(self, entry: Entry | None) -> None:
        """Use the system id in a parameter, if the parameter exists and its value is a valid id."""
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
        """Assign indices to the listed parameters."""
        for entry in self._listed:
            entry.index = None
        self._listed = [entry for entry in self.entries if self._is_listed(entry)]
        for index, entry in enumerate(self._listed):
            entry.index = index

    def _send_value(
        self, entry: Entry, *, index: int | None = None, count: int | None = None, kind: int | None = None
    ) -> None:
        """Send a PARAM_VALUE with the entry's index and type and the list's count, or the given ones."""
        if index is None:
            index = messages.NO_INDEX if entry.index is None else entry.index
        if count is None:
            count = len(self._listed)
        self.send(
            messages.ParamValue(entry.name, entry.raw, entry.type if kind is None else kind, count, index)
        )

    def _refuse(
        self,
        code: ParamErrorCode,
        request: messages.ParamRequestRead | messages.ParamSet,
        sender: frames.Frame,
    ) -> None:
        """Send PARAM_ERROR, if this vehicle supports it."""
        if self._param_error:
            index = request.param_index if isinstance(request, messages.ParamRequestRead) else -1
            name = request.param_id if index < 0 else ""
            self.send(messages.ParamError(sender.system, sender.component, name, index, code))


_TABLE_SIZE_MAX = 65535
"""Parameters of a table: param_count has 16 bits, and index 65535 means none."""
