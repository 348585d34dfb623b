"""Pytest plugin of paramclient: simulated vehicles and clients as fixtures, for the tests of other programs.

The module is outside the package because pytest imports it at the start of every run with paramclient
installed. The package is imported by the first test that uses a fixture: other test suites do not pay for the
import, and coverage measurement has started by then.
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
    """Return a cache for this test, the default of every client in this process.

    The user's cache is neither read nor written meanwhile. All other fixtures use this one.
    """
    from paramclient import ParamCache  # imported in the fixtures: see the module's docstring

    path = tmp_path_factory.mktemp("paramclient") / "parameters.sqlite3"
    monkeypatch.setattr("paramclient.cache.store.default_path", lambda: path)
    with ParamCache() as cache:
        yield cache


@pytest.fixture
def param_client(param_cache: ParamCache) -> type[ParamClient]:
    """Return `ParamClient` with this test's cache: `async with param_client(vehicle) as client:`."""
    from paramclient import ParamClient

    return ParamClient


@pytest.fixture
def sim_px4(param_cache: ParamCache) -> MakePX4:
    """Return a maker of PX4 vehicles: `sim_px4(loss=0.05, delay=0.1, seed=1)`; see `paramclient.testing`."""
    from paramclient.testing import sim_px4

    return sim_px4


@pytest.fixture
def sim_ardupilot(param_cache: ParamCache) -> MakeArduPilot:
    """Return a maker of ArduPilot vehicles: `sim_ardupilot(pace=40)`; see `paramclient.testing`."""
    from paramclient.testing import sim_ardupilot

    return sim_ardupilot
