"""Extended parameters, `component.ext`, in the calls that set up a vehicle: text, bytes, 64-bit numbers."""

from __future__ import annotations

import pytest

from paramclient import ParamSet, UsageError, VehicleArmed
from paramclient.provision import apply
from paramclient.sim import Air, Camera, PX4Vehicle
from tests.conversations.partial import Partial
from tests.shell import a_client


def small() -> Camera:
    return Camera({"MODE": 1, "NAME": "Front"})


async def test_a_set_of_another_component_or_kind_is_refused() -> None:
    async with a_client(small()) as client:
        component = await client.component(1, 100)
        for target, wanted, why in (
            (component.ext, ParamSet({}, component=101, is_extended=True), "101, not of component 100"),
            (
                component,
                ParamSet({"MODE": 2}, is_extended=True),
                "are extended ones, and plain ones are needed",
            ),
            (component.ext, ParamSet({"MODE": 2}), "are plain ones, and extended ones are needed"),
        ):
            with pytest.raises(UsageError, match=why):
                await apply(target, wanted)


async def test_a_node_without_heartbeat_is_armed_as_its_autopilot() -> None:
    node = Partial(heartbeat=None, component=25)
    async with a_client(Air.symmetric([PX4Vehicle(table={"A": 1}), node])) as client:
        assert (await apply(await client.component(1, 25), {"MODE": 2})).complete


async def test_nothing_is_set_on_the_camera_of_an_armed_vehicle_unless_allowed() -> None:
    async with a_client(Air.symmetric([PX4Vehicle(table={"A": 1}, armed=True), small()])) as client:
        await client.component(1, 1)
        ext = (await client.component(1, 100)).ext
        with pytest.raises(VehicleArmed):
            await apply(ext, {"NAME": "Rear"})
        assert (await apply(ext, {"NAME": "Rear"}, allow_armed=True)).complete
