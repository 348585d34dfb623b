"""Simulated vehicles on UDP, for programs that are given the name of a link."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from queue import Queue

import anyio
import anyio.from_thread
import anyio.lowlevel

from paramclient.links import create_link, serve_endpoint
from paramclient.links.sockets import UdpIn
from paramclient.sim import Endpoint


@contextmanager
def flying(endpoint: Endpoint) -> Iterator[str]:
    """Run a simulated vehicle in a thread; the name of the link to it."""
    started: Queue[tuple[int, Callable[[], None]]] = Queue()

    async def fly() -> None:
        async with anyio.create_task_group() as tasks:
            link = await tasks.start(serve_endpoint, endpoint, create_link("udpin:127.0.0.1:0"))
            assert isinstance(link, UdpIn)
            assert link.address is not None
            token = anyio.lowlevel.current_token()

            def stop() -> None:
                anyio.from_thread.run_sync(tasks.cancel_scope.cancel, token=token)

            started.put((link.address[1], stop))

    thread = threading.Thread(target=anyio.run, args=(fly,))
    thread.start()
    port, stop = started.get(timeout=30)
    try:
        yield f"udpout:127.0.0.1:{port}"
    finally:
        stop()
        thread.join()
