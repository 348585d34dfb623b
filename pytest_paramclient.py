"""The pytest plugin of paramclient: simulated vehicles and clients as fixtures, for the tests of any program.

It stands beside the package and not in it. pytest imports it at the start of every run, wherever paramclient
is installed; the package itself loads with the first test that uses a fixture, so that nobody else waits for
it, and whatever measures coverage has begun by then.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from paramclient import ParamCache, ParamClient
    from paramclient.testing import MakeArduPilot, MakePX4

__all__ = ["param_cache", "param_client", "sim_ardupilot", "sim_px4"]


@pytest.fixture
def param_cache(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> Iterator[ParamCache]:
    """A cache of this test's own, which every client in this process uses unless told otherwise.

    The user's cache is neither read nor written meanwhile. The other fixtures bring this one with them.
    """
    from paramclient import ParamCache  # only here, as all that follow: see above

    path = tmp_path_factory.mktemp("paramclient") / "parameters.sqlite3"
    monkeypatch.setattr("paramclient.cache.store.default_path", lambda: path)
    with ParamCache() as cache:
        yield cache


@pytest.fixture
def param_client(param_cache: ParamCache) -> type[ParamClient]:
    """`ParamClient`, whose cache is this test's own: `async with param_client(vehicle) as client:`."""
    from paramclient import ParamClient

    return ParamClient


@pytest.fixture
def sim_px4(param_cache: ParamCache) -> MakePX4:
    """Makes simulated PX4 vehicles: `sim_px4(loss=0.05, delay=0.1, seed=1)`; see `paramclient.testing`."""
    from paramclient.testing import sim_px4

    return sim_px4


@pytest.fixture
def sim_ardupilot(param_cache: ParamCache) -> MakeArduPilot:
    """Makes simulated ArduPilot vehicles: `sim_ardupilot(pace=40)`; see `paramclient.testing`."""
    from paramclient.testing import sim_ardupilot

    return sim_ardupilot
