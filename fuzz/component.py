"""Fuzz target: a station that receives arbitrary frames, with conversations in any order, in virtual time.

The frames are built from the input with a valid checksum, so that they reach the protocol; small sets of
names and addresses make them match pending requests. Limits are reduced so that inputs can reach them.
"""

from __future__ import annotations

import asyncio
import math
import selectors
from collections.abc import Awaitable, Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final
from unittest import mock

import anyio
import anyio.abc
import anyio.lowlevel

from fuzz.draw import Draw
from paramclient.errors import LinkError, ParamClientError
from paramclient.model.values import Encoding, Param, ParamType, Trust, Value, is_portable_name
from paramclient.protocol import session as session_module
from paramclient.protocol import station as station_module
from paramclient.protocol import table as table_module
from paramclient.protocol.commands import reboot, request_message
from paramclient.protocol.fetch import FetchResult, Policy, fetch_all
from paramclient.protocol.ftp import checksum, read_file
from paramclient.protocol.node import Node
from paramclient.protocol.reads import read
from paramclient.protocol.session import Session
from paramclient.protocol.station import Station
from paramclient.protocol.writes import write
from paramclient.wire import messages
from paramclient.wire.frames import Framer
from paramclient.wire.messages import HASH_CHECK, NO_INDEX, Message

__all__ = ["INPUT_SIZE_MAX", "run"]

INPUT_SIZE_MAX: Final = 400
"""Maximum bytes of an input: longer ones are slow and find nothing new."""

BOUNDS: Final = (
    (station_module, "COMPONENTS_MAX", 5),
    (station_module, "STREAM_PEERS_MAX", 3),
    (table_module, "NAMES_MAX", 12),
    (session_module, "FOREIGN_SETS_MAX", 4),
)
LISTENS: Final = 0xE0
"""Lowest first byte of an input that stands for a listen-only station."""
OWN: Final = (255, 190)
SYSTEMS: Final = (1, 1, 1, 2, 3, 4, 255, 0)
COMPONENTS: Final = (1, 1, 100, 190)
COUNTS: Final = (8, 8, 8, 9, 3, 0, 1, 65534, 65535)
KINDS: Final = (9, 6, 1, 4, 5, 2, 3, 7, 8, 10, 0, 11, 255)
AUTOPILOTS: Final = (12, 3, 0, 8)
VALUES: Final[tuple[Value, ...]] = (0.0, 1, -1.5, 300, 1e39, math.nan, b"\1\2\3\4", -0.0)
PAUSES: Final = (0.0, 0.001, 0.02, 0.1, 0.3, 1.0, 2.5, 5.1, 20.0, 70.0, 120.0)
CALLS_MAX: Final = 12
"""Conversations at once."""
TURNS_MAX: Final = 50_000
"""Turns of the event loop at one time that count as an endless loop."""
SENT_MAX: Final = 2_000
"""Frames in one second: twelve conversations, each with a window of requests in several copies."""
CALL_TIMEOUT: Final = 600.0
"""Seconds of silence within which every conversation has ended."""


class _Selector(selectors.SelectSelector):
    """Waits for nothing: the time of the wait passes immediately."""

    passed = 0.0
    turns = 0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        assert timeout is not None, "nothing is due any more"
        self.turns = 0 if timeout > 0 else self.turns + 1
        assert self.turns < TURNS_MAX, "the time stands still"
        self.passed += timeout
        return super().select(0)


class _Loop(asyncio.SelectorEventLoop):
    def __init__(self) -> None:
        self._waits = _Selector()
        super().__init__(self._waits)

    def time(self) -> float:
        return self._waits.passed


@dataclass(eq=False)
class _Call:
    """A conversation.

    Attributes:
        ends: whether it ends without an answer.
    """

    ends: bool
    scope: anyio.CancelScope = field(default_factory=anyio.CancelScope)
    is_done: bool = False


def run(data: bytes) -> None:
    """Run a session. No error is raised, no request hangs, no table has another component's parameters."""
    with ExitStack() as stack:
        for room, name, bound in BOUNDS:
            stack.enter_context(mock.patch.object(room, name, bound))
        anyio.run(_Session(Draw(data)).run, backend_options={"loop_factory": _Loop})


class _Session:
    station: Station
    _tasks: anyio.abc.TaskGroup

    def __init__(self, draw: Draw) -> None:
        options = draw.number()
        self.draw = draw
        self.is_paused = False
        self.listens = options >= LISTENS
        self.policy = (Policy.AUTO, Policy.AUTO, Policy.HASH_ONLY, Policy.CACHE_ONLY)[options >> 3 & 3]
        if self.listens:
            self.policy = Policy.CACHE_ONLY
        self._is_stream = bool(options & 1)
        self._encoding = (None, None, Encoding.BYTEWISE, Encoding.C_CAST)[options >> 5 & 3]
        self.sequence = 0
        self.calls: list[_Call] = []
        self.requests: list[Message] = []
        self.sent = 0
        self._second = 0.0
        self.framer = Framer(messages.DECODED_IDS, stream=False)
        self.steps = (
            *(self.value, self.value, self.values, self.heartbeat, self.version, self.answer, self.answer),
            *(self.file_answer, self.param_error, self.acknowledge, self.denied, self.clock, self.satellite),
            *(self.foreign_set, self.raw, self.hash, self.wait, self.wait, self.wait_shortly),
            *(self.fetch, self.read, self.write, self.cancel, self.restart, self.file, self.cached),
            *(self.interrupt, self.description, self.ask_description),
        )

    async def run(self) -> None:
        async with anyio.create_task_group() as self._tasks:
            self.station = Station(
                link="fuzz",
                is_stream=self._is_stream,
                send=self.take_sent,
                spawn=self._tasks.start_soon,
                encoding=self._encoding,
                listens_only=self.listens,
            )
            self._tasks.start_soon(self.station.send_heartbeats)
            while not self.draw.is_over:
                result = self.draw.one_of(self.steps)()
                if result is not None:
                    await result
                await anyio.lowlevel.checkpoint()
                self.check_all()
            await self.end()
            self._tasks.cancel_scope.cancel()

    async def end(self) -> None:
        """Receive nothing more: all conversations end, except those that only a caller's timeout ends."""
        if self.is_paused:
            self.interrupt()
        for call in self.calls:
            if not call.ends:
                call.scope.cancel()
        with anyio.move_on_after(CALL_TIMEOUT):
            while not all(call.is_done for call in self.calls):  # noqa: ASYNC110 - a check, not an event
                await anyio.sleep(1.0)
        assert all(call.is_done for call in self.calls), "a conversation does not end"
        self.check_all()

    def take_sent(self, data: bytes, peer: object) -> None:
        assert not self.listens
        now = anyio.current_time()
        if now >= self._second + 1.0:
            self._second, self.sent = now, 0
        self.sent += 1
        assert self.sent <= SENT_MAX, f"{self.sent} frames in one second"
        (frame,) = self.framer.receive(data)
        message = messages.decode(frame)
        assert message is not None
        if not isinstance(message, messages.Heartbeat):
            self.requests.append(message)
            del self.requests[:-20]

    def check_all(self) -> None:
        assert len(self.station.nodes) <= 5
        for node in self.station.nodes.values():
            self.check(node)

    def check(self, node: Node) -> None:
        held = node.plain.table
        assert (node.system, node.component) != self.station.own_address or self.listens
        assert node.system != 0
        assert len(held.params) <= 12
        prefix = _prefix(node.system)
        for name, param in held.params.items():
            assert param.name == name
            assert name.startswith(prefix), f"{name} in the table of {node.system}/{node.component}"
            assert param.index is None or 0 <= param.index < NO_INDEX

    # Received frames

    def hear(self, message: Message, system: int | None = None, component: int | None = None) -> None:
        draw = self.draw
        if system is None or component is None:
            system, component = draw.one_of(SYSTEMS), draw.one_of(COMPONENTS)
        self.sequence = (self.sequence + 1) % 256
        way = draw.number()
        version = (
            1 if way & 4 and not isinstance(message, messages.ParamError | messages.ComponentMetadata) else 2
        )
        data = messages.encode(
            message, system=system, component=component, sequence=self.sequence, version=version
        )
        if not self.is_paused:
            self.station.receive(data, way & 3, anyio.current_time())

    def heartbeat(self) -> None:
        kind, autopilot = self.draw.one_of((2, 2, 6, 26)), self.draw.one_of(AUTOPILOTS)
        self.hear(messages.Heartbeat(kind, autopilot, self.draw.number(), 0, self.draw.number() % 9))

    def version(self) -> None:
        draw = self.draw
        capabilities = draw.one_of((0, 16, 32, 48, 131072, 32 | 131072))
        uid, firmware = draw.number() % 4, draw.one_of((0x01110000, 0x01120000, 0))
        self.hear(messages.AutopilotVersion(capabilities, firmware, bytes(8), uid=uid))

    def value(self) -> None:
        draw = self.draw
        system, component = draw.one_of(SYSTEMS), draw.one_of(COMPONENTS)
        count, index = draw.one_of(COUNTS), draw.one_of((*range(9), 65534, 65535))
        message = messages.ParamValue(self.name(system), draw.take(4), draw.one_of(KINDS), count, index)
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
        node = self.station.nodes.get((system, component))
        known = None if node is None or self.draw.number() % 4 == 0 else node.plain.table.hash
        raw = self.draw.take(4) if known is None else known.to_bytes(4, "little")
        message = messages.ParamValue(HASH_CHECK, raw, 5, self.draw.one_of(COUNTS), NO_INDEX)
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
            case messages.ParamRequestRead(param_id=name, param_index=-1) if name.startswith(_prefix(system)):
                self.hear(messages.ParamValue(name, self.draw.take(4), 9, 8, NO_INDEX), system, component)
            case messages.ParamRequestRead(param_index=index) if index >= 0:
                self.hear(self.entry(system, index, 8), system, component)
            case messages.ParamRequestList():
                for index in range(8):
                    self.hear(self.entry(system, index, 8), system, component)
            case messages.ParamSet(param_id=name, raw=raw, param_type=kind):
                self.hear(messages.ParamValue(name, raw, kind, 8, NO_INDEX), system, component)
            case messages.CommandLong(command=command):
                self.hear(messages.CommandAck(command, self.draw.number() % 7, *OWN), system, component)
            case messages.FileTransfer():
                self.answer_file(request, system, component)

    def file_answer(self) -> None:
        """Receive a MAVFTP response, requested or not."""
        for request in reversed(self.requests):
            if isinstance(request, messages.FileTransfer):
                self.answer_file(request, request.target_system, self.draw.one_of(COMPONENTS))
                return
        self.hear(messages.FileTransfer(0, *OWN, self.draw.take(251)))

    def answer_file(self, request: messages.FileTransfer, system: int, component: int) -> None:
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
            messages.FileTransfer(0, *draw.one_of((OWN, OWN, (0, 0), (254, 190))), payload), system, component
        )

    def param_error(self) -> None:
        draw = self.draw
        system, component = draw.one_of(SYSTEMS), draw.one_of(COMPONENTS)
        index, error = draw.one_of((-1, 0, 1, 5, 7, 32767)), draw.number() % 10
        target = draw.one_of((OWN, (0, 0), (254, 190)))
        self.hear(messages.ParamError(*target, self.name(system), index, error), system, component)

    def acknowledge(self) -> None:
        command, result = self.draw.one_of((512, 520, 246)), self.draw.number() % 8
        self.hear(messages.CommandAck(command, result, *self.draw.one_of((OWN, (0, 0), (254, 190)))))

    def denied(self) -> None:
        system, component = self.draw.one_of(SYSTEMS), self.draw.one_of(COMPONENTS)
        text = f"Param write denied ({self.name(system)})"[: self.draw.number() % 51]
        self.hear(messages.StatusText(3, text), system, component)

    def clock(self) -> None:
        self.hear(
            messages.SystemTime(self.draw.number(2), self.draw.one_of((0, 1000, 60_000, (1 << 32) - 1)))
        )

    def satellite(self) -> None:
        self.hear(messages.HighLatency2(2, self.draw.one_of(AUTOPILOTS)))

    def description(self) -> None:
        self.hear(messages.ComponentMetadata("mftp://a" if self.draw.number() & 1 else "", 7))

    def foreign_set(self) -> None:
        draw = self.draw
        system, component = draw.one_of(SYSTEMS), draw.one_of(COMPONENTS)
        self.hear(messages.ParamSet(system, component, self.name(system), draw.take(4), 9))

    def raw(self) -> None:
        data = self.draw.take(self.draw.number() % 48)
        if not self.is_paused:
            self.station.receive(data, self.draw.number() % 4, anyio.current_time())

    # Time

    async def wait(self) -> None:
        await anyio.sleep(self.draw.one_of(PAUSES))

    async def wait_shortly(self) -> None:
        await anyio.sleep(self.draw.number() / 100)

    def interrupt(self) -> None:
        """Interrupt the link, or restore it."""
        self.is_paused = not self.is_paused
        if self.is_paused:
            self.station.interrupt()
        else:
            self.station.resume(anyio.current_time())

    # Conversations

    def node(self) -> Node | None:
        known = list(self.station.nodes.values())
        return self.draw.one_of(known) if known else None

    def start(self, work: Callable[[], Awaitable[Any]], *, ends: bool = True) -> None:
        if self.listens:
            return
        call = _Call(ends)
        self.calls = [each for each in self.calls if not each.is_done]
        if len(self.calls) >= CALLS_MAX:
            self.calls.pop(0).scope.cancel()
        self.calls.append(call)
        self._tasks.start_soon(self._converse, call, work)

    async def _converse(self, call: _Call, work: Callable[[], Awaitable[Any]]) -> None:
        try:
            with call.scope:
                result = await work()
                if isinstance(result, FetchResult):
                    assert result.received + len(result.missing) == result.count
                    assert all(0 <= index < result.count for index in result.missing)
        except ParamClientError as error:
            assert not isinstance(error, LinkError)
        finally:
            call.is_done = True

    def fetch(self) -> None:
        node, how = self.node(), self.draw.number()
        if node is not None:
            refresh = bool(how & 32) and self.policy is Policy.AUTO
            self.start(partial(fetch_all, self.session(node), refresh=refresh, policy=self.policy))

    def read(self) -> None:
        node, key = self.node(), self.draw.one_of((None, None, HASH_CHECK, 0, 3, 7, 8, 32767))
        if node is not None:
            key = self.name(node.system) if key is None else key
            if isinstance(key, int) or is_portable_name(key):
                self.start(partial(read, self.session(node), key))

    def write(self) -> None:
        node = self.node()
        if node is not None:
            name = self.name(node.system)
            if is_portable_name(name):
                self.start(partial(write, self.session(node), name, self.draw.one_of(VALUES)))

    def cancel(self) -> None:
        if self.calls:
            self.calls.pop(self.draw.number() % len(self.calls)).scope.cancel()

    def restart(self) -> None:
        node, returns = self.node(), bool(self.draw.number() & 1)
        if node is not None:
            self.start(partial(reboot, node, returns=returns), ends=False)

    def ask_description(self) -> None:
        if (node := self.node()) is not None:
            self.start(partial(request_message, node.channel, messages.ComponentMetadata))

    def file(self) -> None:
        node, what = self.node(), self.draw.number() % 3
        if node is None:
            return
        if what < 2:
            self.start(partial(read_file, node.channel, "@PARAM/param.pck", size_max=500))
        else:
            self.start(partial(checksum, node.channel, "/fs/a"))

    def cached(self) -> None:
        """Load a cached table, complete or in part."""
        node, how = self.node(), self.draw.number()
        if node is None:
            return
        count = 8
        entries = [self.entry(node.system, index, count) for index in range(count if how & 1 else how % 8)]
        params = [
            Param(
                *(each.param_id, 0.0, ParamType(9), each.param_index),
                *(int.from_bytes(each.raw, "little"), Trust.CACHED),
            )
            for each in entries
        ]
        node.plain.table.load(
            params,
            count=count if how & 1 else None,
            hash=self.draw.number(4) if how & 2 else None,
            volatile=[each.name for each in params[: how >> 2 & 3]],
            volatile_is_known=bool(how & 4),
            moments=dict.fromkeys((each.name for each in params), anyio.current_time()),
        )

    def session(self, node: Node) -> Session:
        return node.plain if self.draw.number() % 8 else node.extended

    # Building blocks

    def name(self, system: int) -> str:
        kind = self.draw.number()
        if kind >= 0xF0:
            return _prefix(system) + self.draw.take(15).split(b"\0")[0].decode("latin-1")
        return f"{_prefix(system)}{'ABCDEFGHIJKLMNOPQR'[kind % 18]}"

    def entry(self, system: int, index: int, count: int) -> messages.ParamValue:
        """Return the value of a vehicle at an index; its last byte is from the input."""
        raw = b"\0\0" + bytes((0x80, self.draw.number() & 0x3F))
        return messages.ParamValue(
            f"{_prefix(system)}{'ABCDEFGHIJKLMNOPQR'[index % 18]}", raw, 9, count, index
        )


def _prefix(system: int) -> str:
    """Return the prefix of a system's parameter names: a capital letter, which ArduPilot does not change."""
    return chr(ord("A") + system % 26)
