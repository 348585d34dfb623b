"""A service over simulated vehicles in a thread, and the browser that looks at its page."""

from __future__ import annotations

import json
import shutil
import threading
import urllib.request
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import anyio
import anyio.abc
import anyio.from_thread

from paramclient.links import SimLink
from paramclient.model.values import ParamType, Value
from paramclient.service import Hub, Tokens, serve
from paramclient.sim import ArduPilotVehicle, Camera, PX4Vehicle, Vehicle
from paramclient.wire.frames import Frame
from paramclient.wire.messages import Message
from tests.shell import clamped

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
"""Where a browser is, or None."""
BROWSER_OPTIONS = [
    *("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
]
HOSTILE: dict[str, Value | tuple[ParamType, Value]] = {
    "<b>BOLD</b>": 1.0,
    "<iframe/>": (ParamType.INT32, 2),
    "'\"></script>": (ParamType.INT32, 3),
    "A/../B?c%23d%41": (ParamType.INT32, 4),
    "NOT_A_NUMBER": float("nan"),
}
HIGHEST = 3000

Result = TypeVar("Result")


class Limited(ArduPilotVehicle):
    """One whose RTL_ALT cannot be more than HIGHEST, and whose RTL_SPEED cannot be set."""

    def __init__(self) -> None:
        super().__init__(system=2, param_error=True, read_only=["RTL_SPEED"], live_period=0.0)

    def respond(self, message: Message, sender: Frame) -> None:
        super().respond(clamped(message, "RTL_ALT", 0, HIGHEST), sender)


@dataclass
class Bench:
    """A service in a thread of its own, with its vehicles.

    Attributes:
        portal: to its thread.
        url: where it is.
        endpoint: where ground stations connect.
        vehicles: the vehicles by the name of their link; what is done to them goes through `do`.
        token: what other programs show to the service, where it wants one.
    """

    portal: anyio.from_thread.BlockingPortal
    url: str
    endpoint: str
    vehicles: Mapping[str, Vehicle]
    token: str = ""

    def do(self, call: Callable[..., Result], *arguments: Any) -> Result:
        """Call something where the vehicles are."""
        return self.portal.call(call, *arguments)

    def ask(self, method: str, address: str, body: object = None) -> Any:
        """What another program asks of the service, and is answered."""
        request = urllib.request.Request(
            f"{self.url}/api{address}",
            method=method,
            data=None if body is None else json.dumps(body).encode(),
            headers={"Content-Type": "application/json", "Authorization": f"Bearer {self.token}"},
        )
        with urllib.request.urlopen(request, timeout=20) as answer:
            return json.loads(answer.read())

    def set(self, name: str, value: float) -> None:
        """Another program sets a value of the PX4, which is in the history then."""
        self.ask("PATCH", "/vehicles/1/1/params?link=px4", {"values": {name: value}, "durable": True})

    def is_ready(self) -> bool:
        """Whether the tables of all vehicles are here, and the metadata of the PX4."""
        found = self.ask("GET", "/vehicles")["vehicles"]
        px4 = next((each for each in found if each["link"] == "px4" and each["state"] == "synced"), None)
        if px4 is not None and not px4["has_metadata"]:
            self.ask("POST", "/vehicles/1/1/fetch?link=px4", {"metadata": True})
        is_described = px4 is not None and px4["has_metadata"]
        autopilots = [each for each in found if each["component"] == 1]
        return is_described and sum(each["state"] == "synced" for each in autopilots) == 3


@contextmanager
def at_work(folder: Path, *, tokens: Tokens | None = None, port: int = 0) -> Iterator[Bench]:
    """A service over both autopilots and one with names that no vehicle should have, its cache in this
    folder."""
    vehicles: dict[str, Vehicle] = {
        "px4": PX4Vehicle(metadata=True, param_error=True),
        "ardupilot": Limited(),
        "odd": PX4Vehicle(system=3, uid=3, table=HOSTILE, metadata=True),
        "camera": Camera(system=4, component=100),
    }
    url = endpoint = ""
    listens = threading.Event()

    with anyio.from_thread.start_blocking_portal() as portal:

        async def run(*, task_status: anyio.abc.TaskStatus[anyio.Event]) -> None:
            stop = anyio.Event()
            task_status.started(stop)
            links = [SimLink(vehicle, name) for name, vehicle in vehicles.items()]
            hub = Hub(links, cache=folder / "cache.sqlite3", mavlink=["tcpin:0"])

            def reported(where: str) -> None:
                nonlocal url, endpoint
                url, endpoint = where, hub.gateway.endpoints[0].address
                listens.set()

            await serve(hub, f"127.0.0.1:{port}", tokens=tokens, stop=stop, listens=reported)

        running, stop = portal.start_task(run)
        try:
            assert listens.wait(20)
            yield Bench(portal, url, endpoint, vehicles)
        finally:
            portal.call(stop.set)
            running.result(20)
