"""What the tests of the page have in common: a service over simulated vehicles, and the browser."""

from __future__ import annotations

import json
import shutil
import threading
import urllib.request
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import anyio
import anyio.abc
import anyio.from_thread

from paramclient import ParamCache, ParamClient
from paramclient.links import SimLink
from paramclient.model.values import ParamType, WireValue
from paramclient.service import Hub, Listening, Settings, serve
from paramclient.sim import ArduPilotVehicle, PX4Vehicle, Vehicle
from paramclient.sim.param_table import Entry
from paramclient.testing import SimVehicle

__all__ = ["BROWSER", "BROWSER_OPTIONS", "Bench", "at_work"]

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
"""Where a browser is, or None."""
BROWSER_OPTIONS = [
    *("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
]
HOSTILE: dict[str, WireValue | tuple[ParamType, WireValue]] = {
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

    def _write(self, entry: Entry, bits: int) -> None:
        super()._write(entry, min(bits, HIGHEST) if entry.name == "RTL_ALT" else bits)


class Bench:
    """A service in a thread of its own, with its vehicles.

    Attributes:
        url: where it is.
        px4, ardupilot, odd: the vehicles; what is done to them goes through `do`.
        token: what other programs show to the service, where it wants one.
    """

    def __init__(self, portal: anyio.from_thread.BlockingPortal, url: str, **links: SimVehicle[Any]) -> None:
        self._portal = portal
        self.url = url
        self.token = ""
        self.px4: Vehicle = links["px4"].vehicle
        self.ardupilot: Vehicle = links["ardupilot"].vehicle
        self.odd: Vehicle = links["odd"].vehicle

    def do(self, call: Callable[..., Result], *arguments: Any) -> Result:
        """Call something where the vehicles are."""
        return self._portal.call(call, *arguments)

    def ask(self, method: str, address: str, body: object = None) -> Any:
        """What another program asks of the service, and is answered."""
        request = urllib.request.Request(
            f"{self.url}/api/v1{address}",
            method=method,
            data=None if body is None else json.dumps(body).encode(),
            headers={"Content-Type": "application/json", "Authorization": f"Bearer {self.token}"},
        )
        with urllib.request.urlopen(request, timeout=20) as answer:
            return json.loads(answer.read() or b"null")

    def set(self, name: str, value: float) -> None:
        """Another program sets a value of the PX4.

        A value that is set on board is reported once, and not at all if it was saved first: then it takes the
        client's next look, half a minute later.
        """
        self.ask("PATCH", "/components/1/1/params?link=px4", {"values": {name: value}})

    def is_synced(self, system: int) -> bool:
        """Whether the table of this vehicle is here, whole."""
        components = self.ask("GET", "/components")["components"]
        return any(each["system"] == system and each["state"] == "synced" for each in components)


@contextmanager
def at_work(
    folder: Path,
    settings: Settings | None = None,
    *,
    port: int = 0,
    more: Mapping[str, SimVehicle[Any]] | None = None,
) -> Iterator[Bench]:
    """A service over both autopilots and one with names that no vehicle should have, its cache in this
    folder."""
    links: dict[str, SimVehicle[Any]] = {
        "px4": SimVehicle(PX4Vehicle(metadata=True, param_error=True)),
        "ardupilot": SimVehicle(Limited()),
        "odd": SimVehicle(PX4Vehicle(system=3, table=HOSTILE, metadata=True)),
        **(more or {}),
    }
    url = ""
    listens = threading.Event()

    def reported(where: str) -> None:
        nonlocal url
        url = where
        listens.set()

    with anyio.from_thread.start_blocking_portal() as portal:

        async def run(*, task_status: anyio.abc.TaskStatus[anyio.Event]) -> None:
            stop = anyio.Event()
            task_status.started(stop)
            with ParamCache(folder / "cache.sqlite3") as cache:
                hub = Hub([(name, _maker(name, links[name], cache)) for name in links], cache=cache)
                await serve(hub, settings, listening=Listening(port=port), stop=stop, listens=reported)

        running, stop = portal.start_task(run)
        try:
            assert listens.wait(20)
            yield Bench(portal, url, **links)
        finally:
            portal.call(stop.set)
            running.result(20)


def _maker(name: str, vehicle: SimVehicle[Any], cache: ParamCache) -> Callable[[], ParamClient]:
    return lambda: ParamClient(SimLink(vehicle, name), cache=cache)
