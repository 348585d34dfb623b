"""Simulated vehicles for the tests of other programs, each with its own simulated radio.

The fixtures of the pytest plugin return these functions; other test runners can call them directly::

    px4 = sim_px4(loss=0.05, delay=0.1, seed=1)
    await your_program(px4)                        # in place of a link's name
    assert px4.vehicle.values["MC_ROLL_P"] == 6.5  # the value on board
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields
from typing import Any, Final, Generic, TypeAlias, TypeVar

from paramclient.errors import UsageError
from paramclient.sim import Air, ArduPilotVehicle, FaultyLink, PX4Vehicle, Vehicle

__all__ = ["MakeArduPilot", "MakePX4", "SimVehicle", "sim_ardupilot", "sim_px4"]

V = TypeVar("V", bound=Vehicle)

LIST_PERIOD_MAX: Final = 0.02
"""Longest time between two bursts of a list, in seconds, for a pace that sends several values per burst."""


class SimVehicle(Generic[V]):
    """A simulated vehicle behind a faulty link. An `Endpoint`, to be given to a program in place of a link.

    Args:
        vehicle: the vehicle.
        seed: of the faulty link's random numbers; equal seeds give equal sequences.
        faults: as in `paramclient.sim.FaultyLink`, in both directions; `delay` is one-way.

    Attributes:
        vehicle: the simulated vehicle: `params`, `values` and `set_param`, and the received `requests`.
        air: the simulated radio: sent and lost bytes, `air.uplink` and `air.downlink`.

    Raises:
        UsageError: a fault is out of range.
    """

    def __init__(self, vehicle: V, *, seed: int = 0, **faults: Any) -> None:
        self.vehicle = vehicle
        self.air = Air.symmetric([vehicle], seed=seed, **faults)

    def __repr__(self) -> str:
        return f"<SimVehicle {type(self.vehicle).__name__} {self.vehicle.system}/{self.vehicle.component}>"

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes from the program. See `Endpoint` for this and the next three methods."""
        self.air.receive(data, now)

    def tick(self, now: float) -> None:
        self.air.tick(now)

    def next_deadline(self) -> float | None:
        return self.air.next_deadline()

    def data_to_send(self) -> list[bytes]:
        return self.air.data_to_send()


def sim_px4(*, pace: float | None = None, seed: int = 0, **options: Any) -> SimVehicle[PX4Vehicle]:
    """Return a simulated PX4 vehicle; its link has no faults by default.

    Args:
        pace: list values per second; None for the rate of a real vehicle on UDP, about 1000. A telemetry
            radio of 57600 baud carries about 40.
        seed: of the faulty link's random numbers.
        options: the faults of `paramclient.sim.FaultyLink` (`loss`, `delay`, `rate`, …), and the arguments
            of `paramclient.sim.PX4Vehicle` (`table`, `system`, `hash_check`, …).

    Raises:
        UsageError: an argument is invalid.
        TypeError: there is no such argument.
    """
    return _make(PX4Vehicle, pace, seed, options)


def sim_ardupilot(
    *, pace: float | None = None, seed: int = 0, **options: Any
) -> SimVehicle[ArduPilotVehicle]:
    """Return a simulated ArduPilot vehicle. Takes the arguments of `paramclient.sim.ArduPilotVehicle`.

    Like `sim_px4`. Sends a list at about 1700 values per second on UDP. With `ftp=False`, a client uses the
    list download.
    """
    return _make(ArduPilotVehicle, pace, seed, options)


MakePX4: TypeAlias = Callable[..., SimVehicle[PX4Vehicle]]
MakeArduPilot: TypeAlias = Callable[..., SimVehicle[ArduPilotVehicle]]


def _make(kind: Callable[..., V], pace: float | None, seed: int, options: dict[str, Any]) -> SimVehicle[V]:
    faults = {each.name: options.pop(each.name) for each in fields(FaultyLink) if each.name in options}
    if pace is not None:
        if not (math.isfinite(pace) and pace > 0.0):
            raise UsageError(f"pace must be a number of values per second above 0, not {pace}")
        if options.keys() & {"burst", "period"}:
            raise UsageError("pace replaces burst and period: give either pace or these two")
        burst = max(1, int(pace * LIST_PERIOD_MAX))
        options |= {"burst": burst, "period": burst / pace}
    return SimVehicle(kind(**options), seed=seed, **faults)
