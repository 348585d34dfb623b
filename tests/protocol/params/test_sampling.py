"""A sample of a cached table, which may settle a fetch of a vehicle without a hash."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from paramclient import Component, FetchResult, ParamCache, ParamClient, Policy, Trust, UsageError
from paramclient.protocol.params.fetch import Fetch
from paramclient.protocol.params.fetch_result import Sampled
from paramclient.protocol.params.sampling import SAMPLE_SIZE, Sample
from paramclient.protocol.params.sync import SyncSettings
from paramclient.protocol.station import Station
from paramclient.protocol.wire import ParamRequestList, ParamRequestRead
from paramclient.sim import Air, ArduPilotVehicle, Endpoint, GenericVehicle
from tests.shell import Tap, bits, in_simulated_time
from tests.simulation import Memory, Simulation

TABLE: dict[str, Any] = {f"PARAM_{number:03}": number for number in range(200)}


def generic(**changes: Any) -> GenericVehicle:
    return GenericVehicle({**TABLE, **changes})


def memory() -> Memory:
    session = Simulation(generic())
    session.fetch()
    return session.memory()


def sampled(session: Simulation, *, size: int = SAMPLE_SIZE, seed: int = 1) -> Fetch:
    machine = session.meet()
    machine.use_cached(now=session.now, **memory())
    machine.fetches.is_same_firmware = True
    return machine.begin_fetch(session.now, sampled=Sampled(size, seed))


def read(session: Simulation) -> list[int]:
    return [request.param_index for request in session.sent_of(ParamRequestRead) if request.param_index >= 0]


def test_a_sample_that_agrees_settles_it() -> None:
    session = Simulation(generic())
    result = session.outcome(sampled(session))
    assert (result.source, result.complete, result.hash) == ("cache", True, None)
    assert result.sample == Sample(SAMPLE_SIZE, 200)
    assert result.sampled
    assert result.sample.agrees
    assert len(result.notes) == 1
    assert len(set(read(session))) == SAMPLE_SIZE
    assert session.sent_of(ParamRequestList) == []
    trusts = [param.trust for param in session.machine.table.params.values()]
    assert (trusts.count(Trust.LIVE), trusts.count(Trust.CACHED)) == (SAMPLE_SIZE, 200 - SAMPLE_SIZE)
    assert session.machine.state == "cached", "that is no proof"
    assert session.machine.fetches.last is result


def test_the_seed_says_which() -> None:
    drawn = []
    for seed in (1, 1, 2):
        session = Simulation(generic())
        session.outcome(sampled(session, seed=seed))
        drawn.append(sorted(set(read(session))))
    assert drawn[0] == drawn[1] != drawn[2]


def test_a_sample_of_everything_is_everything() -> None:
    session = Simulation(generic())
    result = session.outcome(sampled(session, size=1000))
    assert result.sample == Sample(200, 200)
    assert result.sample.confidence() == 1.0


@pytest.mark.parametrize(
    ("vehicle", "why"),
    [
        (generic(PARAM_007=70), "PARAM_007 has another value"),
        (generic(PARAM_007=7.0), "PARAM_007 has another value"),
        (
            GenericVehicle({("OTHER" if name == "PARAM_007" else name): TABLE[name] for name in TABLE}),
            "parameter 7 is OTHER",
        ),
        (generic(NEW_ONE=1), "the vehicle has 201 parameters, and not 200"),
        (GenericVehicle({name: TABLE[name] for name in list(TABLE)[:199]}), "199"),
    ],
    ids=["value", "type", "name", "more", "fewer"],
)
def test_a_sample_that_differs_leads_to_a_download(vehicle: GenericVehicle, why: str) -> None:
    session = Simulation(vehicle)
    result = session.outcome(sampled(session, size=200))
    assert (result.source, result.complete, result.sampled) == ("stream", True, False)
    assert why in result.notes[0]
    assert result.notes[0].startswith("The sample does not match the cached table: ")
    assert bits(result.params) == bits(vehicle.params)
    assert session.machine.state == "synced"


def test_a_sample_ends_at_the_first_difference() -> None:
    session = Simulation(generic(PARAM_000=99))
    fetch = sampled(session, size=200)
    session.until(lambda: len(session.sent_of(ParamRequestList)) > 0)
    assert len(set(read(session))) < 150
    assert bits(session.outcome(fetch).params)["PARAM_000"] == 99


def test_an_index_that_does_not_answer_leads_to_the_whole_table() -> None:
    session = Simulation(GenericVehicle(TABLE, dead=["PARAM_007", 7]))
    fetch = sampled(session, size=200)
    session.until(lambda: len(session.sent_of(ParamRequestList)) > 0)
    assert session.outcome(fetch).sample is None


def test_a_fetch_without_a_sample_joins_and_gets_the_whole_table() -> None:
    session = Simulation(generic())
    fetch = sampled(session)
    other = session.machine.begin_fetch(session.now)
    assert other is fetch
    result = session.outcome(fetch)
    assert (result.source, result.sample) == ("stream", None)
    assert session.machine.state == "synced"


def test_cancelled_it_asks_no_more() -> None:
    session = Simulation(generic())
    fetch = sampled(session)
    session.machine.end_fetch(fetch, session.now)
    assert len(session.machine.reads) == 0
    session.run(5.0)
    assert not fetch.done
    assert session.sent_of(ParamRequestList) == []


def test_after_a_reboot_meanwhile_it_is_taken_anew() -> None:
    vehicle = ArduPilotVehicle(live_period=0)
    first = Simulation(vehicle)
    first.fetch()
    session = Simulation(vehicle)
    machine = session.meet()
    session.run(5.0)
    machine.use_cached(now=session.now, **first.memory())
    machine.fetches.is_same_firmware = True
    fetch = machine.begin_fetch(session.now, sampled=Sampled(SAMPLE_SIZE, 1))
    session.run(0.15)
    vehicle.reboot(session.now, down=0.5)
    before = len(session.sent_of(ParamRequestRead))
    assert before > 0
    result = session.outcome(fetch)
    assert result.sample is not None
    assert len(session.sent_of(ParamRequestRead)) - before >= SAMPLE_SIZE


def test_another_firmware_after_a_reboot_is_not_sampled() -> None:
    vehicle = ArduPilotVehicle(live_period=0)
    first = Simulation(vehicle)
    first.fetch()
    for sampled_at in ("once it is found", "while it is identified"):
        session = Simulation(air=Air.symmetric([vehicle], delay=0.05))
        machine = session.meet()
        session.run(5.0)
        machine.use_cached(now=session.now, **first.memory())
        machine.fetches.is_same_firmware = True
        version = vehicle._version
        assert version is not None
        vehicle._version = replace(version, git_hash=version.git_hash[::-1])
        if sampled_at == "once it is found":
            vehicle.reboot(session.now, down=1.0)
            session.until(lambda: machine.identification.is_doubted)  # noqa: B023 - called at once
        else:
            machine.identification.ask_again(session.now)
        fetch = machine.begin_fetch(session.now, sampled=Sampled(SAMPLE_SIZE, 1))
        result = session.outcome(fetch)
        assert (result.source, result.sample) == ("ftp", None), sampled_at


@pytest.mark.parametrize("policy", [Policy.HASH_ONLY, Policy.CACHE_ONLY])
def test_a_policy_that_allows_no_reads_allows_no_sample(policy: Policy) -> None:
    station = Station(link="sim:test", is_stream=False, sync_settings=SyncSettings.chosen(None, policy))
    session = Simulation(generic(), station=station)
    result = session.outcome(sampled(session))
    assert (result.source, result.sample) == ("cache", None)
    assert read(session) == []


# How sure that is


@pytest.mark.parametrize("count", range(1, 9))
def test_the_confidence_is_the_share_of_draws_that_show_it(count: int) -> None:
    for size in range(1, count + 1):
        for changed in range(count + 1):
            draws = list(combinations(range(count), size))
            shown = sum(any(index < changed for index in draw) for draw in draws)
            confidence = Sample(size, count).confidence(changed)
            assert math.isclose(confidence, shown / len(draws), abs_tol=1e-12)


@given(st.data())
def test_the_confidence_is_a_chance_that_rises(data: st.DataObject) -> None:
    count = data.draw(st.integers(1, 65_535))
    size = data.draw(st.integers(1, min(count, 500)))
    changed = data.draw(st.integers(1, count))
    sample = Sample(size, count)
    assert 0.0 <= sample.confidence(changed) <= 1.0
    assert sample.confidence(changed) >= sample.confidence(changed - 1)
    assert math.isclose(sample.confidence(1), size / count, rel_tol=1e-9)


def test_the_confidence_of_the_default_sample() -> None:
    sample = Sample(SAMPLE_SIZE, 1400)
    assert sample.confidence(140) > 0.95
    assert sample.confidence(1) < 0.03


# Who may be believed


async def session_with(
    endpoint: Endpoint, path: Path, *, accept: Literal["verified", "sampled"] = "verified", **options: Any
) -> tuple[FetchResult, Component]:
    async with ParamClient(endpoint, cache=path) as client:
        component = await client.component()
        return await component.fetch_all(accept=accept, **options), component


@in_simulated_time
async def test_the_same_vehicle_with_the_same_firmware_may_be_believed(tmp_path: Path) -> None:
    path = tmp_path / "cache"
    vehicle = ArduPilotVehicle(live_period=0)
    await session_with(vehicle, path)
    tap = Tap(vehicle)
    result, _ = await session_with(tap, path, accept="sampled", seed=3)
    assert result.sample == Sample(SAMPLE_SIZE, 1382)
    assert {param.trust for param in result.params.values()} == {Trust.LIVE, Trust.CACHED}
    result, _ = await session_with(tap, path, accept="sampled", sample=50, seed=3)
    assert result.sample == Sample(50, 1382)
    result, _ = await session_with(tap, path)
    assert (result.source, result.sample) == ("ftp", None)
    result, _ = await session_with(tap, path, accept="sampled", refresh=True)
    assert (result.source, result.sample) == ("ftp", None)


@pytest.mark.parametrize("what", ["firmware", "git hash", "hardware"])
@in_simulated_time
async def test_another_one_may_not(tmp_path: Path, what: str) -> None:
    path = tmp_path / "cache"
    await session_with(ArduPilotVehicle(live_period=0), path)
    vehicle = ArduPilotVehicle(live_period=0, uid2=b"another" if what == "hardware" else None)
    if what == "firmware":
        vehicle._version = replace(vehicle._version, flight_sw_version=1)
    if what == "git hash":
        vehicle._version = replace(vehicle._version, git_hash=b"01234567")
    result, _ = await session_with(vehicle, path, accept="sampled")
    assert (result.source, result.sample) == ("ftp", None)


@in_simulated_time
async def test_a_cached_table_that_is_not_whole_is_not_sampled(tmp_path: Path) -> None:
    path = tmp_path / "cache"
    vehicle = ArduPilotVehicle(live_period=0)
    async with ParamClient(vehicle, cache=path) as client:
        component = await client.component()
        await component.get("STAT_RUNTIME")
    with ParamCache(path) as cache:
        assert len(cache.component(system=1).params) == 1
    result, _ = await session_with(vehicle, path, accept="sampled")
    assert (result.source, result.sample) == ("ftp", None)


@in_simulated_time
async def test_invalid_sampling_options_are_refused() -> None:
    async with ParamClient(ArduPilotVehicle(), cache=False) as client:
        component = await client.component()
        with pytest.raises(UsageError, match="accept"):
            await component.fetch_all(accept="perhaps")  # type: ignore[arg-type]
        with pytest.raises(UsageError, match="at least 1"):
            await component.fetch_all(accept="sampled", sample=0)
