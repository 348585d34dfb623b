"""Runs tests in any order, and keeps them and the processes that they start away from the user's folders."""

from __future__ import annotations

import inspect
import itertools
import os
import random
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

FOLDERS = {
    "XDG_CACHE_HOME": ".cache",
    "XDG_CONFIG_HOME": ".config",
    "XDG_DATA_HOME": ".local/share",
    "XDG_STATE_HOME": ".local/state",
    "PYTHON_HISTORY": ".python_history",
}
"""Environment variables that name a file or folder of the user, and where it is below HOME."""

ORDER = os.environ.setdefault("TEST_ORDER", str(random.randrange(1, 10_000)))
"""Seed of the order of the tests, which workers inherit; 0 for the order of the files."""

_homes = itertools.count()


def pytest_report_header() -> str:
    """Name the order, to run it again."""
    return f"order of the tests: TEST_ORDER={ORDER}"


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run asynchronous tests in virtual time, and shuffle the modules, and the tests of each module."""
    for item in items:
        is_marked = any(item.get_closest_marker(plugin) for plugin in ("anyio", "asyncio"))
        if isinstance(item, pytest.Function) and inspect.iscoroutinefunction(item.obj) and not is_marked:
            item.obj = _in_virtual_time(item)
    if ORDER == "0":
        return
    modules = defaultdict[Path, list[pytest.Item]](list)
    for item in items:
        modules[item.path].append(item)
    chance = random.Random(ORDER)
    groups = list(modules.values())
    chance.shuffle(groups)
    for group in groups:
        chance.shuffle(group)
    items[:] = itertools.chain.from_iterable(groups)


def _in_virtual_time(item: pytest.Function) -> Callable[..., object]:
    """Run a test of conversations, or for both backends, as those are, others on the client's loop."""
    from tests.conversations.virtual import virtual
    from tests.shell import in_simulated_time

    backend = str(item.callspec.params.get("backend", "")) if hasattr(item, "callspec") else ""
    if not backend and item.path.parent.name != "conversations":
        return in_simulated_time(item.obj)
    return virtual(item.obj, backend or "trio")


@pytest.fixture(params=["trio", "asyncio"])
def backend(request: pytest.FixtureRequest) -> str:
    """The event loop of a test that runs on both; see `virtual_on_both`."""
    return str(request.param)


def _use_home(environment: pytest.MonkeyPatch, home: Path) -> Path:
    home.mkdir()
    environment.setenv("HOME", str(home))
    for variable, place in FOLDERS.items():
        environment.setenv(variable, str(home / place))
    return home


@pytest.fixture(scope="session", autouse=True)
def session_home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Set an empty home folder, and no options of the user, for fixtures that live longer than a test."""
    with pytest.MonkeyPatch.context() as environment:
        for variable in [name for name in os.environ if name.startswith("PARAMCLIENT_")]:
            if variable != "PARAMCLIENT_TEST_POSTGRES":
                environment.delenv(variable)
        yield _use_home(environment, tmp_path_factory.mktemp("homes") / "session")


@pytest.fixture(autouse=True)
def home(session_home: Path) -> Iterator[Path]:
    """Set an empty home folder for each test."""
    with pytest.MonkeyPatch.context() as environment:
        yield _use_home(environment, session_home.parent / str(next(_homes)))
