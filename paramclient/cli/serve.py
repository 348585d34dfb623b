"""The subcommands serve, token and sim, for other programs: a gateway, its users, and a simulated vehicle."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Final

import anyio

from paramclient.cli.app import on_end_signal
from paramclient.cli.options import CACHE, KeyOptions
from paramclient.cli.output import print_line, say
from paramclient.client.signing import read_key, timestamp_now
from paramclient.errors import UsageError
from paramclient.links import LinkKind, create_link, parse_link, serve_endpoint
from paramclient.links.sim import simulated
from paramclient.protocol.channel import task_group

SERVICE_LIBRARIES: Final = ("fastapi", "uvicorn")
"""Libraries that the extra `service` installs."""


async def serve(
    link: str,
    /,
    *links: str,
    mavlink: tuple[str, ...] = (),
    listen: str = "127.0.0.1:8765",
    cache: Annotated[str | None, CACHE] = None,
    no_cache: Annotated[bool, CACHE] = False,
    listen_only: bool = False,
    tokens: Path | None = None,
    options: KeyOptions = KeyOptions(),
) -> None:
    """Open links and the cache, and share them with ground stations, programs and browsers.

    Ground stations connect to the endpoints of `--mavlink` as to a vehicle. All frames pass, and requests
    about parameters are answered from the table.

    A link that cannot be opened, or that has failed, is retried. On SIGTERM and Ctrl-C, the service answers
    waiting requests, writes the cache and exits.

    Args:
        link: The link, such as udpin:0.0.0.0:14550 or serial:/dev/ttyACM0:57600.
        links: Further links.
        mavlink: Endpoint for ground stations, such as udpin:14551, tcpin:5760, udpout:127.0.0.1:14550 or
            serial:/dev/ttyUSB0:57600, with the options ?readonly, ?sign=KEYFILE and ?trusted (may write to a
            signed vehicle without signing). Without an address, only this computer can connect. May be given
            several times.
        listen: Address to listen on, HOST:PORT; with port 0, the system chooses the port.
        cache: The cache file, or the postgresql:// URL of a shared cache. Default: the user's own cache.
        no_cache: Neither read nor write a cache.
        listen_only: Send nothing to vehicles; receive the parameters that other stations on the links
            request.
        tokens: A file with access tokens, made by `paramclient token`. Without it, only this computer can
            connect.
    """
    _check_extra()
    from paramclient import service  # only here: needs the extra

    hub = service.Hub(
        (link, *links),
        cache=not no_cache if cache is None else cache,
        mavlink=mavlink,
        listen_only=listen_only,
        signing=options.signing,
        system=options.source_system,
    )
    stop = anyio.Event()

    def started(url: str) -> None:
        for endpoint in hub.gateway.endpoints:
            print_line(f"ground stations: {endpoint.address}")
        print_line(f"serving on {url}")

    users = None if tokens is None else service.read_tokens(tokens)
    with on_end_signal(stop.set):
        await service.serve(hub, listen, tokens=users, stop=stop, listens=started)


def token(name: str, /, *, file: Path, read: bool = False) -> None:
    """Create an access token for `paramclient serve`, and print it once.

    The token file stores only its digest, with the name for the history; the file is created if it does not
    exist. To revoke the token, remove its line and restart the service.

    Args:
        name: The user or computer, such as anna or bench-laptop.
        file: The token file of serve --tokens.
        read: Allow only reading.
    """
    _check_extra()
    from paramclient.service import add_token  # only here: needs the extra

    made = add_token(file, name, "read" if read else "write")
    say(f"token for {name} ({'read' if read else 'read and write'}), which is shown only once:")
    print_line(made)


def _check_extra() -> None:
    """Raise UsageError if the libraries of the extra `service` are not installed."""
    if missing := [name for name in SERVICE_LIBRARIES if find_spec(name) is None]:
        raise UsageError(f"the service needs {' and '.join(missing)}: pip install 'paramclient[service]'")


async def sim(
    vehicle: str, /, *, link: str = "udpout:127.0.0.1:14550", signing_key: Path | None = None
) -> None:
    """Run a simulated vehicle for other programs, until Ctrl-C.

    Args:
        vehicle: px4, ardupilot or camera, with the options of a simulated link, such as
            "px4?system=2&loss=0.05&seed=1".
        link: The link to send to or to listen on. With port 0, the system chooses the port, which is printed.
        signing_key: A file with the signing key: the vehicle signs its frames and requires signed ones.
    """
    kind, spec = parse_link(f"sim:{vehicle.removeprefix('sim:')}"), parse_link(link)
    real = create_link(spec)
    key = None if signing_key is None else read_key(signing_key)
    vehicle_end = simulated(kind, stream=real.is_stream, signing_key=key, signing_timestamp=timestamp_now())
    async with task_group() as tasks:
        opened = await tasks.start(serve_endpoint, vehicle_end.endpoint, real)
        where = f"speaks to {spec}"
        if spec.kind in (LinkKind.UDPIN, LinkKind.TCPIN):
            where = f"listens on {replace(spec, port=opened.address[1])}"
        print_line(f"{vehicle} {where}; Ctrl-C ends it")
