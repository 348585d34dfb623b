"""Several programs with the same vehicles and the same cache: all get along."""

from __future__ import annotations

import itertools
import subprocess
import sys
from pathlib import Path

from paramclient import ParamCache
from paramclient.model.values import ParamType
from paramclient.sim import Air, PX4Vehicle, SimParam
from tests.shell import bits
from tests.simulated_on_udp import flying

PROGRAM = """
import anyio, sys
from paramclient import ParamClient

async def main(url, cache, name, *values):
    async with ParamClient(url, cache=cache) as client:
        async with anyio.create_task_group() as tasks:
            for system in (1, 2):
                tasks.start_soon(work, client, system, name, values)

async def work(client, system, name, values):
    vehicle = await client.component(system, timeout=30)
    result = await vehicle.fetch_all()
    assert result.complete, result
    for value in values:
        assert (await vehicle.set(name, int(value))).actual == int(value)
    await anyio.sleep(0.5)

anyio.run(main, *sys.argv[1:])
"""


def test_two_programs_share_vehicles_and_a_cache(tmp_path: Path) -> None:
    """Both fetch and set at once; each vehicle speaks to both, as over mavlink-router."""
    path = tmp_path / "cache.sqlite3"
    table = [SimParam(f"P_{index:03}", ParamType.INT32, index) for index in range(300)]
    vehicles = [PX4Vehicle(system=system, table=table) for system in (1, 2)]
    with flying(Air(vehicles)) as url:
        program = [sys.executable, "-c", PROGRAM, url, str(path)]
        running = [
            subprocess.Popen([*program, *words])
            for words in (("P_100", "7", "8", "9"), ("P_200", "17", "18", "19"))
        ]
        assert [each.wait(60) for each in running] == [0, 0]
    with ParamCache(path) as cache:
        assert not cache.notes
        for vehicle in vehicles:
            cached = cache.component(system=vehicle.system)
            assert cached.complete
            assert bits(cached.params) == bits(vehicle.params)
            for name, before, after in (("P_100", 100, 9), ("P_200", 200, 19)):
                lines = cache.history(cached.key, name=name)
                steps = [(line.old.value, line.new and line.new.value) for line in lines]
                assert (steps[0][0], steps[-1][1]) == (before, after)
                assert all(one[1] == two[0] for one, two in itertools.pairwise(steps)), "nothing stands twice"
