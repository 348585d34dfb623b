"""What arrives before the first heartbeat: values of a vehicle of unknown kind, and other messages."""

from __future__ import annotations

from functools import partial

import anyio
from pymavlink.dialects.v20 import common as mavlink

from paramclient.model.values import ParamType
from paramclient.protocol.node import Node
from paramclient.protocol.station import Station
from paramclient.protocol.table import Change
from paramclient.wire import messages
from paramclient.wire.frames import Framer
from paramclient.wire.messages import Heartbeat, Message, ParamValue
from tests.conversations.virtual import run


def test_a_value_before_the_first_heartbeat_is_reported_as_the_vehicle_means_it() -> None:
    async def session() -> None:
        changes: list[Change] = []

        def discovered(node: Node) -> None:
            node.plain.table.changed = changes.append

        async with anyio.create_task_group() as tasks:
            station = Station(
                link="sim:test",
                is_stream=False,
                send=lambda data, peer: None,
                spawn=tasks.start_soon,
                discovered=discovered,
            )
            said = partial(messages.encode, system=1, component=1)

            def hear(message: Message, sequence: int) -> None:
                station.receive(said(message, sequence=sequence), "peer", anyio.current_time())

            cast = b"\x00\x00\x1a\x43"  # 154.0 as float32: how ArduPilot sends the integer 154
            hear(ParamValue("STAT_RUNTIME", cast, ParamType.INT32, 1382, 65535), 0)
            assert changes == []
            hear(Heartbeat(2, 3), 1)
            (change,) = changes
            assert change.new is not None
            assert (change.new.value, change.kind) == (154, "first")
            tasks.cancel_scope.cancel()

    run(session)


def test_the_heartbeat_of_a_vehicle_that_sends_other_messages_is_requested() -> None:
    async def session() -> None:
        sent: list[bytes] = []
        async with anyio.create_task_group() as tasks:
            station = Station(
                link="sim:test",
                is_stream=False,
                send=lambda data, peer: sent.append(data),
                spawn=tasks.start_soon,
            )
            attitude = mavlink.MAVLink_attitude_message(0, 0, 0, 0, 0, 0, 0)
            for number in range(5):
                await anyio.sleep(0.1)
                sender = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
                sender.seq = number
                station.receive(attitude.pack(sender), "peer", anyio.current_time())
            requests = [
                messages.decode(frame) for data in sent for frame in Framer(stream=False).receive(data)
            ]
            assert requests == [messages.CommandLong(7, 1, messages.MAV_CMD_REQUEST_MESSAGE, 0.0)] * 2
            tasks.cancel_scope.cancel()

    run(session)
