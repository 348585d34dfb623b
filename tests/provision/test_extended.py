"""Extended parameters, `component.ext`, in the calls that set up a vehicle: text, bytes, 64-bit numbers."""

from __future__ import annotations

import pytest

from paramclient import ParamSet, UsageError, VehicleArmed
from paramclient.provision import ApplyResult, Plan, apply, plan
from paramclient.sim import Air, Camera, PX4Vehicle
from tests.shell import a_client


def small() -> Camera:
    return Camera(
        {"MODE": 1, "NAME": "Front", "KEY": b"\xff\0\xfe", "EV": 0.5, "CLOCK": (8, 2**62 + 1)},
        limits={"MODE": (0, 5)},
        failing=["EV"],
    )


def statuses(found: Plan | ApplyResult) -> dict[str, str]:
    return {name: str(row.status) for name, row in found.rows.items()}


async def test_a_plan_names_what_cannot_be_written() -> None:
    async with a_client(camera := small()) as client:
        component = await client.component(1, 100)
        made = await plan(
            component.ext,
            {"MODE": 2, "NAME": "Front", "KEY": b"\1", "LOST": "x", "EV": "x", "CLOCK": 2**62 + 1},
        )
        assert statuses(made) == {
            "MODE": "set",
            "NAME": "unchanged",
            "KEY": "set",
            "LOST": "skipped",
            "EV": "invalid",
            "CLOCK": "unchanged",
        }
        assert camera.ext_values["MODE"] == 1
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


async def test_nothing_is_set_on_the_camera_of_an_armed_vehicle_unless_allowed() -> None:
    async with a_client(Air.symmetric([PX4Vehicle(table={"A": 1}, armed=True), small()])) as client:
        await client.component(1, 1)
        ext = (await client.component(1, 100)).ext
        with pytest.raises(VehicleArmed):
            await apply(ext, {"NAME": "Rear"})
        assert (await apply(ext, {"NAME": "Rear"}, allow_armed=True)).complete
