"""Other stations on the same link, and other programs with the same cache: all get along."""

from __future__ import annotations

import itertools
import socket
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path

import anyio
import pytest

from paramclient import ParamCache
from paramclient.model.values import ParamType
from paramclient.sim import PX4Vehicle, SimParam

PROGRAM = """
import anyio, sys
from paramclient import ParamClient

async def main(port, cache, name, values):
    async with ParamClient(f"udpin:127.0.0.1:{port}", cache=cache) as client:
        async with anyio.create_task_group() as tasks:
            for system in (1, 2):
                tasks.start_soon(work, client, system, name, values)

async def work(client, system, name, values):
    vehicle = await client.component(system, timeout=30)
    result = await vehicle.fetch_all()
    assert result.complete, result
    for value in values.split(","):
        done = await vehicle.set(name, int(value))
        assert done.actual == int(value), done
    await anyio.sleep(0.5)

anyio.run(main, *sys.argv[1:])
"""


@pytest.mark.asyncio
async def test_two_programs_share_vehicles_and_a_cache(tmp_path: Path) -> None:
    """Both fetch and set at once; each vehicle speaks to both, as over mavlink-router."""
    path = tmp_path / "cache.sqlite3"
    table = [SimParam(f"P_{index:03}", ParamType.INT32, index) for index in range(300)]
    vehicles = [PX4Vehicle(system=system, table=table) for system in (1, 2)]
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    for sock in sockets:
        sock.bind(("127.0.0.1", 0))
    ports = [sock.getsockname()[1] for sock in sockets]
    for sock in sockets:
        sock.close()
    router = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    router.bind(("127.0.0.1", 0))
    router.setblocking(False)

    async def route() -> None:
        """What a vehicle says goes to both programs, what they say to both vehicles."""
        while True:
            now = anyio.current_time()
            with suppress(BlockingIOError, ConnectionRefusedError):
                while True:
                    data = router.recv(65535)
                    for vehicle in vehicles:
                        vehicle.receive(data, now)
            for vehicle in vehicles:
                vehicle.tick(now)
                for data in vehicle.data_to_send():
                    for port in ports:
                        with suppress(ConnectionRefusedError):
                            router.sendto(data, ("127.0.0.1", port))
            await anyio.sleep(0.005)

    with router:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(route)
            async with anyio.create_task_group() as programs:
                for port, name, values in zip(ports, ("P_100", "P_200"), ("7,8,9", "17,18,19"), strict=True):
                    arguments = [sys.executable, "-c", PROGRAM, str(port), str(path), name, values]
                    programs.start_soon(partial(anyio.run_process, arguments, stderr=None))
            tasks.cancel_scope.cancel()
    with ParamCache(path) as cache:
        assert not cache.notes
        for vehicle in vehicles:
            cached = cache.component(system=vehicle.system)
            assert cached.complete
            assert {name: param.bits for name, param in cached.params.items()} == {
                name: param.bits for name, param in vehicle.params.items()
            }
            changes = [
                (line.name, line.old.value, line.new and line.new.value) for line in cache.history(cached.key)
            ]
            for name, before, after in (("P_100", 100, 9), ("P_200", 200, 19)):
                steps = [change[1:] for change in changes if change[0] == name]
                assert steps[0][0] == before
                assert steps[-1][1] == after
                assert all(one[1] == two[0] for one, two in itertools.pairwise(steps)), "nothing stands twice"
