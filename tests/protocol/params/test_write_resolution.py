"""Changes that are too small for PX4: what is said of them, and of which not."""

from __future__ import annotations

import math

import pytest
from paramclient.protocol.params.small_changes import CHANGE_MIN, note_on_small_change

from paramclient.model.values import Param, ParamType, WireValue, bits_of
from paramclient.sim import ArduPilotVehicle, PX4Vehicle
from tests.simulation import Simulation


def held(value: WireValue, kind: ParamType = ParamType.REAL32, default: float | None = None) -> Param:
    return Param("A", value, kind, 0, bits_of(value, kind), default=default)


SMALL = 0.5 + 2.0**-24


@pytest.mark.parametrize(
    ("before", "after", "note"),
    [
        (held(0.5), held(SMALL), "its next start may bring 0.5 back"),
        (held(0.0), held(-CHANGE_MIN), "its next start may bring 0.0 back"),
        (held(0.5, default=2.0), held(SMALL, default=2.0), "its next start may bring 0.5 back"),
        (held(3.0), held(SMALL, default=0.5), "with its next start it is 0.5 again"),
        (held(0.5), held(0.5), ""),
        (held(SMALL, default=0.5), held(0.5, default=0.5), "may bring"),
        (held(0.5), held(0.5 + 2 * CHANGE_MIN), ""),
        (held(3.0), held(0.5, default=0.5), ""),
        (held(0.5), held(math.nan), ""),
        (held(0.5), held(math.inf), ""),
        (held(1, ParamType.INT32), held(2, ParamType.INT32), ""),
        (held(1, ParamType.INT32), held(1.0), ""),
    ],
)
def test_the_note_on_a_change_that_px4_does_not_save(before: Param, after: Param, note: str) -> None:
    said = note_on_small_change(before, after)
    assert note in said
    assert bool(said) is bool(note)


@pytest.mark.parametrize("vehicle", [PX4Vehicle, ArduPilotVehicle])
def test_a_set_resolves_the_type_of_px4_alone(vehicle: type[PX4Vehicle] | type[ArduPilotVehicle]) -> None:
    simulation = Simulation(vehicle(table={"A": 0.5}))
    done = simulation.set("A", SMALL)
    assert done.status == "accepted"
    assert bool(done.note) is (vehicle is PX4Vehicle)
    assert simulation.set("A", 0.75).note == ""
