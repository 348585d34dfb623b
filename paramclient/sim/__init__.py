"""Simulated vehicles and a faulty link, to test programs against.

Everything here speaks bytes and takes the time as an argument: no sockets, no clock, no threads, and the
same outcome on every run. A whole session needs no more than a loop::

    vehicle = PX4Vehicle()
    air = Air.symmetric([vehicle], loss=0.05, delay=0.03, seed=1)
    now = 0.0
    air.tick(now)                                  # the first call switches everything on
    while now < 10.0:
        for datagram in air.data_to_send():
            ...                                    # give it to the program, and its answers back:
            air.receive(answer, now)
        now = air.next_deadline()
        air.tick(now)
    assert program.params == vehicle.values

The vehicles behave as real ones were measured, at their real pace; what differs between them stands in the
docstrings of `PX4Vehicle` and `ArduPilotVehicle`.
"""

from __future__ import annotations

from paramclient.sim.air import Air, Endpoint, FaultyLink
from paramclient.sim.ardupilot import ArduPilotVehicle
from paramclient.sim.generic import GenericVehicle
from paramclient.sim.other import OtherStation
from paramclient.sim.param_table import SimParam, Table, ardupilot_table, px4_table
from paramclient.sim.px4 import PX4Vehicle
from paramclient.sim.vehicle import Vehicle

__all__ = [
    "Air",
    "ArduPilotVehicle",
    "Endpoint",
    "FaultyLink",
    "GenericVehicle",
    "OtherStation",
    "PX4Vehicle",
    "SimParam",
    "Table",
    "Vehicle",
    "ardupilot_table",
    "px4_table",
]
