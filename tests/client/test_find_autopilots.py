"""`ParamClient.find_autopilots`: all vehicles on a link, or an expected number."""

from __future__ import annotations

import pytest

from paramclient import NoReply, UsageError
from paramclient.client.client import VEHICLES_LISTENING_TIME
from paramclient.sim import Air
from tests.shell import Late, a_client, generic, in_simulated_time, simulated_time_loop, small_px4


def fleet() -> Air:
    """Four vehicles, found one after the other, and a camera of the first."""
    vehicles = [Late(small_px4(system=number), 0.7 * number) for number in (1, 2, 3, 4)]
    return Air([*vehicles, generic(system=1, component=100)])


@in_simulated_time
async def test_the_expected_vehicles_are_returned_as_soon_as_they_are_heard() -> None:
    began = simulated_time_loop().now
    async with a_client(fleet()) as client:
        found = await client.find_autopilots(expect=4)
        assert [each.system for each in found] == [1, 2, 3, 4]
        assert simulated_time_loop().now - began < 3.5
        assert await client.find_autopilots(expect=4, timeout=0.5) == found


@in_simulated_time
async def test_fewer_vehicles_than_expected_are_an_error_that_names_them() -> None:
    async with a_client(fleet()) as client:
        with pytest.raises(NoReply) as caught:
            await client.find_autopilots(expect=5, timeout=6.0)
        heard = ", ".join(f"{system}/1 PX4 quadrotor" for system in (1, 2, 3, 4))
        assert heard in str(caught.value)
        assert caught.value.waited == pytest.approx(6.0, abs=0.2)


@in_simulated_time
async def test_without_a_number_all_that_are_heard_in_3_s_are_returned() -> None:
    async with a_client(fleet()) as client:
        began = simulated_time_loop().now
        found = await client.find_autopilots()
        assert [each.system for each in found] == [1, 2, 3, 4]
        assert simulated_time_loop().now - began >= VEHICLES_LISTENING_TIME


@in_simulated_time
async def test_no_vehicle_is_an_error_and_none_cannot_be_expected() -> None:
    async with a_client(Air([])) as client:
        for expect in (None, 2):
            with pytest.raises(NoReply):
                await client.find_autopilots(expect=expect, timeout=0.5)
        with pytest.raises(UsageError, match="from 1 up, not 0"):
            await client.find_autopilots(expect=0)
