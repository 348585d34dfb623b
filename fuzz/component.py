"""Fuzz target: a station that receives arbitrary frames and requests in any order.

The frames are built from the input with a valid checksum, so that they reach the protocol; small sets of
names and addresses make them match pending requests. Limits are reduced so that inputs can reach them.
"""

from __future__ import annotations

import math
from contextlib import ExitStack, suppress
from typing import Any, Final
from unittest import mock

from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.params import change_origin, table
from paramclient.protocol.params.fetch import Fetch
from paramclient.protocol.params.fetch_result import Policy
from paramclient.protocol.params.passive import PassiveFetch
from paramclient.protocol.params.reads import ValueRead
from paramclient.protocol.params.sync import SyncSettings
from paramclient.protocol.params.writes import Write
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.stats import traffic
from paramclient.protocol.vehicle.metadata_request import MetadataRequest
from paramclient.protocol.vehicle.reboot_command import Reboot
from paramclient.protocol.wire import HASH_CHECK, NO_INDEX, Framer, Message

from fuzz.draw import Draw
from paramclient.errors import ContestedAddress, NoReply, ParamClientError, UsageError
from paramclient.model.values import Encoding, Param, Trust, WireValue, known_type
from paramclient.protocol import station, wire
from paramclient.protocol.ftp import FileRead
from paramclient.protocol.station import Station

__all__ = ["INPUT_SIZE_MAX", "run"]

INPUT_SIZE_MAX: Final = 400
"""Maximum bytes of an input: longer ones are slow and find nothing new."""

BOUNDS: Final = (
    (station, "COMPONENTS_MAX", 5),
    (station, "STREAM_PEERS_MAX", 3),
    (table, "NAMES_MAX", 12),
    (table, "NAMES_GUARANTEED", 6),
    (table, "LINK_NAMES_MAX", 25),
    (change_origin, "RECENT_CHANGES_MAX", 5),
    (traffic, "COUNTED_COMPONENTS_MAX", 4),
    (traffic, "COUNTED_PEERS_MAX", 3),
    (change_origin, "FOREIGN_SETS_MAX", 4),
)
LISTENS: Final = 0xE0
"""Lowest first byte of an input that stands for a listen-only station."""
OWN: Final = (255, 190)
SYSTEMS: Final = (1, 1, 1, 2, 3, 4, 255, 0)
COMPONENTS: Final = (1, 1, 100, 190)
COUNTS: Final = (8, 8, 8, 9, 3, 0, 1, 65534, 65535)
KINDS: Final = (9, 6, 1, 4, 5, 2, 3, 7, 8, 10, 0, 255)
AUTOPILOTS: Final = (12, 3, 0, 8)
VALUES: Final[tuple[WireValue, ...]] = (0.0, 1, -1.5, 300, 1e39, math.nan, b"\1\2\3\4", -0.0)
PAUSES: Final = (0.0, 0.001, 0.02, 0.1, 0.3, 1.0, 2.5, 5.1, 20.0, 70.0, 3600.0)
OPERATIONS_MAX: Final = 12
"""Calls in one input."""
STEPS_MAX: Final = 60
"""Ticks at one time that count as an endless loop."""
SENT_MAX: Final = 400
"""Frames that one step may send: a burst of reads, responses to the received frames, and repeats."""
OPERATION_TIMEOUT: Final = 1_800.0
"""Seconds of final silence within which every request has ended. A queue of six checksums alone takes
1,060 s: each may have 9 attempts, on a link with timeouts of 3.5 s."""
TICKS_MAX: Final = 6000
"""Deadlines within the final silence by which every request has ended."""


def run(data: bytes) -> None:
    """Run a session. No error is raised, no request hangs, no table has another component's parameters."""
    with ExitStack() as stack:
        for room, name, bound in BOUNDS:
            stack.enter_context(mock.patch.object(room, name, bound))
        session = _Session(Draw(data))
        session.play()
        session.end()


class _Session:
    def __init__(self, draw: Draw) -> None:
        options = draw.number()
        policy = (Policy.AUTO, Policy.AUTO, Policy.HASH_ONLY, Policy.CACHE_ONLY)[options >> 3 & 3]
        interval = 30.0 if options & 2 else math.inf
        self.draw = draw
        self.now = 1000.0
        self.is_paused = False
        self.listens = options >= LISTENS
        policy = Policy.CACHE_ONLY if self.listens else policy
        self.sync_settings = SyncSettings(
            interval, without_hash=bool(options & 2), policy=policy, listens_only=self.listens
        )
        self.station = Station(
            link="fuzz",
            is_stream=bool(options & 1),
            sync_settings=self.sync_settings,
            counts_traffic=bool(options & 4),
            encoding=(None, None, Encoding.BYTEWISE, Encoding.C_CAST)[options >> 5 & 3],
        )
        self.sequence = 0
        self.operations: list[tuple[ComponentMachine, Operation[Any]]] = []
        self.begun: list[Operation[Any]] = []
        self.requests: list[Message] = []
        self.framer = Framer(wire.DECODED_IDS, stream=False)
        self.steps = (
            *(self.value, self.value, self.values, self.heartbeat, self.version, self.answer, self.answer),
            *(self.file_answer, self.param_error, self.acknowledge, self.denied, self.clock, self.satellite),
            *(self.foreign_set, self.raw, self.hash, self.wait, self.wait, self.due, self.due),
            *(self.fetch, self.read, self.write, self.cancel, self.restart, self.file, self.cached),
            *(self.interrupt, self.fetch_several, self.description, self.ask_description),
        )

    def play(self) -> None:
        while not self.draw.is_over:
            with suppress(ContestedAddress):  # several peers use the address of the component
                self.draw.one_of(self.steps)()
            self.settle()

    def end(self) -> None:
        """Receive nothing more: all requests end, except those that only a caller's timeout ends."""
        if self.is_paused:
            self.interrupt()
            self.settle()
        endless = (Reboot, PassiveFetch)
        for machine, operation in self.operations:
            if isinstance(operation, endless):
                self.give_back(machine, operation)
        self.operations = [each for each in self.operations if not isinstance(each[1], endless)]
        end = self.now + OPERATION_TIMEOUT
        for _ in range(TICKS_MAX):
            deadline = self.station.next_deadline()
            if deadline > end or all(op.done for _, op in self.operations):
                break
            self.now = max(deadline, self.now)
            self.settle()
        for machine, operation in self.operations:
            assert operation.done, f"{operation} of {machine} does not end"
        for machine, operation in self.operations:
            self.give_back(machine, operation)
        if self.station.traffic is not None:
            self.station.traffic.report(self.now)

    def settle(self) -> None:
        """Run due deadlines, collect sent frames, and check all invariants."""
        for _ in range(STEPS_MAX):
            deadline = self.station.next_deadline()
            assert not math.isnan(deadline)
            if deadline > self.now:
                break
            self.station.tick(self.now)
        else:
            raise AssertionError(f"{STEPS_MAX} ticks at one moment, and something is still due")
        sent = self.station.data_to_send()
        assert not (sent and self.listens)
        assert len(sent) <= SENT_MAX, f"{len(sent)} frames at one moment"
        for data, _ in sent:
            (frame,) = self.framer.receive(data)
            message = wire.decode(frame)
            assert message is not None
            self.requests.append(message)
        del self.requests[:-20]
        for event in self.station.events():
            assert event is not None
        assert len(self.station.components) <= 5
        for (system, component), machine in self.station.components.items():
            self.check(machine, system, component)
        for operation in self.begun:
            assert operation.error is None or isinstance(operation.error, ParamClientError)
            if isinstance(operation, Fetch) and operation.result is not None:
                result = operation.result
                assert result.received + len(result.missing) == result.count
                assert all(0 <= index < result.count for index in result.missing)
        self.begun = [operation for operation in self.begun if not operation.done]

    def check(self, machine: ComponentMachine, system: int, component: int) -> None:
        held = machine.table
        assert (system, component) != self.station.own_address
        assert system != 0
        assert len(held.params) <= 12
        prefix = _prefix(system)
        for name, param in held.params.items():
            assert param.name == name
            assert name.startswith(prefix), f"{name} in the table of {system}/{component}"
            assert param.index is None or 0 <= param.index < NO_INDEX
        assert held._wire.keys() <= held.params.keys()
        assert held._filed <= held.params.keys()

    # Received frames

    def hear(self, message: Message, system: int | None = None, component: int | None = None) -> None:
        draw = self.draw
        if system is None or component is None:
            system, component = draw.one_of(SYSTEMS), draw.one_of(COMPONENTS)
        self.sequence = (self.sequence + 1) % 256
        way = draw.number()
        version = 1 if way & 4 and not isinstance(message, wire.ParamError | wire.ComponentMetadata) else 2
        data = wire.encode(
            message, system=system, component=component, sequence=self.sequence, version=version
        )
        if not self.is_paused:
            self.station.receive(data, way & 3, self.now)

    def heartbeat(self) -> None:
        kind, autopilot = self.draw.one_of((2, 2, 6, 26)), self.draw.one_of(AUTOPILOTS)
        self.hear(wire.Heartbeat(kind, autopilot, self.draw.number(), 0, self.draw.number() % 9))

    def version(self) -> None:
        draw = self.draw
        capabilities = draw.one_of((0, 16, 32, 48, 131072, 32 | 131072))
        uid, firmware = draw.number() % 4, draw.one_of((0x01110000, 0x01120000, 0))
        self.hear(wire.AutopilotVersion(capabilities, firmware, bytes(8), uid=uid))

    def value(self) -> None:
        draw = self.draw
        system, component = draw.one_of(SYSTEMS), draw.one_of(COMPONENTS)
        count, index = draw.one_of(COUNTS), draw.one_of((*range(9), 65534, 65535))
        message = wire.ParamValue(self.name(system), draw.take(4), draw.one_of(KINDS), count, index)
        self.hear(message, system, component)

    def values(self) -> None:
        """Receive a part of a list, as a vehicle sends it."""
        draw = self.draw
        system, component = draw.one_of(SYSTEMS), draw.one_of(COMPONENTS)
        count, first, number = draw.one_of(COUNTS), draw.number() % 9, draw.number() % 10
        for index in range(first, first + number):
            self.hear(self.entry(system, index, count), system, component)

    def hash(self) -> None:
        system, component = self.draw.one_of(SYSTEMS), self.draw.one_of(COMPONENTS)
        machine = self.station.components.get((system, component))
        known = None if machine is None or self.draw.number() % 4 == 0 else machine.table.hash
        raw = self.draw.take(4) if known is None else known.to_bytes(4, "little")
        message = wire.ParamValue(HASH_CHECK, raw, 5, self.draw.one_of(COUNTS), NO_INDEX)
        self.hear(message, system, component)

    def answer(self) -> None:
        """Receive the response of a correct vehicle to one of the latest requests."""
        if not self.requests:
            return
        request = self.requests[-1 - self.draw.number() % len(self.requests)]
        target = (getattr(request, "target_system", 0), getattr(request, "target_component", 0))
        if 0 in target:
            return
        system, component = target
        match request:
            case wire.ParamRequestRead(param_id=name, param_index=-1) if name.startswith(_prefix(system)):
                self.hear(wire.ParamValue(name, self.draw.take(4), 9, 8, NO_INDEX), system, component)
            case wire.ParamRequestRead(param_index=index) if index >= 0:
                self.hear(self.entry(system, index, 8), system, component)
            case wire.ParamRequestList():
                for index in range(8):
                    self.hear(self.entry(system, index, 8), system, component)
            case wire.ParamSetMessage(param_id=name, raw=raw, param_type=kind):
                self.hear(wire.ParamValue(name, raw, kind, 8, NO_INDEX), system, component)
            case wire.CommandLong(command=command):
                self.hear(wire.CommandAck(command, self.draw.number() % 7, *OWN), system, component)
            case wire.FileTransfer():
                self.answer_file(request, system, component)

    def file_answer(self) -> None:
        """Receive a MAVFTP response, requested or not."""
        for request in reversed(self.requests):
            if isinstance(request, wire.FileTransfer):
                self.answer_file(request, request.target_system, self.draw.one_of(COMPONENTS))
                return
        self.hear(wire.FileTransfer(0, *OWN, self.draw.take(251)))

    def answer_file(self, request: wire.FileTransfer, system: int, component: int) -> None:
        draw = self.draw
        requested = request.payload
        sequence = int.from_bytes(requested[:2], "little") + draw.one_of((1, 1, 1, 2, 3, 0, 4095, 65535))
        opcode = draw.one_of((128, 128, 129))
        offset = int.from_bytes(requested[8:12], "little")
        offset = draw.one_of((offset, offset, 0, 4, offset + 239, 0xFFFFFFFF))
        content = draw.take(draw.number() % 64)
        if opcode == 129:
            content = draw.one_of((b"\x06", b"\x0a", b"\x01", b"\x02\x02", b"\x04", b"\x05", b"\x07", b""))
        head = (sequence & 0xFFFF).to_bytes(2, "little") + bytes(
            (
                draw.one_of((requested[2], requested[2], 0, 1)),
                opcode,
                draw.one_of((len(content), len(content), 255)),
            )
        )
        tail = bytes((draw.one_of((requested[3], requested[3], 15, 5)), draw.number() & 1, 0))
        payload = (head + tail + offset.to_bytes(4, "little") + content).ljust(251, b"\0")
        self.hear(
            wire.FileTransfer(0, *draw.one_of((OWN, OWN, (0, 0), (254, 190))), payload), system, component
        )

    def param_error(self) -> None:
        draw = self.draw
        system, component = draw.one_of(SYSTEMS), draw.one_of(COMPONENTS)
        index, error = draw.one_of((-1, 0, 1, 5, 7, 32767)), draw.number() % 10
        target = draw.one_of((OWN, (0, 0), (254, 190)))
        self.hear(wire.ParamError(*target, self.name(system), index, error), system, component)

    def acknowledge(self) -> None:
        command, result = self.draw.one_of((512, 520, 246)), self.draw.number() % 8
        self.hear(wire.CommandAck(command, result, *self.draw.one_of((OWN, (0, 0), (254, 190)))))

    def denied(self) -> None:
        system, component = self.draw.one_of(SYSTEMS), self.draw.one_of(COMPONENTS)
        text = f"Param write denied ({self.name(system)})"[: self.draw.number() % 51]
        self.hear(wire.StatusText(3, text), system, component)

    def clock(self) -> None:
        self.hear(wire.SystemTime(self.draw.number(2), self.draw.one_of((0, 1000, 60_000, (1 << 32) - 1))))

    def satellite(self) -> None:
        self.hear(wire.HighLatency2(2, self.draw.one_of(AUTOPILOTS)))

    def description(self) -> None:
        self.hear(wire.ComponentMetadata("mftp://a" if self.draw.number() & 1 else "", 7))

    def foreign_set(self) -> None:
        draw = self.draw
        system, component = draw.one_of(SYSTEMS), draw.one_of(COMPONENTS)
        self.hear(wire.ParamSetMessage(system, component, self.name(system), draw.take(4), 9))

    def raw(self) -> None:
        data = self.draw.take(self.draw.number() % 48)
        if not self.is_paused:
            self.station.receive(data, self.draw.number() % 4, self.now)

    # Time

    def wait(self) -> None:
        self.now += self.draw.one_of(PAUSES)

    def due(self) -> None:
        """Advance the time to the next deadline, several times."""
        for _ in range(self.draw.number() % 16):
            deadline = self.station.next_deadline()
            if deadline < math.inf:
                self.now = max(self.now, deadline)
            self.settle()

    def interrupt(self) -> None:
        """Interrupt the link, or restore it."""
        self.is_paused = not self.is_paused
        if self.is_paused:
            self.station.pause()
        else:
            self.station.resume(self.now)

    # Requests

    def machine(self) -> ComponentMachine | None:
        known = list(self.station.components.values())
        return self.draw.one_of(known) if known else None

    def keep(self, machine: ComponentMachine, operation: Operation[Any]) -> None:
        self.operations.append((machine, operation))
        self.begun.append(operation)
        if len(self.operations) > OPERATIONS_MAX:
            self.give_back(*self.operations.pop(0))

    def give_back(self, machine: ComponentMachine, operation: Operation[Any]) -> None:
        match operation:
            case Fetch():
                machine.end_fetch(operation, self.now)
            case ValueRead():
                machine.reads.release(operation)
            case Write():
                machine.writes.cancel(operation, self.now)
            case MetadataRequest():
                machine.metadata_requests.release(operation)
            case Reboot():
                machine.end_reboot(operation, self.now)
            case _:
                machine.files.release(operation, self.now)  # type: ignore[arg-type]  # all other kinds are handled above

    def fetch(self) -> None:
        machine, how = self.machine(), self.draw.number()
        if machine is not None:
            refresh = bool(how & 32) and self.sync_settings.policy is Policy.AUTO
            with suppress(NoReply, UsageError):
                self.keep(machine, machine.begin_fetch(self.now, refresh=refresh))

    def fetch_several(self) -> None:
        system = self.draw.one_of(SYSTEMS)
        machines = [each for each in self.station.components.values() if each.system == system]
        if machines and not self.listens and not any(each.presence.is_lost for each in machines):
            fetches = self.station.begin_fetches(machines, self.now)
            for machine, fetch in zip(machines, fetches, strict=True):
                self.keep(machine, fetch)

    def read(self) -> None:
        machine, key = self.machine(), self.draw.one_of((None, None, HASH_CHECK, 0, 3, 7, 8, 32767))
        if machine is not None:
            key = self.name(machine.system) if key is None else key
            with suppress(NoReply, UsageError):
                self.keep(machine, machine.read(key, self.now))

    def write(self) -> None:
        machine = self.machine()
        if machine is not None:
            name = self.name(machine.system)
            value: WireValue = self.draw.one_of(VALUES)
            with suppress(NoReply, UsageError):
                self.keep(machine, machine.write(name, value, self.now))

    def cancel(self) -> None:
        if self.operations:
            self.give_back(*self.operations.pop(self.draw.number() % len(self.operations)))

    def restart(self) -> None:
        machine, returns = self.machine(), bool(self.draw.number() & 1)
        if machine is not None:
            with suppress(NoReply, UsageError):
                self.keep(machine, machine.begin_reboot(self.now, returns=returns))

    def ask_description(self) -> None:
        machine = self.machine()
        if machine is not None and not self.listens:
            self.keep(machine, machine.metadata_requests.ask(self.now))

    def file(self) -> None:
        machine, what = self.machine(), self.draw.number() % 5
        if machine is None or self.listens:
            return
        files = machine.files
        job: Operation[Any]
        match what:
            case 0 | 1:
                job = files.read("@PARAM/param.pck", self.now, limit=500)
            case 2:
                job = files.list("/fs", self.now)
            case 3:
                job = files.checksum("/fs/a", self.now)
            case _:
                job = files.write("/fs/a", self.draw.take(self.draw.number()), self.now, write_size=80)
        if isinstance(job, FileRead):
            job.is_of_caller = True
        self.keep(machine, job)

    def cached(self) -> None:
        """Load a cached table, complete or in part."""
        machine, how = self.machine(), self.draw.number()
        if machine is None:
            return
        count = 8
        entries = [self.entry(machine.system, index, count) for index in range(count if how & 1 else how % 8)]
        params = {
            each.param_id: Param(
                *(each.param_id, 0.0, known_type(9), each.param_index),
                *(int.from_bytes(each.raw, "little"), Trust.CACHED),
            )
            for each in entries
        }
        machine.use_cached(
            params,
            self.now,
            count=count,
            confirmed=self.draw.number(4) if how & 2 else None,
            complete=bool(how & 1),
            volatile=frozenset(list(params)[: how >> 2 & 3]),
            volatile_known=bool(how & 4),
        )

    # Building blocks

    def name(self, system: int) -> str:
        kind = self.draw.number()
        if kind >= 0xF0:
            return _prefix(system) + self.draw.take(15).split(b"\0")[0].decode("latin-1")
        return f"{_prefix(system)}{'ABCDEFGHIJKLMNOPQR'[kind % 18]}"

    def entry(self, system: int, index: int, count: int) -> wire.ParamValue:
        """Return the value of a vehicle at an index; its last byte is from the input."""
        raw = b"\0\0" + bytes((0x80, self.draw.number() & 0x3F))
        return wire.ParamValue(f"{_prefix(system)}{'ABCDEFGHIJKLMNOPQR'[index % 18]}", raw, 9, count, index)


def _prefix(system: int) -> str:
    """Return the prefix of a system's parameter names: a capital letter, which ArduPilot does not change."""
    return chr(ord("A") + system % 26)
