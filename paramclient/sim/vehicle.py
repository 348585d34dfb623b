"""Simulated vehicles: parameter table, list in bursts, reads and sets, files."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Final

from paramclient.errors import ParamErrorCode, UsageError
from paramclient.model.values import Encoding, Param, ParamType, Value, bits_of
from paramclient.protocol.param_pck import PackedParam
from paramclient.sim.device import Device
from paramclient.sim.ftp import FileServer
from paramclient.sim.param_table import Entry, SimParam, Table, as_table
from paramclient.wire import frames, messages

SIMULATED_COMMIT: Final = "5eed5eed"
"""The commit that simulated autopilots report, in hexadecimal; a simulated PX4 reports it twice, in 16
digits. Their tables and versions are those of a real firmware, but their descriptions are not: with its
commit, the stored descriptions of one would be used for the other. A real commit has these first 8 digits
with a probability of 1 in 4 billion, and all 16 practically never."""


@dataclass(kw_only=True, eq=False, repr=False)
class Vehicle(Device):
    """A simulated component with the parameter protocol; an `Endpoint`.

    Sans-I/O, without a clock. Requests at `now` are answered with the delays of a real vehicle;
    `next_deadline` returns when. The first call of `tick` or `receive` switches the vehicle on.

    Attributes:
        system, component: the vehicle's ids.
        armed: whether the heartbeat says armed, which prevents reboots; can be changed at any time.
        requests: number of received messages for this vehicle, by their MAVLink names
            (`requests["PARAM_REQUEST_READ"]`).
        version: its AUTOPILOT_VERSION; can be changed while the vehicle is off.
        entries: all parameters, listed or not.
        signing_key: the current signing key; None without signing.
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
            and a set of them is answered. Can be replaced at any time.
        reboot_down: seconds for which the vehicle is off during a reboot.
        signing_key: the key that signs sent frames; only frames signed with it, and RADIO_STATUS, are then
            accepted. None: no signing, until SETUP_SIGNING sets a key. A sender's timestamps must rise, and
            at most 16 senders and links are accepted until the vehicle is switched off.
        signing_timestamp: the initial signing timestamp, as the vehicle has no other clock. Received
            timestamps advance it.
        usb: whether the link counts as safe: all frames are accepted, as by ArduPilot over USB.
    """

    encoding: ClassVar = Encoding.BYTEWISE
    _system_id: ClassVar = ""
    """The parameter that contains the system id."""
    _reports_wrong_type: ClassVar = True
    """Whether the response to a set of another type is the current value."""

    burst: int = 10
    period: float = 0.01
    param_error: bool = False
    dead: Collection[int | str] = ()

    def _set_up_table(
        self,
        rows: Iterable[SimParam],
        heartbeat: messages.Heartbeat,
        version: messages.AutopilotVersion,
        file_server: FileServer | None = None,
    ) -> None:
        """Check the arguments, and prepare the first start."""
        own = (replace(row, value=self.system) if row.name == self._system_id else row for row in rows)
        self.entries = [Entry(row, order, self.encoding) for order, row in enumerate(own)]
        self._by_name = {self._key(entry.name): entry for entry in reversed(self.entries)}
        if len({entry.name for entry in self.entries}) < len(self.entries):
            raise UsageError("the table contains a parameter name twice")
        for each in self.dead:
            if isinstance(each, str):
                self._entry(each)
        self.file_server = file_server
        self._listed: list[Entry] = []
        self._when_listed: dict[int, list[Callable[[], object]]] = {}
        self._set_up(heartbeat, version)

    # Public interface

    def param(self, name: str) -> Param:
        """Return one parameter with its value on board, listed or not.

        Raises:
            UsageError: the vehicle has no parameter with that name.
        """
        return self._entry(name).param

    @property
    def listed(self) -> list[Param]:
        """The listed parameters in the order of their indices."""
        return [entry.param for entry in self._listed]

    @property
    def params(self) -> dict[str, Param]:
        """The listed parameters by name, in the order of their indices: the expected result of a full
        download."""
        return {param.name: param for param in self.listed}

    @property
    def values(self) -> dict[str, Value]:
        """The listed values by name, like `params`."""
        return {param.name: param.settable for param in self.listed}

    def when_listed(self, count: int, do: Callable[[], object]) -> None:
        """Call a function once, when a list has sent this many values since its start.

        For events during a list: `px4.when_listed(300, lambda: px4.use("WV_EN"))` changes the count,
        `px4.when_listed(300, px4.stop_list)` and `px4.reboot` end the list. The function may change the
        vehicle in any way; several functions for one count are called in the given order.
        """
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
        return [] if self.file_server is None else self.file_server.open_files(self._now)

    def set_param(self, name: str, value: Value) -> None:
        """Change a value as if on board or by another station; announced as this kind of vehicle does.

        Raises:
            UsageError: the vehicle has no parameter with that name, or the value does not fit its type.
        """
        entry = self._entry(name)
        self._write(entry, bits_of(value, entry.type))

    def load(self, values: Mapping[str, Value]) -> None:
        """Change values as code on board does that announces nothing, such as PX4's `param load`.

        Raises:
            UsageError: the vehicle has no parameter with such a name, or a value does not fit its type.
        """
        for name, value in values.items():
            entry = self._entry(name)
            self._store(entry, bits_of(value, entry.type))

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
            self._due[self._serve_files] = self.file_server.next_deadline()
        else:
            super().respond(message, sender)

    # The MAVLink standard; most of it is different in subclasses

    def _on_list(self) -> None:
        self._start_list(self._now)

    def _on_read(self, request: messages.ParamRequestRead, sender: frames.Frame) -> None:
        entry = self._requested(request)
        if entry is None:
            self._refuse(ParamErrorCode.DOES_NOT_EXIST, request, sender)
        elif not self._is_dead(entry):
            self._send_value(entry)

    def _on_set(self, request: messages.ParamSet, sender: frames.Frame) -> None:
        entry = self._find(request.param_id)
        if entry is None:
            self._refuse(ParamErrorCode.DOES_NOT_EXIST, request, sender)
        elif entry.type != request.param_type:
            self._refuse(ParamErrorCode.TYPE_MISMATCH, request, sender)
            if self._reports_wrong_type and not self.param_error:
                self._send_value(entry)
        else:
            size = ParamType(entry.type).size if entry.type <= ParamType.CUSTOM else 4
            self._write(entry, int.from_bytes(request.raw[:size], "little"))
            self._send_value(entry)

    def _write(self, entry: Entry, bits: int) -> None:
        """Set another value, from any source, and start what follows from the change."""
        self._store(entry, bits)

    def _store(self, entry: Entry, bits: int) -> None:
        """Set another value, without announcing it."""
        entry.store(bits)

    def _is_listed(self, entry: Entry) -> bool:
        return True

    def _key(self, name: str) -> str:
        """Return the key of a name: names of the same parameter have the same key."""
        return name

    def _next_place(self, position: int) -> int:
        """Return the index among the listed parameters for a position of the list in progress."""
        return position

    # The list and the files

    def _switch_on(self, at: float) -> None:
        self._position: int | None = None
        """The next index of the list, None while no list is being sent."""
        self._last_listed: Entry | None = None
        self._list_sent = 0
        self._list_count: int | None = None
        """The param_count of the list's values; None for the current one."""
        self._take_system_id(at)
        if self.file_server is not None:
            self.file_server.reset()
        self._relist()
        super()._switch_on(at)

    def _tasks(self) -> list[Callable[[float], None]]:
        return [*super()._tasks(), self._send_list, self._serve_files]

    def _start_list(self, at: float) -> None:
        """Send the list from its start, from `at` on, and not before the vehicle has booted."""
        self._position = 0
        self._last_listed = None
        self._list_sent = 0
        self._due[self._send_list] = max(at, self._on_at + self.boot_time)

    def stop_list(self) -> None:
        """End the list without its remaining values; a new request starts at the beginning."""
        self._position = None

    def _send_list(self, at: float) -> None:
        """Send one burst of the list."""
        self._due[self._send_list] = at + self.period
        for _ in range(self.burst):
            if not self._send_next():
                self._due[self._send_list] = math.inf
                return

    def _send_next(self) -> bool:
        """Send the next item of the list; return False if there is none."""
        if self._position is None:
            return False
        index = self._position
        place = self._next_place(index)
        if place >= len(self._listed):
            self._position = None
            return False
        entry = self._last_listed = self._listed[place]
        self._position = index + 1 if place + 1 < len(self._listed) else None
        if not self._is_dead(entry):
            self._send_value(entry, index=index, count=self._list_count)
            self._list_sent += 1
            for do in self._when_listed.pop(self._list_sent, ()):
                do()
        return True

    def _serve_files(self, at: float) -> None:
        """Send the due MAVFTP responses."""
        if self.file_server is not None:
            for answer, sender in self.file_server.work(self._now):
                self.send(messages.FileTransfer(0, *sender, answer.pack()))
            self._due[self._serve_files] = self.file_server.next_deadline()

    # Helpers for subclasses

    def _packed_params(self) -> list[PackedParam] | None:
        """Return the parameters for param.pck; None if it cannot hold one of the types."""
        packed = [each for entry in self._listed if (each := entry.packed) is not None]
        return packed if len(packed) == len(self._listed) else None

    def _take_system_id(self, at: float) -> None:
        """Use the system id in the parameter, if the parameter exists and its value is a valid id."""
        entry = self._find(self._system_id)
        if entry is not None and isinstance(entry.value, int) and 1 <= entry.value <= 255:
            self.system = entry.value

    def _is_dead(self, entry: Entry) -> bool:
        return bool(self.dead) and (entry.index in self.dead or entry.name in self.dead)

    def _entry(self, name: str) -> Entry:
        entry = self._find(name)
        if entry is None:
            raise UsageError(f"this vehicle has no parameter {name!r}")
        return entry

    def _find(self, name: str) -> Entry | None:
        return self._by_name.get(self._key(name))

    def _requested(self, request: messages.ParamRequestRead) -> Entry | None:
        if request.param_index < 0:
            return self._find(request.param_id)
        return self._listed[request.param_index] if request.param_index < len(self._listed) else None

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
        count = count or len(self._listed)
        self.send(messages.ParamValue(entry.name, entry.raw, kind or entry.type, count, index))

    def _refuse(
        self,
        code: ParamErrorCode,
        request: messages.ParamRequestRead | messages.ParamSet,
        sender: frames.Frame,
    ) -> None:
        """Send PARAM_ERROR, if this vehicle supports it."""
        if self.param_error:
            index = request.param_index if isinstance(request, messages.ParamRequestRead) else -1
            name = request.param_id if index < 0 else ""
            self.send(messages.ParamError(sender.system, sender.component, name, index, code))


@dataclass(kw_only=True, eq=False, repr=False)
class GenericVehicle(Vehicle):
    """A component as in the MAVLink guide: byte-wise, all types, no hash, immediate responses.

    A set with another type changes nothing; the response is the current value or, with `param_error`,
    PARAM_ERROR. Of a 64-bit type, the lower four bytes are sent.

    Args:
        table: the parameters (see `Table`), listed in the given order.
        uid: the reported hardware id; by default unique for every system.
        autopilot: MAV_AUTOPILOT in the heartbeat.

    Other arguments are those of every `Vehicle`.

    Raises:
        UsageError: an argument is invalid.
    """

    table: Table = field(kw_only=False)
    uid: int | None = None
    autopilot: int = messages.MAV_AUTOPILOT_GENERIC

    def __post_init__(self) -> None:
        uid = 0x5EED_0000 + self.system if self.uid is None else self.uid
        self._set_up_table(
            as_table(self.table),
            messages.Heartbeat(0, self.autopilot, system_status=messages.MAV_STATE_ACTIVE),
            messages.AutopilotVersion(8192 | messages.CAPABILITY_PARAM_ENCODE_BYTEWISE, uid=uid),
        )
