"""The subcommand serve: runs the service, which shares links and cache over HTTP."""

from __future__ import annotations

import asyncio
import gc
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Final

import anyio
from cyclopts import Parameter

from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.options import SigningOptions
from paramclient.cli.output import print_line
from paramclient.cli.signals import on_end_signal
from paramclient.errors import UsageError

__all__ = ["serve"]

SERVICE_LIBRARIES: Final = ("fastapi", "prometheus_client", "uvicorn", "websockets")
"""Libraries that the extra `service` installs."""
SWITCH_INTERVAL: Final = 0.001
"""Seconds for which a worker thread may keep the interpreter while the event loop waits for it.

The loop waits that long after each system call, as system calls release the interpreter. With Python's 5 ms,
six comparisons of 10,000 parameters at once delay it by more than 100 ms."""
_UNSIGNED: Final = SigningOptions()


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
    tls_cert: Path | None = None,
    tls_key: Path | None = None,
    verbose: Annotated[bool, Parameter(name=("--verbose", "-v"))] = False,
    options: SigningOptions = _UNSIGNED,
) -> int:
    """Open links and the cache, and share them with programs and browsers over HTTP.

    A link that cannot be opened, or that has failed, is retried. On SIGTERM and Ctrl-C, the service answers
    waiting requests, writes the cache and exits.

    Args:
        links: The links, such as udpin:0.0.0.0:14550 or serial:/dev/ttyACM0:57600.
        listen: Address to listen on, HOST:PORT; with port 0, the system chooses the port.
        cache: The cache file, or the postgresql:// URL of a shared cache. Default: the user's own cache.
        no_cache: Neither read nor write a cache.
        fetch: Fetch the parameters of all vehicles that are heard.
        listen_only: Send nothing to vehicles; receive the parameters that other stations on the links
            request.
        token_file: A file with access tokens, see `paramclient token`. Without it, and without
            PARAMCLIENT_SERVICE_TOKEN_FILE or PARAMCLIENT_SERVICE_TOKEN in the environment, only this computer
            can connect.
        read_only: Refuse all changes of vehicles.
        host: A host name of this service for browsers and programs, such as companion.local; may be given
            several times.
        allow_origin: Origin of a web page that may use the service from a browser, such as
            https://station.example; may be given several times. Without tokens, such a page can only read.
        trusted_proxy: Address or network, such as 10.0.0.0/8, of a reverse proxy whose header X-Forwarded-For
            or Forwarded names the client; may be given several times.
        tls_cert: A certificate file (PEM), to serve over TLS.
        tls_key: The key file of the certificate (PEM).
        verbose: Log each step on stderr.
    """
    if missing := [name for name in SERVICE_LIBRARIES if find_spec(name) is None]:
        raise UsageError(f"serving needs {' and '.join(missing)}: pip install 'paramclient[service]'")
    from paramclient import service  # only here: needs the extra
    from paramclient.service.garbage_collection import GarbageCollection

    if no_cache and cache is not None:
        raise UsageError("--cache and --no-cache exclude each other")
    if not links:
        raise UsageError("no link is given; name at least one, such as udpin:0.0.0.0:14550")
    hub = service.Hub(
        links,
        cache=not no_cache if cache is None else cache,
        fetches=fetch,
        listen_only=listen_only,
        signing=options.signing,
        traffic=True,
        **options.source,
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
        gc.freeze()  # as at the start of the command: a full collection takes as long as ten requests
        print_line(f"serving on {url}")

    sys.setswitchinterval(SWITCH_INTERVAL)
    stop = anyio.Event()
    with on_end_signal(lambda _: stop.set()):
        collecting = asyncio.create_task(GarbageCollection().run(lambda: hub.followed, lambda: hub.is_busy))
        try:
            await service.serve(hub, settings, listening=listening, stop=stop, listens=listens)
        finally:
            collecting.cancel()
    return ExitCode.DONE
