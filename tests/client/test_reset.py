"""Resets to the firmware's defaults: only known defaults are written, and each is verified."""

from __future__ import annotations

import pytest

from paramclient import ParamType, SetStatus, UnknownParameter, UsageError
from paramclient.metadata import Metadata, ParamInfo
from paramclient.sim import Air, ArduPilotVehicle, GenericVehicle, SimParam
from paramclient.wire import messages
from tests.shell import Tap, a_client, in_simulated_time


def with_defaults(**others: object) -> ArduPilotVehicle:
    """An ArduPilot whose parameter file has defaults."""
    table = [
        SimParam("CHANGED", ParamType.REAL32, 7.0, default=0.1),
        SimParam("SAME", ParamType.REAL32, 0.1, default=0.1),
        SimParam("COUNT", ParamType.INT16, 300, default=12),
        SimParam("FIXED", ParamType.INT8, 3, default=1),
    ]
    return ArduPilotVehicle(table=table, live=(), read_only=["FIXED"], param_error=True, **others)  # type: ignore[arg-type]


@in_simulated_time
async def test_defaults_of_the_vehicle_are_written_and_verified() -> None:
    vehicle = with_defaults()
    tap = Tap(vehicle)
    async with a_client(tap) as client:
        component = await client.component()
        result = await component.reset("COUNT", "SAME", "CHANGED")
        assert result.is_complete
        assert [each.name for each in result.written.outcomes] == ["COUNT", "CHANGED"]
        assert result.unchanged == ("SAME",)
        assert result.without_default == ()
        assert vehicle.params["COUNT"].value == component.params["COUNT"].value == 12
        assert component.params["CHANGED"].is_changed is False
        assert component.params["CHANGED"].value == pytest.approx(0.1)
    assert [each.param_id for each in tap.messages(messages.ParamSet)] == ["COUNT", "CHANGED"]


@in_simulated_time
async def test_a_refused_default_does_not_stop_the_others() -> None:
    async with a_client(with_defaults()) as client:
        component = await client.component()
        result = await component.reset("FIXED", "COUNT")
        assert not result.is_complete
        assert result.written["FIXED"].status is SetStatus.REFUSED
        assert result.written["COUNT"].status is SetStatus.ACCEPTED


@in_simulated_time
async def test_a_parameter_without_a_known_default_is_listed_and_not_written() -> None:
    vehicle = GenericVehicle(table={"A": 5.0, "B": 6.0, "C": 7})
    tap = Tap(vehicle)
    metadata = Metadata.of([ParamInfo("A", default=1.5), ParamInfo("C", default=7)])
    async with a_client(tap) as client:
        component = await client.component()
        assert (await component.reset("A")).without_default == ("A",)
        result = await component.reset(*"ABC", defaults=metadata.defaults_of("ABC"))
        assert not result.is_complete
        assert [str(each.status) for each in result.written.outcomes] == ["accepted"]
        assert (result.unchanged, result.without_default) == (("C",), ("B",))
        assert component.params["A"].value == 1.5
    assert {each.param_id for each in tap.messages(messages.ParamSet)} == {"A"}


@in_simulated_time
async def test_an_unknown_name_is_an_error_and_nothing_is_written() -> None:
    tap = Tap(with_defaults())
    async with a_client(tap) as client:
        component = await client.component()
        with pytest.raises(UnknownParameter, match="NO_SUCH"):
            await component.reset("COUNT", "NO_SUCH")
        with pytest.raises(UsageError, match="at least one"):
            await component.reset()
    assert not tap.messages(messages.ParamSet)


@pytest.mark.parametrize("seed", range(3))
@in_simulated_time
async def test_a_reset_on_a_link_that_loses_packets(seed: int) -> None:
    vehicle = with_defaults()
    async with a_client(Air.symmetric([vehicle], delay=0.05, loss=0.1, seed=seed)) as client:
        component = await client.component()
        result = await component.reset("COUNT", "CHANGED", timeout=30.0)
        assert result.is_complete
        assert vehicle.params["COUNT"].value == 12
