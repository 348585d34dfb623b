"""Many writes in one call: all that go through are kept, and each that does not has its own outcome."""

from __future__ import annotations

import asyncio
from pathlib import Path
from unittest import mock

import pytest

from paramclient import SetOutcome, SetStatus, errors
from paramclient.client.cache_writer import CacheWriter
from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle
from paramclient.wire import messages
from tests.client.conftest import connected, fetched
from tests.shell import VALUES, Tap, a_client, residue, small_px4

MANY: dict[str, int | float] = {f"MANY_{number:03}": float(number) for number in range(200)}
NEW: dict[str, int | float] = {name: value + 0.5 for name, value in MANY.items()}


async def test_each_value_has_an_outcome_of_its_own() -> None:
    vehicle = ArduPilotVehicle(
        table={**{name: float(value) for name, value in VALUES.items()}, "COUNT": 3},
        read_only=["PARAM_03"],
        live=(),
        ftp=False,
        param_error=True,
    )
    wanted = {"PARAM_01": 5.0, "NO_SUCH": 1.0, "COUNT": 7.6, "PARAM_03": 9.0, "PARAM_04": float("nan")}
    seen: list[SetOutcome] = []
    async with fetched(vehicle) as (_, component):
        result = await component.set_many({**wanted, "PARAM_05": 6.0}, progress=seen.append)
        assert {each.name: each.status for each in result.outcomes} == {
            **dict.fromkeys(("PARAM_01", "PARAM_05"), "accepted"),
            **dict.fromkeys(("NO_SUCH", "PARAM_03", "PARAM_04"), "refused"),
            "COUNT": "adjusted",
        }
        for name, kind in (
            ("NO_SUCH", errors.UnknownParameter),
            ("PARAM_03", errors.Refused),
            ("PARAM_04", errors.UsageError),
        ):
            assert isinstance(result[name].error, kind)
        assert result["COUNT"].requested == 7.6
        assert result["COUNT"].result is not None
        assert result["COUNT"].result.actual == vehicle.params["COUNT"].value
        assert (result.error, result.is_complete) == (None, False)
        assert sorted(map(str, seen)) == sorted(map(str, result.outcomes))
        with pytest.raises(KeyError):
            result["PARAM_02"]


async def test_the_timeout_is_that_of_the_whole_call() -> None:
    tap = Tap(Air.symmetric([PX4Vehicle(table=MANY)], delay=0.05))
    async with fetched(tap) as (_, component):
        result = await component.set_many(NEW, timeout=0.25)
        assert 0.2 < result.elapsed < 0.4
        assert isinstance(result.error, errors.NoReply)
        assert result.counts[SetStatus.ACCEPTED] >= 10
        assert result.counts[SetStatus.UNKNOWN] >= 10
        assert result.counts[SetStatus.NOT_TRIED] >= 100
        assert not residue(component)
        sent = len(tap.messages(messages.ParamSet))
        await asyncio.sleep(1.0)
        assert len(tap.messages(messages.ParamSet)) == sent
        assert (await component.set_many(NEW)).is_complete


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"PARAM_01": 1, "no name": 1}, "no name"),
        ({"PARAM_01": 1, "PARAM_02": "two"}, "two"),
        ({"PARAM_01": 1, "_HASH_CHECK": 1}, "read-only"),
    ],
)
async def test_nothing_is_sent_if_an_argument_is_wrong(values: dict[str, int], message: str) -> None:
    tap = Tap(small_px4())
    async with connected(tap) as (_, component):
        with pytest.raises(errors.UsageError, match=message):
            await component.set_many(values)
        with pytest.raises(errors.UsageError, match="settle"):
            await component.set_many({"PARAM_01": 1}, settle=-1)
        assert (await component.set_many({})).is_complete
        await asyncio.sleep(1.0)
        assert not tap.messages(messages.ParamSet)


async def test_values_that_are_not_on_the_disk_are_reported_as_such(tmp_path: Path) -> None:
    async with fetched(small_px4(), cache=tmp_path / "cache") as (_, component):
        assert (await component.set_many({"PARAM_01": 2}, durable=True)).is_complete
        failing = mock.AsyncMock(side_effect=errors.CacheError("disk I/O error"))
        with mock.patch.object(CacheWriter, "write_durably", failing):
            result = await component.set_many({"PARAM_01": 3, "NO_SUCH": 1, "PARAM_02": 4}, durable=True)
        assert isinstance(result.error, errors.NotDurable)
        assert isinstance(result["PARAM_02"].error, errors.NotDurable)
        assert result["PARAM_02"].status is SetStatus.ACCEPTED
        assert result["PARAM_02"].is_set
        assert isinstance(result["NO_SUCH"].error, errors.UnknownParameter)
        assert not result.is_complete
    with pytest.raises(errors.UsageError, match="durable"):
        async with a_client(small_px4()) as client:
            await (await client.component()).set_many({"PARAM_01": 2}, durable=True)
