"""The pytest plugin: fixtures under every runner, isolation from the user's cache, and import cost."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

import anyio
import pytest

from paramclient import ParamClient
from paramclient.sim import Vehicle
from paramclient.testing import SimVehicle, sim_ardupilot, sim_px4

pytest_plugins = ("pytester",)

ROOT = Path(__file__).parent.parent

Suite = Callable[..., pytest.RunResult]


@pytest.fixture
def suite(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> Suite:
    """Runs tests, given as text, with the plugin in a separate process; warnings are errors."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("XDG_CACHE_HOME", str(pytester.path / "user"))

    def run(*arguments: str, **modules: str) -> pytest.RunResult:
        pytester.makeini("[pytest]\nasyncio_default_fixture_loop_scope = function\nfilterwarnings = error\n")
        pytester.makepyfile(**modules)
        options = ("-p", "pytest_paramclient", "-p", "no:cacheprovider", "-p", "no:xdist")
        return pytester.runpytest_subprocess(*options, *arguments, timeout=60)

    return run


RUNNERS = """
import asyncio
from pathlib import Path

import pytest

from paramclient import ParamCache, ParamClient

BEFORE = ParamCache().path


async def session(px4, param_client, param_cache):
    async with param_client(px4) as client:
        vehicle = await client.component()
        assert (await vehicle.fetch_all()).source == "stream"
        await vehicle.set("MC_ROLL_P", 7.0)
    assert px4.vehicle.values == {"MC_ROLL_P": 7.0, "SYS_AUTOSTART": 4001}
    async with ParamClient(px4) as client:
        assert (await (await client.component()).fetch_all()).source == "cache"
        assert client.cache.path == param_cache.path
    assert len(param_cache.vehicles()) == 1


@pytest.fixture
def px4(sim_px4):
    return sim_px4(table={"MC_ROLL_P": 6.5, "SYS_AUTOSTART": 4001}, autosave=0.0)


@pytest.mark.asyncio
async def test_with_pytest_asyncio(px4, param_client, param_cache):
    await session(px4, param_client, param_cache)


@pytest.mark.anyio
@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_with_anyio(px4, param_client, param_cache, anyio_backend):
    await session(px4, param_client, param_cache)


def test_with_neither(px4, param_client, param_cache):
    asyncio.run(session(px4, param_client, param_cache))


def test_the_users_cache_is_the_users_again():
    assert ParamCache().path == BEFORE
    assert not BEFORE.exists()
"""


def test_fixtures_work_with_every_runner(suite: Suite) -> None:
    """With pytest-asyncio, with anyio's plugin and with neither; includes the documentation's programs."""
    page = (ROOT / "docs/testing.md").read_text(encoding="utf-8")
    found = re.findall(r"^```python\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    programs = [each for each in found if "def test_" in each]
    modules = {f"test_of_page_{number}": program for number, program in enumerate(programs)}
    modules["test_runners"] = RUNNERS
    tests = [re.findall(r"^(?:async )?def test_", module, re.MULTILINE) for module in modules.values()]
    assert len(tests) >= 3
    assert all(tests)
    suite(**modules).assert_outcomes(passed=sum(map(len, tests)))


# the makers themselves


@pytest.mark.parametrize("make", [sim_px4, partial(sim_ardupilot, ftp=False)])
@pytest.mark.parametrize("pace", [40.0, 333.0])
async def test_a_pace_is_that_of_the_list(make: Callable[..., SimVehicle[Vehicle]], pace: float) -> None:
    vehicle = make(pace=pace, table={f"P{number:03}": number for number in range(400)})
    async with ParamClient(vehicle, cache=False) as client:
        times: list[float] = []
        component = await client.component()
        result = await component.fetch_all(progress=lambda _: times.append(anyio.current_time()))
    assert result.source == "stream"
    assert times[-1] - times[0] == pytest.approx(400 / pace, rel=0.05, abs=0.4)
