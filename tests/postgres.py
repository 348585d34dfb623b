"""A PostgreSQL of the tests: started from pgserver's or Debian's programs, or one that is given by URL."""

from __future__ import annotations

import importlib.util
import os
import pwd
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote
from uuid import uuid4

GIVEN = os.environ.get("PARAMCLIENT_TEST_POSTGRES")
"""URL of a database in which the tests may make databases of their own; they do not end this server."""

WHY_NONE = (
    "PostgreSQL is missing: install pgserver or Debian's postgresql, or name a database, beside which"
    " others may be made, by its URL, in PARAMCLIENT_TEST_POSTGRES"
)


def _programs() -> Path | None:
    """Where `initdb` and `postgres` are. pgserver is not imported: it makes files and users of its own."""
    found = importlib.util.find_spec("pgserver")
    places = [Path(each) / "pginstall" / "bin" for each in (found and found.submodule_search_locations) or ()]
    debian = sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
    # as another user than root, which may not reach the folder of pgserver
    places = [*debian, *places] if os.geteuid() == 0 else [*places, *debian]
    return next((place for place in places if (place / "initdb").exists()), None)


PROGRAMS = _programs()


class Server:
    """A server of its own in a folder, on a socket there; it can be ended and started again."""

    def __init__(self, folder: Path) -> None:
        assert PROGRAMS is not None
        self.folder = folder
        self._programs = PROGRAMS
        self._process: subprocess.Popen[bytes] | None = None
        self._user: str | None = None
        if os.geteuid() == 0:  # PostgreSQL does not run as root
            self._user = "nobody"
            user = pwd.getpwnam(self._user)
            os.chown(folder, user.pw_uid, user.pw_gid)
        words = ("--auth=trust", "--encoding=UTF8", "--locale=C", "--username=tests", "--no-sync")
        command: list[Path | str] = [PROGRAMS / "initdb", "-D", folder / "data", *words]
        subprocess.run(command, user=self._user, cwd=folder, check=True, capture_output=True)

    @property
    def url(self) -> str:
        return f"postgresql://tests@/postgres?host={quote(str(self.folder))}"

    def start(self) -> None:
        """Start it, and wait until it answers.

        While processes of a killed one still hold their memory, it ends at once, and is started again.
        """
        import psycopg

        deadline = time.monotonic() + 30.0
        while True:
            if self._process is None or self._process.poll() is not None:
                self._process = self._launch()
            try:
                psycopg.connect(self.url, connect_timeout=2).close()
            except psycopg.OperationalError:
                assert time.monotonic() < deadline, "PostgreSQL does not start"
                time.sleep(0.02)
            else:
                return

    def _launch(self) -> subprocess.Popen[bytes]:
        settings = {"listen_addresses": "", "unix_socket_directories": self.folder, "fsync": "off"}
        settings |= {"max_connections": 60, "shared_buffers": "32MB"}
        words = (word for name, value in settings.items() for word in ("-c", f"{name}={value}"))
        quiet: dict[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
        return subprocess.Popen(
            [self._programs / "postgres", "-D", self.folder / "data", *words],
            user=self._user,
            cwd=self.folder,
            start_new_session=True,
            **quiet,
        )

    def kill(self) -> None:
        """End it as a power cut does: its first process and all that this has started."""
        assert self._process is not None
        self._process.send_signal(signal.SIGSTOP)  # so that it starts no other one meanwhile
        pid = self._process.pid
        for each in (*map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split()), pid):
            os.kill(each, signal.SIGKILL)
        self._process.wait()
        self._process = None

    def stop(self) -> None:
        """End it for good: what it holds is not needed any more."""
        if self._process is not None:
            self._process.send_signal(signal.SIGQUIT)
            self._process.wait()
            self._process = None


@contextmanager
def server() -> Iterator[Server]:
    """A server that runs, in a folder that goes with it."""
    folder = Path(tempfile.mkdtemp(prefix="pg"))  # short: it holds a socket
    running = Server(folder)
    try:
        running.start()
        yield running
    finally:
        running.stop()
        shutil.rmtree(folder)


@contextmanager
def database_on(url: str) -> Iterator[str]:
    """An empty database on a server; it goes with the block. Gives its URL."""
    import psycopg

    name = f"tests_{uuid4().hex}"
    with psycopg.connect(url, autocommit=True) as connection:
        connection.execute(f"CREATE DATABASE {name}")
    start, _, query = url.partition("?")
    yield f"{start.rpartition('/')[0]}/{name}{'?' * bool(query)}{query}"
    with psycopg.connect(url, autocommit=True) as connection:
        connection.execute(f"DROP DATABASE {name} WITH (FORCE)")
