"""Simulated vehicles on UDP, for programs that are given the name of a link."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager

from anyio.from_thread import start_blocking_portal

from paramclient.links import create_link, serve_endpoint
from paramclient.sim import Endpoint


@contextmanager
def flying(endpoint: Endpoint) -> Iterator[str]:
    """Run a simulated vehicle in a thread; the name of the link to it."""
    with start_blocking_portal() as portal:
        serving, link = portal.start_task(serve_endpoint, endpoint, create_link("udpin:127.0.0.1:0"))
        try:
            yield f"udpout:127.0.0.1:{link.address[1]}"
        finally:
            serving.cancel()


def free_port() -> int:
    """A UDP port of this computer that no program uses."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
