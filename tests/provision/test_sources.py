"""`resolve`: the parameters of a file, a log, a vehicle of the cache, or a link."""

from __future__ import annotations

import io
from pathlib import Path

import pytest

from paramclient import ParamCache
from paramclient.model.notation import time_text
from paramclient.provision import resolve
from paramclient.sim import PX4Vehicle
from tests.shell import a_client

DATA = Path(__file__).parents[1] / "data"


def placed(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


async def test_every_source_becomes_a_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(b"A 1\n")))
    monkeypatch.chdir(tmp_path)
    placed(tmp_path / "4", "B 2\n")
    with ParamCache(tmp_path / "cache.sqlite3") as cache:
        async with a_client(PX4Vehicle(table={"MC_ROLL_P": 6.5}, system=4), cache=cache) as client:
            await client.fetch_all()
        found = {
            text: await resolve(text, cache=cache)
            for text in ("-", "4", "cache:4", str(DATA / "px4_full_download.tlog"))
        }
        assert len(cache.components()) == 1, "the cache is still open"
    assert {text: next(iter(each.items()))[0] for text, each in found.items() if len(each) == 1} == {
        "-": "A",
        "4": "B",
        "cache:4": "MC_ROLL_P",
    }
    assert [each.system for each in found.values()] == [None, None, 4, 1]
    (log,) = (each for each in found.values() if each.system == 1)
    assert log.at is not None
    assert time_text(log.at).startswith("2026-11-20")
