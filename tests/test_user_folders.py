"""Tests leave the user's folders alone: the cache, the history of Python's prompt."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import FOLDERS

ROOT = Path(__file__).parent.parent
SUITE = """
import subprocess
import sys

import anyio

from paramclient import ParamClient


def run(*arguments):
    subprocess.run([sys.executable, *arguments], input="", text=True, check=True, timeout=60)


def test_in_this_process():
    async def session():
        async with ParamClient("sim:px4") as client:
            await (await client.component()).get("MC_ROLL_P")

    anyio.run(session)


def test_in_another_process():
    run("-m", "paramclient", "get", "sim:px4", "MC_ROLL_P")
    run("-i", "-q")
"""


@pytest.mark.parametrize("isolated", [True, False])
def test_nothing_is_written_into_the_users_folders(tmp_path: Path, isolated: bool) -> None:
    """The same tests do write there without the fixtures: the folder that is looked at is the right one."""
    user = tmp_path / "user"
    user.mkdir()
    suite = tmp_path / "test_suite.py"
    suite.write_text(SUITE, encoding="utf-8")
    environment = {name: value for name, value in os.environ.items() if name not in FOLDERS}
    plugins = ["-p", "tests.conftest"] if isolated else []
    subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:asyncio", *plugins, suite],
        env=environment | {"HOME": str(user), "PYTHONPATH": str(ROOT)},
        cwd=tmp_path,
        check=True,
        timeout=120,
    )
    written = {str(path.relative_to(user)) for path in user.rglob("*") if path.is_file()}
    if isolated:
        assert written == set()
    else:
        assert ".cache/paramclient/parameters.sqlite3" in written
        assert ".python_history" in written or not importlib.util.find_spec("readline")
