"""The gateway: each rule by which ground stations are answered from the tables of the service."""

from __future__ import annotations

import anyio

from paramclient.wire import messages
from tests.service.ground_stations import gateway_over
from tests.shell import Tap, in_simulated_time, small_px4

LIST = messages.ParamRequestList(1, 1)


@in_simulated_time
async def test_rule_1_frames_pass() -> None:
    vehicle = Tap(small_px4())
    async with gateway_over(vehicle) as served:
        first, second = served.partner(), served.partner(system=250)
        first.send(messages.Heartbeat(6, 8))
        second.send(messages.Heartbeat(6, 8))
        await served.synced()
        await anyio.sleep(3.0)
        for each in (first, second):
            assert each.of(messages.Heartbeat, system=1)
            assert {frame.system for frame in each.frames} == {1}
        assert {frame.system for _, frame, _ in vehicle.received} == {250, 254, 255}


@in_simulated_time
async def test_rule_2_a_list_is_answered_from_the_table() -> None:
    vehicle = Tap(small_px4())
    async with gateway_over(vehicle) as served:
        await served.synced()
        station = served.partner()
        vehicle.received.clear()
        await station.ask(LIST)
        values = station.of(messages.ParamValue)
        assert values[0].param_id == "_HASH_CHECK"
        assert [each.param_index for each in values[1:]] == list(range(25))
        assert {each.param_count for each in values} == {25}
        assert not vehicle.messages(messages.ParamRequestList)
