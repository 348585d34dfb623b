"""The command that serves: one process holds the links, and others use them over HTTP."""

from __future__ import annotations

import asyncio
import gc
import signal
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from types import FrameType
from typing import Annotated, Final

import anyio
from cyclopts import Parameter

from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.options import Id, SigningOptions
from paramclient.cli.output import print_line
from paramclient.errors import UsageError

__all__ = ["serve"]

LIBRARIES: Final = ("fastapi", "uvicorn", "websockets")
"""What the extra `service` installs."""
LOOK_INTERVAL: Final = 1.0
"""Seconds between two looks at which components are followed."""
FEW_COMPONENTS: Final = 32
"""Components that full collections may go through: 5 ms."""
_UNSIGNED: Final = SigningOptions()
_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)


async def serve(
    *links: str,
    listen: str = "127.0.0.1:8765",
    cache: str | None = None,
    no_cache: bool = False,
    fetch: Annotated[bool, Parameter(negative="--no-fetch")] = True,
    listen_only: bool = False,
    token_file: Path | None = None,
    read_only: bool = False,
    host: tuple[str, ...] = (),
    allow_origin: tuple[str, ...] = (),
    trusted_proxy: tuple[str, ...] = (),
    system_id: Id = None,
    component_id: Id = None,
    tls_cert: Path | None = None,
    tls_key: Path | None = None,
    verbose: Annotated[bool, Parameter(name=("--verbose", "-v"))] = False,
    options: SigningOptions = _UNSIGNED,
) -> int:
    """Hold links and the cache, and give them to programs and browsers over HTTP.

    A link that is not there yet is opened when it can be, and again whenever it has dropped. It ends in good
    order on SIGTERM and Ctrl-C.

    Args:
        links: The links, such as udpin:0.0.0.0:14550 or serial:/dev/ttyACM0:57600.
        listen: Where to listen, HOST:PORT; port 0 lets the system choose.
        cache: The cache file, or the postgresql:// URL of one that stations share, instead of the user's own.
        no_cache: Neither read nor write a cache.
        fetch: Bring the tables of everyone who is heard up to date without being asked to.
        listen_only: Send nothing to vehicles, and take what others on the links ask for.
        token_file: The tokens of those who may use it, see `paramclient token`. Without one, and without
            PARAMCLIENT_SERVICE_TOKEN_FILE or PARAMCLIENT_SERVICE_TOKEN in the environment, only this machine
            can connect.
        read_only: Change nothing on any vehicle, whoever asks.
        host: A name by which browsers and programs call this service, such as companion.local; may be given
            several times.
        allow_origin: A page elsewhere that may use it from a browser, such as https://station.example; may be
            given several times. Without tokens it may read only.
        trusted_proxy: The address of a reverse proxy, or its network such as 10.0.0.0/8, whose header
            X-Forwarded-For or Forwarded says who asks; may be given several times.
        system_id: Our own system id on the links, 255 without it.
        component_id: Our own component id, 190 without it.
        tls_cert: A certificate in PEM, to be served over TLS.
        tls_key: Its key.
        verbose: Tell on stderr what is done, step by step.
    """
    if missing := [name for name in LIBRARIES if find_spec(name) is None]:
        raise UsageError(f"serving needs {' and '.join(missing)}: pip install 'paramclient[service]'")
    from paramclient import service  # only here: needs the extra

    if no_cache and cache is not None:
        raise UsageError("--cache and --no-cache exclude each other")
    if not links:
        raise UsageError("which links? Name at least one, such as udpin:0.0.0.0:14550")
    hub = service.Hub(
        links,
        cache=not no_cache if cache is None else cache,
        fetches=fetch,
        listen_only=listen_only,
        signing=options.signing,
        system=255 if system_id is None else system_id,
        component=190 if component_id is None else component_id,
        traffic=True,
    )
    listening = service.Listening.at(listen, tls_cert=tls_cert, tls_key=tls_key)
    access = service.AccessSettings(
        listen=listening.host,
        tokens=service.tokens_from(token_file),
        hosts=host,
        origins=allow_origin,
        proxies=trusted_proxy,
        read_only=read_only,
    )
    settings = service.Settings(access=access)

    def listens(url: str) -> None:
        gc.freeze()  # as when the command begins: a collection of all this takes as long as ten requests
        print_line(f"serving on {url}")

    with _stopping() as stop:
        collections = Collections()
        sparing = asyncio.create_task(collections.run(lambda: hub.followed))
        try:
            await service.serve(hub, settings, listening=listening, stop=stop, listens=listens)
        finally:
            sparing.cancel()
    return ExitCode.DONE


class Collections:
    """Keeps full collections of garbage short: they need not go through components that are followed.

    Those of 1,000 components take 0.2 s, in which nothing else runs. When components have been forgotten, all
    is collected again before they are left out once more.
    """

    def __init__(self) -> None:
        self._spared: set[object] = set()
        self._collected_at: int | None = None

    async def run(self, followed: Callable[[], Iterable[object]]) -> None:
        """Look every `LOOK_INTERVAL` at which components there are; until cancelled."""
        while True:
            await anyio.sleep(LOOK_INTERVAL)
            self.look(set(followed()))

    def look(self, followed: set[object]) -> None:
        """Leave components out, or collect what has become of them."""
        if len(self._spared - followed) >= FEW_COMPONENTS:
            gc.unfreeze()
            self._spared = set()
            self._collected_at = _full_collections()
        elif len(followed - self._spared) >= FEW_COMPONENTS and self._collected_at != _full_collections():
            gc.freeze()
            self._spared = followed
            self._collected_at = None


def _full_collections() -> int:
    return int(gc.get_stats()[2]["collections"])


@contextmanager
def _stopping() -> Iterator[anyio.Event]:
    """What is set by a signal that asks us to end. A second one ends the process at once."""
    loop = asyncio.get_running_loop()
    stop = anyio.Event()
    before = {number: signal.getsignal(number) for number in _SIGNALS}

    def end(_: int, __: FrameType | None) -> None:
        for each in _SIGNALS:
            signal.signal(each, signal.SIG_DFL)
        loop.call_soon_threadsafe(stop.set)

    for number in _SIGNALS:
        signal.signal(number, end)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
