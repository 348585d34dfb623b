"""What is shipped: the wheel and the sdist as hatchling builds them, and what they say of themselves."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tarfile
import zipfile
from email.message import Message
from email.parser import Parser
from pathlib import Path

import pytest
from hatchling.builders.sdist import SdistBuilder
from hatchling.builders.wheel import WheelBuilder

import paramclient

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parent.parent
SOURCES = {
    path.relative_to(ROOT).as_posix()
    for path in (ROOT / "paramclient").rglob("*.py*")
    if path.suffix != ".pyc"
}
PLUGIN = "pytest_paramclient.py"
SERVED = {path.relative_to(ROOT).as_posix() for path in (ROOT / "paramclient/service/page").glob("*.*")}
TABLES = {path.relative_to(ROOT).as_posix() for path in (ROOT / "paramclient/sim/tables").glob("*.*")}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files in the wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    (path,) = WheelBuilder(str(ROOT)).build(directory=str(folder), versions=["standard"])
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """The names of the files in the sdist, without its top folder."""
    (path,) = SdistBuilder(str(ROOT)).build(directory=str(tmp_path_factory.mktemp("sdist")))
    with tarfile.open(path) as archive:
        return {member.name.split("/", 1)[1] for member in archive if member.isfile()}


@pytest.fixture(scope="module")
def metadata(wheel: dict[str, bytes]) -> Message:
    (name,) = (name for name in wheel if name.endswith(".dist-info/METADATA"))
    return Parser().parsestr(wheel[name].decode())


def test_the_wheel_has_the_package_and_nothing_else(wheel: dict[str, bytes]) -> None:
    shipped = {name for name in wheel if ".dist-info/" not in name}
    data = {"paramclient/py.typed", "paramclient/provision/apply_rules.toml"}
    assert shipped == SOURCES | TABLES | SERVED | data | {PLUGIN}
    assert len(TABLES) >= 3
    assert "paramclient/service/page/index.html" in SERVED


def test_pytest_finds_the_plugin(wheel: dict[str, bytes], tmp_path: Path) -> None:
    """Not installed by default: the files of the wheel, where Python looks for libraries."""
    for name, content in wheel.items():
        (tmp_path / "site" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "site" / name).write_bytes(content)
    (tmp_path / "test_it.py").write_text("def test_it(sim_px4):\n    assert sim_px4(table={}).air\n")
    options = ("-p", "no:cacheprovider", "-p", "no:asyncio", "-W", "error::pytest.PytestWarning")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(tmp_path / "site")},
        capture_output=True,
        encoding="utf-8",
        timeout=60,
        check=False,
    )
    assert "1 passed" in done.stdout, done.stdout + done.stderr


def test_the_sdist_can_be_built_and_tested(sdist: set[str]) -> None:
    assert sdist >= SOURCES | TABLES | SERVED | {PLUGIN}
    assert sdist >= {"pyproject.toml", "README.md", "CHANGELOG.md", "LICENSE", "Makefile", "docs/conf.py"}
    data = (path for path in (ROOT / "tests/data").rglob("*") if path.is_file())
    assert sdist >= {path.relative_to(ROOT).as_posix() for path in data}
    assert not {name for name in sdist if "__pycache__" in name or name.startswith((".venv", "docs/_build"))}


def test_the_changelog_knows_the_version() -> None:
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.findall(r"^## \[([^]]+)\]", text, re.MULTILINE)[0] == paramclient.__version__


def test_make_uses_an_existing_environment_and_replaces_a_broken_one(tmp_path: Path) -> None:
    """The README says how to make .venv, and then that `make demo` works: it keeps what was installed."""
    environment = tmp_path / "environment"

    def make() -> str:
        (environment / "made").unlink(missing_ok=True)
        return subprocess.run(
            ["make", "-f", str(ROOT / "Makefile"), f"VENV={environment}", str(environment / "made")],
            cwd=tmp_path,
            capture_output=True,
            encoding="utf-8",
            check=True,
            timeout=120,
        ).stdout

    subprocess.run([sys.executable, "-m", "venv", "--without-pip", environment], check=True, timeout=60)
    installed = environment / "installed"
    installed.touch()
    assert f"Making {environment}" in make()  # without pip, it cannot be used
    assert not installed.exists()
    installed.touch()
    assert f"Using the existing {environment}" in make()
    assert installed.exists()
