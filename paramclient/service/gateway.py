"""The gateway: every ground station is answered from the tables that the service keeps.

Ground stations connect to an endpoint as to a vehicle. All frames pass, and the parameter conversation is
answered from the table: one download over the vehicle's link serves all stations.
"""

from __future__ import annotations

import logging
from collections.abc import Hashable, Iterable, Iterator, Sequence
from contextlib import AsyncExitStack
from dataclasses import replace
from functools import cache, partial
from typing import Final, TypeAlias

import anyio

from paramclient.client.client import ParamClient
from paramclient.client.taps import SeenFrame, Tap
from paramclient.protocol.ftp import Opcode, Packet
from paramclient.protocol.node import Node
from paramclient.protocol.session import Session
from paramclient.service.kept_file import KeptFile
from paramclient.service.kept_table import Asker, KeptTable
from paramclient.service.stations import GroundStation, MavlinkEndpoint, Source
from paramclient.wire import messages
from paramclient.wire.frames import TARGET_OFFSETS, Frame, bears_key
from paramclient.wire.messages import COMP_ID_ALL, Message, decode, encode, message_id

GATEWAY_ADDRESS: Final = (254, 191)
"""System and component id of the gateway (MAV_COMP_ID_ONBOARD_COMPUTER): not those of a ground station, so
that vehicles notice when they lose all of these."""
GROUND_STATION_SYSTEM: Final = 255
"""The system id of ground stations by default, and of a client."""
OWN_TYPE: Final = 18
"""MAV_TYPE_ONBOARD_CONTROLLER, for the same reason."""
GROUND_STATION_PARAMS: Final = frozenset({"SYSID_MYGCS", "MAV_GCS_SYSID"})
"""ArduPilot's parameter with the system id of its ground station, whose heartbeats it watches; one with `_HI`
behind this name has the last of several."""
TAKE_OVER_TIME: Final = 10.0
"""Seconds after which a list that was asked before the vehicle was heard is not expected any more."""
LOOP_TIME: Final = 2.0
"""Seconds after which a frame that was sent is not taken for its own copy any more."""

ListRequest: TypeAlias = messages.ParamRequestList | messages.ParamExtRequestList
ReadRequest: TypeAlias = messages.ParamRequestRead | messages.ParamExtRequestRead
SetRequest: TypeAlias = messages.ParamSet | messages.ParamExtSet
Request: TypeAlias = ListRequest | ReadRequest | SetRequest | messages.FileTransfer
"""Messages of a station that the gateway answers."""
PLAIN_ANSWERS: Final = {message_id(messages.ParamValue), message_id(messages.ParamError)}
EXTENDED_REQUESTS: Final = (messages.ParamExtRequestList, messages.ParamExtRequestRead, messages.ParamExtSet)
EXTENDED_ANSWERS: Final = {message_id(messages.ParamExtValue), message_id(messages.ParamExtAck)}
HEARTBEAT: Final = message_id(messages.Heartbeat)
FILE_TRANSFER: Final = message_id(messages.FileTransfer)
HARMLESS: Final = frozenset({HEARTBEAT, message_id(messages.SystemTime), 4, 66, 111})
"""What passes from the stations of a read-only endpoint, with PING, REQUEST_DATA_STREAM and TIMESYNC."""
COMMANDS: Final = {75: 28, 76: 28, 77: 0}
"""COMMAND_INT, COMMAND_LONG and COMMAND_ACK: where they have the command."""
HARMLESS_COMMANDS: Final = (messages.MAV_CMD_REQUEST_MESSAGE, messages.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES)
HARMLESS_OPCODES: Final = {*Opcode} - {Opcode.CREATE_FILE, Opcode.WRITE_FILE, Opcode.OPEN_FILE_WO}
"""The requests of MAVFTP that write nothing."""

logger = logging.getLogger(__name__)


class Gateway:
    """The ground stations at some endpoints, and the clients of the vehicles' links.

    `open` the gateway and `run` it; `attach` each client before it is opened. Clients may come and go.

    Args:
        endpoints: where stations connect.

    Attributes:
        endpoints: as given.
        links: the open links to vehicles.
    """

    def __init__(self, endpoints: Iterable[MavlinkEndpoint]) -> None:
        self.endpoints = list(endpoints)
        self.links: list[VehicleLink] = []
        self.copies = _Copies()
        self._warned: set[Source] = set()
        for endpoint in self.endpoints:
            endpoint.sending = self.copies.sent_down

    @property
    def stations(self) -> list[GroundStation]:
        """All connected stations."""
        return [station for endpoint in self.endpoints for station in endpoint.stations.values()]

    def attach(self, client: ParamClient) -> ParamClient:
        """Serve the vehicles of a client, which is not open yet, and return it. It is no ground station any
        more."""
        station = client.core.station
        station.own_type = OWN_TYPE
        if station.own_address[0] == GROUND_STATION_SYSTEM:
            station.own_address = GATEWAY_ADDRESS
        link = VehicleLink(self, client)
        client.core.add_tap(link)
        client.core.link_task.accepts = link.accepts
        return client

    async def open(self) -> None:
        """Open the endpoints.

        Raises:
            LinkError: one cannot be opened, and none is open then.
        """
        async with AsyncExitStack() as opened:
            for endpoint in self.endpoints:
                opened.push_async_callback(endpoint.link.close)
                await endpoint.open()
            opened.pop_all()

    async def run(self) -> None:
        """Serve the stations at the open endpoints, until cancelled."""
        async with anyio.create_task_group() as tasks:
            for endpoint in self.endpoints:
                tasks.start_soon(endpoint.run, self._take)

    def pass_on(self, link: VehicleLink, seen: SeenFrame, peer: Hashable) -> None:
        """Pass a frame of a vehicle to all stations, but for answers to the gateway."""
        table = link.table_of_answer(seen, peer)
        if bears_key(seen.data) or (table is None and self.copies.is_copy(seen.data, (link, peer))):
            return
        for station in self.stations:
            is_served = table is not None and self._serves(station, table, link)
            station.relay(seen, is_withheld=is_served)
            at, address, extended, taken = station.list_asked  # before the vehicle was heard
            is_new = is_served and anyio.current_time() - at < TAKE_OVER_TIME and table not in taken
            if table is not None and is_new and table in link.tables(*address, extended=extended):
                taken.add(table)
                table.send_list(station)

    def announce(self, link: VehicleLink, table: KeptTable, message: Message) -> None:
        """Send a value that has changed to all stations."""
        for station in self.stations:
            if self._serves(station, table, link):
                station.say(message, table.source, is_answer=False)

    def doubt(self, system: int, *names: str, extended: bool = False) -> None:
        """Doubt all values of a system, or those with these names: what changes them may not be announced."""
        for link in self.links:
            for table in link.tables(system, COMP_ID_ALL, extended=extended):
                table.doubt(*names)

    # requests

    def _take(self, station: GroundStation, seen: SeenFrame) -> None:
        """Take a frame of a station: answer it, or pass it to the vehicles."""
        frame = seen.frame
        source = (frame.system, frame.component)
        is_vehicle = any(link.is_vehicle(source) for link in self.links)
        if bears_key(seen.data) or is_vehicle or self.copies.returns_by(station, seen.data):
            return
        for link in self.links:
            link.avoid(frame.system)
        message = decode(frame)
        if isinstance(message, Request):
            station.requests[type(message).__name__] += 1
            if self._answer(station, source, message, seen):
                return
        if not station.endpoint.is_readonly or _is_harmless(frame, message):
            self._pass(station, seen)
            names = (message.param_id,) if isinstance(message, SetRequest) else ()  # its answer may be lost
            if names or _is_reset(frame):
                self.doubt(_target_of(frame), *names, extended=isinstance(message, EXTENDED_REQUESTS))

    def _answer(self, station: GroundStation, source: Source, message: Request, seen: SeenFrame) -> bool:
        """Answer a request about parameters; return False for one that passes to the vehicles.

        One to whichever vehicle passes if there are several; one that may be for the autopilot does, also
        beside answers of others, if that is not served. Before one is heard, such a request does not pass:
        the vehicle would send its list, or open its file, beside the gateway's own fetch.
        """
        address = (message.target_system, message.target_component)
        extended = isinstance(message, EXTENDED_REQUESTS)
        found = {table: link for link in self.links for table in link.tables(*address, extended=extended)}
        served = [table for table, link in found.items() if self._serves(station, table, link)]
        autopilots = [table for table in found if table.source[1] == messages.AUTOPILOT_COMPONENT]
        systems = {table.source[0] for table in found}
        if not served or (len(systems) > 1 and isinstance(message, SetRequest | messages.FileTransfer)):
            if isinstance(message, ListRequest):
                station.list_asked = (anyio.current_time(), address, extended, set())
            return not (found or message.target_system)
        present = [table for table in served if not table.is_lost]
        one = [table for table in autopilots or present if table in present][:1]  # for all that receive it
        asker = Asker(station, *source)
        match message:
            case messages.ParamRequestList() | messages.ParamExtRequestList():
                for table in present:
                    table.send_list(station)
                for table, link in found.items():
                    if table not in served:
                        link.send(_readdressed(message, seen.frame, table.source))
            case messages.ParamRequestRead() | messages.ParamExtRequestRead():
                which = message.param_id if message.param_index < 0 else message.param_index
                for table in [each for each in present if each.known(which) is not None] or one:
                    table.read(asker, which)
            case messages.ParamSet() | messages.ParamExtSet():
                if message.param_id != messages.HASH_CHECK:  # it would stop the gateway's own list
                    for table in one:
                        table.set(asker, message)
            case messages.FileTransfer(payload=payload):
                for table in one:
                    return found[table].file(table).take(asker, payload, lambda: self._pass(station, seen))
        return {*autopilots} <= {*served} or isinstance(message, ListRequest)

    def _serves(self, station: GroundStation, table: KeptTable, link: VehicleLink) -> bool:
        """Return whether requests of a station to a component are answered from its table."""
        if not table.is_kept or (table.source in link.signing and not station.endpoint.may_sign):
            return False
        is_double = sum(each.is_vehicle(table.source) for each in self.links) > 1
        if is_double and table.source not in self._warned:
            self._warned.add(table.source)
            logger.warning("%d/%d is on two links: stations are not answered from its table", *table.source)
        return not is_double

    def _pass(self, station: GroundStation, seen: SeenFrame) -> None:
        """Send a frame to the links on which its target was heard; to all for an unknown one, and for all."""
        self.copies.sent_up(seen.data, station)
        self.copies.sent_down(seen.data)  # no traffic between stations, not even by a vehicle's link
        system = _target_of(seen.frame)
        heard = [link for link in self.links if system in link.systems]
        for link in heard if system and heard else self.links:
            link.send(seen.data)


class VehicleLink(Tap):
    """A link to vehicles, as its client has opened it.

    Args:
        gateway: the gateway.
        client: of the link.

    Attributes:
        client: as given.
        send: sends a frame of a station to the vehicles.
        systems: the system ids that were heard.
        signing: the components that sign, and all where the gateway does: it signs for no unsigned station.
        file: returns the parameter file of a table.
    """

    def __init__(self, gateway: Gateway, client: ParamClient) -> None:
        self.systems: set[int] = set()
        self.signing: set[Source] = set()
        self._gateway = gateway
        self.client = client
        self.send = client.core.link_task.forward
        self._station = client.core.station
        self._tables: dict[Session, KeptTable] = {}
        self.file = cache(KeptFile)

    async def run(self) -> None:
        """Take part in the gateway while the client is open."""
        self._gateway.links.append(self)
        try:
            await anyio.sleep_forever()
        finally:
            self._gateway.links.remove(self)

    def accepts(self, data: bytes, peer: Hashable) -> bool:
        """Return whether received data is no datagram of the gateway that has come back over another peer."""
        peers = (node.peer for node in self._station.nodes.values())
        return self._gateway.copies.origin_of(hash(data)) is None or peer in peers

    def sent(self, frame: bytes) -> None:
        """Take note of a frame to the vehicles."""
        self._gateway.copies.sent_up(frame)

    def received(self, frames: Sequence[SeenFrame], size: int, peer: Hashable) -> None:
        """Pass the frames of a chunk on; the client has taken them before."""
        for seen in frames:
            source = (seen.frame.system, seen.frame.component)
            if source != self._station.own_address:
                self.systems.add(source[0])
                if seen.is_signed or self._station.verifier is not None:
                    self.signing.add(source)
                node = self._station.nodes.get(source)
                if _is_reset(seen.frame):
                    self._gateway.doubt(source[0])  # again: values from before were on their way
                if seen.frame.message_id == HEARTBEAT and node is not None:
                    for table in (self._table(node, extended=each) for each in (False, True)):
                        table.heartbeat, table.beats = decode(seen.frame), table.beats + 1
                    params = node.plain.table.params
                    for name in params.keys() & GROUND_STATION_PARAMS:
                        last = params.get(f"{name}_HI", params[name])
                        self.avoid(float(params[name].value), float(last.value))
                self._gateway.pass_on(self, seen, peer)

    def avoid(self, first: float, last: float = 0.0) -> None:
        """Take another system id if ground stations have ours, or a vehicle watches it as that of one."""
        own, component = self._station.own_address
        if first <= own <= max(first, last):
            systems = {source[0] for each in self._gateway.stations for source in each.sources} | self.systems
            free = (each for each in range(own - 1, 0, -1) if each < first and each not in systems)
            self._station.own_address = (next(free, own), component)

    def is_vehicle(self, source: Source) -> bool:
        """Return whether a component with parameters is heard under these ids."""
        node = self._station.nodes.get(source)
        return node is not None and node.identification.has_parameters and not node.presence.is_lost

    def tables(self, system: int, component: int, *, extended: bool) -> Iterator[KeptTable]:
        """Return the tables of the components with an address; 0 stands for all."""
        for node in list(self._station.nodes.values()):
            is_meant = system in (0, node.system) and component in (COMP_ID_ALL, node.component)
            if is_meant and node.identification.has_parameters:
                yield self._table(node, extended=extended)

    def table_of_answer(self, seen: SeenFrame, peer: Hashable) -> KeptTable | None:
        """Return the table to which a withheld value or answer belongs; None for a frame that passes."""
        frame = seen.frame
        own, node = self._station.own_address, self._station.nodes.get((frame.system, frame.component))
        if node is None or node.peer != peer:
            return None
        tables = [self._table(node, extended=each) for each in (False, True)]  # from its first frame on
        is_extended = frame.message_id in EXTENDED_ANSWERS
        # some PX4s answer to no component, or to the one that was asked
        is_for_us = frame.payload[1:3] == bytes(own) or _target_of(frame) == own[0] != frame.system
        is_plain = frame.message_id in PLAIN_ANSWERS or (frame.message_id == FILE_TRANSFER and is_for_us)
        table = tables[is_extended]
        return table if (is_extended or is_plain) and table.withholds else None

    def _table(self, node: Node, *, extended: bool) -> KeptTable:
        session = node.extended if extended else node.plain
        if session not in self._tables:
            component = self.client.components[node.system, node.component]
            announce = partial(self._gateway.announce, self)
            self._tables[session] = KeptTable(component.ext if extended else component, announce)
        return self._tables[session]


class _Copies:
    """Recognizes frames that have come back: a link or an endpoint leads to the gateway itself.

    Vehicles and stations send equal frames too, such as heartbeats: only those of another origin are copies.
    """

    def __init__(self) -> None:
        self._recent: dict[int, Hashable] = {}
        self._earlier: dict[int, Hashable] = {}
        self._turned_at = 0.0

    def sent_down(self, data: bytes) -> None:
        """Take note of a frame, or of a whole datagram, that is sent to a station."""
        self._note(_key_of(data), self)
        self._note(hash(data), self)

    def sent_up(self, data: bytes, origin: Hashable = None) -> None:
        """Take note of a frame that is sent to vehicles, by a station or by the gateway."""
        self._note(hash(data), origin or self)

    def returns_by(self, station: GroundStation, data: bytes) -> bool:
        """Return whether these bytes were sent a moment ago by another one, and a station only returns them.

        Programs with equal ids send equal frames, such as their first ones. In a loop, a station also brings
        what the gateway has sent, or the frame of another station again and again.
        """
        origin, again = self.origin_of(hash(data), station), hash((data, station))
        if origin != station and not station.is_loop:
            station.is_loop = origin is self or self.origin_of(again) is not None
            self._note(again, station)
        return origin != station and station.is_loop

    def is_copy(self, data: bytes, origin: Hashable) -> bool:
        """Return whether a frame was sent to a station, or came from another origin, a moment ago.

        Vehicles' frames are renumbered for each station, so that their numbers are not compared.
        """
        key = _key_of(data)
        if self.origin_of(key, origin) != origin:
            return True  # and no note of it: a vehicle that has moved is heard again after a moment
        self._recent[key] = origin
        return False

    def _note(self, key: int, origin: Hashable) -> None:
        self._recent.setdefault(key, self.origin_of(key, origin))

    def origin_of(self, key: int, default: Hashable = None) -> Hashable:
        """Return what has sent a frame, or a datagram, with this key a moment ago."""
        now = anyio.current_time()
        if now - self._turned_at > LOOP_TIME:
            self._turned_at = now
            self._recent, self._earlier = {}, self._recent
        return self._recent.get(key, self._earlier.get(key, default))


def _key_of(data: bytes) -> int:
    """Return the hash of a frame without its sequence number and checksum."""
    if data[0] == 0xFD:
        return hash(data[:4] + data[5 : 10 + data[1]])
    return hash(data[:2] + data[3 : 6 + data[1]])


def _target_of(frame: Frame) -> int:
    """Return the target system of a frame; 0 for all, and for a message without one."""
    at = TARGET_OFFSETS.get(frame.message_id, len(frame.payload))
    return frame.payload[at] if at < len(frame.payload) else 0


def _is_reset(frame: Frame) -> bool:
    """Return whether a frame is the command that may reset all parameters, or its acknowledgement."""
    at = COMMANDS.get(frame.message_id, len(frame.payload))
    return int.from_bytes(frame.payload[at : at + 2], "little") == messages.MAV_CMD_PREFLIGHT_STORAGE


def _readdressed(message: ListRequest, frame: Frame, target: Source) -> bytes:
    """Return a request for a list to one component, in the name of the station."""
    single = replace(message, target_system=target[0], target_component=target[1])
    sender = {"system": frame.system, "component": frame.component, "version": frame.version}
    return encode(single, sequence=frame.sequence, **sender)


def _is_harmless(frame: Frame, message: Message | None) -> bool:
    """Return whether a frame changes nothing on a vehicle."""
    if isinstance(message, messages.CommandLong):
        return message.command in HARMLESS_COMMANDS
    if isinstance(message, messages.FileTransfer):
        return Packet.unpack(message.payload).opcode in HARMLESS_OPCODES
    return isinstance(message, ListRequest | ReadRequest) or frame.message_id in HARMLESS
