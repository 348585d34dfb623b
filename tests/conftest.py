"""Keeps all tests, and the processes that they start, away from the folders of the user who runs them."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
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

_homes = itertools.count()


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
