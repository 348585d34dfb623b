"""Sessions drawn by hypothesis: calls, changes on board, silence and restarts, on a faulty link."""

from __future__ import annotations

import math
import os
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, TypeAlias

import anyio
import pytest
from hypothesis import HealthCheck, seed, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule, run_state_machine_as_test

from paramclient.errors import NoReply
from paramclient.model.values import ParamType
from paramclient.protocol.fetch import fetch_all
from paramclient.protocol.reads import read
from paramclient.protocol.session import Session
from paramclient.protocol.writes import write
from paramclient.sim import Air, ArduPilotVehicle, GenericVehicle, PX4Vehicle, SimParam, Vehicle
from tests.conversations.virtual import converse, run
from tests.shell import Tap

Faults: TypeAlias = dict[str, Any]

TABLE = [
    SimParam(f"P{number:02}", ParamType.INT32 if number % 3 else ParamType.REAL32, number)
    for number in range(24)
]
MAKERS: dict[str, Callable[[], Vehicle]] = {
    "px4": lambda: PX4Vehicle(table=TABLE),
    "px4 with errors": lambda: PX4Vehicle(table=TABLE, param_error=True),
    "ardupilot": lambda: ArduPilotVehicle(table=TABLE),
    "ardupilot by list": lambda: ArduPilotVehicle(table=TABLE, ftp=False),
    "generic": lambda: GenericVehicle(TABLE),
}
FAULTS = [
    Faults(),
    Faults(loss=0.15, delay=0.05),
    Faults(duplicate=0.3, reorder=0.3, jitter=0.03, delay=0.02),
    Faults(loss=0.05, loss_burst=4.0, delay=0.3),
]
SETTINGS = settings(
    max_examples=25,
    stateful_step_count=10,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow],
)
places = st.integers(0, len(TABLE) - 1)
values = st.integers(-100, 100)
seconds = st.floats(0.0, 3.0)


@dataclass
class World:
    """A session while it runs."""

    vehicle: Vehicle
    endpoint: Tap
    session: Session


class Sessions(RuleBasedStateMachine):
    """Collects the steps of a session, and runs it in virtual time at the end."""

    @initialize(kind=st.sampled_from(list(MAKERS)), faults=st.sampled_from(FAULTS), seed=st.integers(0, 1000))
    def begin(self, kind: str, faults: Faults, seed: int) -> None:
        """Choose vehicle and link."""
        self.kind, self.faults, self.seed = kind, faults, seed
        self.steps: list[Callable[[World], Awaitable[object]]] = []

    @rule()
    def fetch(self) -> None:
        """Fetch all parameters."""
        self.steps.append(lambda world: fetch_all(world.session))

    @rule(after=seconds)
    def fetch_cancelled(self, after: float) -> None:
        """Cancel a fetch."""

        async def step(world: World) -> None:
            with anyio.move_on_after(after):
                await fetch_all(world.session, refresh=True)

        self.steps.append(step)

    @rule(place=places)
    def read(self, place: int) -> None:
        """Read a parameter."""
        self.steps.append(lambda world: read(world.session, TABLE[place].name))

    @rule(place=places, value=values)
    def write(self, place: int, value: int) -> None:
        """Set a parameter; the vehicle has the value that is reported."""

        async def step(world: World) -> None:
            result = await write(world.session, TABLE[place].name, value)
            held = world.vehicle.param(TABLE[place].name)
            assert result.actual == value == held.value == world.session.table.params[held.name].value

        self.steps.append(step)

    @rule(place=places, value=values)
    def change(self, place: int, value: int) -> None:
        """Change a value on board."""

        async def step(world: World) -> None:
            world.vehicle.set_param(TABLE[place].name, value)

        self.steps.append(step)

    @rule(length=st.sampled_from([0.5, 4.0, 12.0]))
    def fade(self, length: float) -> None:
        """Let the vehicle be silent for some time."""

        async def step(world: World) -> None:
            world.endpoint.silent_at = anyio.current_time()
            await anyio.sleep(length)
            world.endpoint.silent_at = math.inf

        self.steps.append(step)

    @rule(down=st.sampled_from([0.3, 2.0, 8.0]))
    def restart(self, down: float) -> None:
        """Let the vehicle start again."""

        async def step(world: World) -> None:
            world.vehicle.reboot(anyio.current_time(), down=down)

        self.steps.append(step)

    @rule(length=seconds)
    def wait(self, length: float) -> None:
        """Let time pass."""
        self.steps.append(lambda world: anyio.sleep(length))

    def teardown(self) -> None:
        """Run the session."""
        if getattr(self, "steps", None):
            run(self._session)

    async def _session(self) -> None:
        vehicle = MAKERS[self.kind]()
        endpoint = Tap(Air.symmetric([vehicle], seed=self.seed, **self.faults))
        async with converse(endpoint) as conversation:
            node = await conversation.node()
            session = node.plain
            world = World(vehicle, endpoint, session)
            for step in self.steps:
                with suppress(NoReply):
                    await step(world)
            await anyio.sleep(12.0)
            for _ in range(4):
                with suppress(NoReply):
                    result: Any = await fetch_all(session)
                    if not result.missing:
                        break
            await node.identified()  # is requested whenever the component is heard again
            assert not session.channel.inboxes
            assert not session.writing
            held = {name: each.bits for name, each in session.table.params.items()}
            assert held == {name: each.bits for name, each in vehicle.params.items()}
            if isinstance(vehicle, ArduPilotVehicle):  # which has MAVFTP
                await anyio.sleep(4.0)
                assert vehicle.open_files == []


def test_sessions_end_with_the_vehicles_table() -> None:
    run_state_machine_as_test(Sessions, settings=SETTINGS)


@pytest.mark.slow
@pytest.mark.parametrize("number", range(int(os.environ.get("SESSIONS", "200")) // 100))
def test_a_hundred_sessions_of_a_seed(number: int) -> None:
    """`make soak` runs many of these. A failure is reported with the shortest session that fails."""
    chosen = settings(SETTINGS, max_examples=100, stateful_step_count=30, derandomize=False, database=None)
    run_state_machine_as_test(seed(number)(type("Seeded", (Sessions,), {})), settings=chosen)
