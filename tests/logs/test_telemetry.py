"""Telemetry logs as links, and their import into a cache."""

from __future__ import annotations

import os
from pathlib import Path

import anyio
import pytest

from paramclient import LinkError, NoReply, ParamCache, ParamClient, SyncState, Trust, UsageError
from paramclient.cache import BY_US, StoredParam, TableUpdate
from paramclient.links.tlog import PAUSE_MAX
from paramclient.logs.imports import ImportedTable, import_log
from paramclient.model.identity import Identity
from paramclient.model.paramset import WrittenParam
from paramclient.model.values import ParamType
from tests.recordings import DATA, from_vehicle, param_values, read
from tests.telemetry import KEY, NOW, UID, Log


def whole(**values: int) -> Log:
    """Return a log with a vehicle's identification and complete table."""
    return Log().beat().identify().list(**values).wait(1.0)


def a_replay(path: Path | str, **options: object) -> ParamClient:
    return ParamClient(f"replay:{path}", **options)  # type: ignore[arg-type]  # any


# Names


async def test_a_file_that_is_not_a_log(tmp_path: Path) -> None:
    (tmp_path / "empty").touch()
    (tmp_path / "other.txt").write_bytes(b"FRAME_CLASS 1\n" * 50)
    os.mkfifo(tmp_path / "pipe")
    for name, why in (
        ("nowhere.tlog", r"cannot open .*nowhere\.tlog: No such file"),
        ("empty", "is not a telemetry log"),
        ("other.txt", "is not a telemetry log"),
        (".", "Is a directory"),
        ("pipe", "is not a regular file"),
        ("/dev/zero", "is not a regular file"),
    ):
        with pytest.raises(LinkError, match=why):
            async with a_replay(tmp_path / name):
                raise AssertionError("it was opened")


# As a link


@pytest.mark.parametrize("speed", ["", "?speed=10", "?speed=0"])
@pytest.mark.parametrize(
    ("name", "crc"), [("px4_full_download", 0xCF579589), ("ardupilot_full_download", None)]
)
async def test_a_recording_gives_a_complete_table(name: str, crc: int | None, speed: str) -> None:
    async with a_replay(f"{DATA / name}.tlog{speed}") as client:
        assert client.cache is None
        component = await client.component()
        result = await component.fetch_all()
        values = {each.param_id: each for each in param_values(from_vehicle(name))}
        values.pop("_HASH_CHECK", None)
        assert result.params.keys() == values.keys()
        assert (result.missing, result.hash, result.source) == ((), crc, "stream")
        assert component.sync_state is SyncState.SYNCED
        assert {param.trust for param in result.params.values()} == {Trust.LIVE}
        assert (await client.fetch_all()).complete
        assert client.bytes_received == sum(len(each.data) for each in read(name))
        assert client.bytes_sent == 0


@pytest.mark.parametrize(("speed", "expected"), [("", 20.0), ("?speed=4", 5.0), ("?speed=0", 0.0)])
async def test_frames_have_the_times_of_the_log(speed: str, expected: float, tmp_path: Path) -> None:
    path = whole(A=1).wait(19.0).beat().write(tmp_path / "flight.tlog")
    began = anyio.current_time()
    async with a_replay(f"{path}{speed}") as client:
        await (await client.component()).fetch_all()
        assert anyio.current_time() - began == pytest.approx(expected, abs=0.1)


async def test_long_pauses_and_clocks_that_go_back(tmp_path: Path) -> None:
    path = Log().beat().wait(86400.0).beat().wait(-1e6).beat().write(tmp_path / "flight.tlog")
    began = anyio.current_time()
    async with a_replay(path) as client:
        component = await client.component()
        with pytest.raises(NoReply):
            await component.fetch_all()
        assert anyio.current_time() - began == pytest.approx(PAUSE_MAX, abs=0.1)


async def test_missing_parameters_are_reported_at_the_end_of_the_log(tmp_path: Path) -> None:
    log = Log().beat().report("A", 0, A=1, B=2, C=3).report("C", 2)
    async with a_replay(log.write(tmp_path / "flight.tlog")) as client:
        component = await client.component()
        for _ in range(2):  # also after its end
            result = await component.fetch_all()
            assert (result.missing, result.count) == ((1,), 3)
        assert (await client.fetch_all()).results[1, 1].missing == (1,)
        await anyio.sleep(60.0)
        # the clock stops at the end of the log, so no component is lost
        assert component.state == "partial"
        assert component.params["A"].trust is Trust.LIVE


async def test_requests_to_a_log_fail(tmp_path: Path) -> None:
    path = whole(A=1).write(tmp_path / "flight.tlog")
    async with a_replay(path) as client:
        component = await client.component()
        with pytest.raises(UsageError, match="only listens"):
            await component.set("A", 2)
        began = anyio.current_time()
        with pytest.raises(NoReply, match="component 9/9"):
            await client.component(9, 9)
        assert anyio.current_time() - began < 2.0
    with pytest.raises(UsageError, match="paramclient import"):
        a_replay(path, cache=tmp_path / "cache")


# Import into a cache


def imported(*paths: Path, cache: Path) -> list[ImportedTable]:
    async def work() -> list[ImportedTable]:
        with ParamCache(cache) as kept:
            return [table for path in paths for table in await import_log(path, kept)]

    return anyio.run(work)


def kept_values(cache: Path) -> dict[str, object]:
    with ParamCache(cache) as kept:
        return {name: param.value for name, param in kept.component(KEY).params.items()}


def lines(cache: Path) -> list[tuple[object, ...]]:
    with ParamCache(cache) as kept:
        return [
            (each.name, each.old.value, each.new and each.new.value, each.by, each.at - NOW)
            for each in kept.history(KEY)
        ]


def test_a_log_fills_a_cache_with_its_own_times(tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    log = whole(A=1, B=2, C=3).wait(99.0).set("B", 5).wait(100.0).change("C", 9).wait(1.0).beat()
    [table] = imported(log.write(tmp_path / "flight.tlog"), cache=cache)
    assert table == ImportedTable(KEY, 1, 1, 0, 3, True, None)
    assert kept_values(cache) == {"A": 1, "B": 5, "C": 9}
    assert lines(cache) == [
        ("B", 2, 5, "station 255/190", pytest.approx(100.0, abs=1e-3)),
        ("C", 3, 9, "vehicle", pytest.approx(200.0, abs=1e-3)),
    ]
    with ParamCache(cache) as kept:
        found = kept.component(KEY)
        assert (found.complete, found.count, found.identity.firmware) == (True, 3, 7)
        assert found.synced_at == pytest.approx(NOW, abs=1e-3)
        assert {name: round(at - NOW) for name, at in found.heard_at.items()} == {"A": 0, "B": 100, "C": 200}
        [vehicle] = kept.vehicles()
        assert (round(vehicle.first_seen - NOW), round(vehicle.last_seen - NOW)) == (0, 201)


def test_the_hash_in_a_log_is_stored_with_its_table(tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    [table] = imported(DATA / "px4_full_download.tlog", cache=cache)
    assert table.hash == 0xCF579589
    with ParamCache(cache) as kept:
        found = kept.component(table.key)
        assert (found.hash, found.complete, found.volatile_known) == (0xCF579589, True, True)
        assert len(found.volatile) == 58


@pytest.mark.parametrize("is_reversed", [False, True])
def test_the_order_of_logs_does_not_matter(is_reversed: bool, tmp_path: Path) -> None:
    first = whole(A=1, B=2).wait(9.0).change("A", 3).wait(1.0).beat()
    second = Log(NOW + 1000.0).beat().identify()
    second.list(A=4, B=2).wait(10.0).change("B", 8).wait(1.0).beat()
    logs = [first.write(tmp_path / "1.tlog"), second.write(tmp_path / os.fsdecode(b"2\xe9.tlog"))]
    cache = tmp_path / "cache"
    imported(*(reversed(logs) if is_reversed else logs), cache=cache)
    assert kept_values(cache) == {"A": 4, "B": 8}
    assert [each[:3] for each in lines(cache)] == [("A", 1, 3), ("A", 3, 4), ("B", 2, 8)]
    assert [round(float(str(each[4]))) for each in lines(cache)] == [10, 1000, 1010]
    with ParamCache(cache) as kept:
        assert kept.component(KEY).complete
        [vehicle] = kept.vehicles()
        assert round(vehicle.first_seen - NOW) == 0
        assert round(vehicle.last_seen - NOW) == 1011


def save(cache: Path, at: float, **values: int) -> None:
    identity = Identity(1, "udp", UID, firmware=8)
    params = [WrittenParam(name, value, ParamType.INT32) for name, value in values.items()]
    stored = [StoredParam.of(each, at, by=BY_US) for each in params]
    with ParamCache(cache) as kept:
        kept.save(TableUpdate(identity=identity, component=1, autopilot=12, at=at, params=stored))


def test_a_change_that_was_also_received_live_has_one_line(tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    save(cache, NOW + 0.2, A=1)
    save(cache, NOW + 10.25, A=3)
    assert len(lines(cache)) == 1
    log = whole(A=1).wait(9.0).change("A", 3).wait(1.0).beat()
    imported(log.write(tmp_path / "flight.tlog"), cache=cache)
    assert lines(cache) == [("A", 1, 3, BY_US, pytest.approx(10.25))]
