"""Simulated vehicles for the tests of a program, each with a radio of its own.

The fixtures of the pytest plugin give these functions; they serve any other test runner as well::

    px4 = sim_px4(loss=0.05, delay=0.1, seed=1)
    await your_program(px4)                        # in the place of a link's name
    assert px4.vehicle.values["MC_ROLL_P"] == 6.5  # what is on board
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final, Generic, TypeAlias, TypeVar, Unpack

from paramclient.errors import UsageError
from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle, Vehicle
from paramclient.sim.air import Faults

__all__ = ["MakeArduPilot", "MakePX4", "SimVehicle", "sim_ardupilot", "sim_px4"]

V = TypeVar("V", bound=Vehicle)

GO: Final = 0.02
"""Seconds between two goes of a list at most, where a pace is asked for that gives each more than a value."""


class SimVehicle(Generic[V]):
    """A simulated vehicle and the air around it; an `Endpoint`, to be given to a program in a link's place.

    Args:
        vehicle: the vehicle.
        seed: of the air's random numbers; the same ones for the same seed.
        faults: those of `paramclient.sim.FaultyLink`, in both directions; `delay` is for one way.

    Attributes:
        vehicle: what is on board: `params`, `values` and `set_param`, and the `requests` that it got.
        air: what lies between: what was sent and lost, `air.uplink` and `air.downlink`.

    Raises:
        UsageError: a fault is outside its range.
    """

    def __init__(self, vehicle: V, *, seed: int = 0, **faults: Unpack[Faults]) -> None:
        self.vehicle = vehicle
        self.air = Air.symmetric([vehicle], seed=seed, **faults)

    def __repr__(self) -> str:
        return f"<SimVehicle {type(self.vehicle).__name__} {self.vehicle.system}/{self.vehicle.component}>"

    def receive(self, data: bytes, now: float) -> None:
        """See `Endpoint`, as of the other three."""
        self.air.receive(data, now)

    def tick(self, now: float) -> None:
        self.air.tick(now)

    def next_deadline(self) -> float | None:
        return self.air.next_deadline()

    def data_to_send(self) -> list[bytes]:
        return self.air.data_to_send()


def sim_px4(*, pace: float | None = None, seed: int = 0, **options: Any) -> SimVehicle[PX4Vehicle]:
    """A PX4 vehicle, behind a radio without faults unless some are asked for.

    Args:
        pace: values of a list per second; None for that of a real one on UDP, about 1000. On a telemetry
            radio of 57600 baud it is about 40.
        seed: of the radio's random numbers.
        options: the faults of `paramclient.sim.FaultyLink` (`loss`, `delay`, `rate`, …), and all that
            `paramclient.sim.PX4Vehicle` takes (`table`, `system`, `hash_check`, …).

    Raises:
        UsageError: an argument cannot be.
        TypeError: there is no such argument.
    """
    return _make(PX4Vehicle, pace, seed, options)


def sim_ardupilot(
    *, pace: float | None = None, seed: int = 0, **options: Any
) -> SimVehicle[ArduPilotVehicle]:
    """An ArduPilot vehicle; as `sim_px4`, with what `paramclient.sim.ArduPilotVehicle` takes.

    Its list comes at about 1700 values per second on UDP. `ftp=False` makes a client fetch by the list.
    """
    return _make(ArduPilotVehicle, pace, seed, options)


MakePX4: TypeAlias = Callable[..., SimVehicle[PX4Vehicle]]
MakeArduPilot: TypeAlias = Callable[..., SimVehicle[ArduPilotVehicle]]


def _make(kind: Callable[..., V], pace: float | None, seed: int, options: dict[str, Any]) -> SimVehicle[V]:
    faults: Faults = {name: options.pop(name) for name in Faults.__annotations__ if name in options}  # type: ignore[assignment]  # by its own names
    if pace is not None:
        if not (math.isfinite(pace) and pace > 0.0):
            raise UsageError(f"pace is a number of values per second above 0, not {pace}")
        if options.keys() & {"burst", "period"}:
            raise UsageError("pace stands for burst and period: give one or the others")
        burst = max(1, int(pace * GO))
        options |= {"burst": burst, "period": burst / pace}
    return SimVehicle(kind(**options), seed=seed, **faults)
