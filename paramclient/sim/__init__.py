"""Simulated vehicles and a faulty link, for tests of other programs.

All of it is sans-I/O: bytes and the time are arguments. There are no sockets, clocks or threads, and
every run has the same outcome. A complete session is a loop::

    vehicle = PX4Vehicle()
    air = Air.symmetric([vehicle], loss=0.05, delay=0.03, seed=1)
    now = 0.0
    air.tick(now)                                  # the first call starts all vehicles
    while now < 10.0:
        for datagram in air.data_to_send():
            ...                                    # pass it to the program, and its responses back:
            air.receive(response, now)
        now = air.next_deadline()
        air.tick(now)
    assert program.params == vehicle.values

The vehicles behave as measured on real ones, with the real timing. The docstrings of `PX4Vehicle` and
`ArduPilotVehicle` describe the differences between the two.

- `px4`, `ardupilot`: the autopilots. `camera`: a camera with extended parameters.
- `vehicle`, `device`: their base classes, and the vehicle of the standard.
- `param_table`, `ftp`: parameter tables, the MAVFTP server.
- `air`: the faulty link.
"""

from paramclient.sim.air import Air, Endpoint, FaultyLink
from paramclient.sim.ardupilot import ArduPilotVehicle
from paramclient.sim.camera import Camera
from paramclient.sim.param_table import SimParam, Table, ardupilot_table, px4_table
from paramclient.sim.px4 import PX4Vehicle
from paramclient.sim.vehicle import GenericVehicle, Vehicle

__all__ = [
    "Air",
    "ArduPilotVehicle",
    "Camera",
    "Endpoint",
    "FaultyLink",
    "GenericVehicle",
    "PX4Vehicle",
    "SimParam",
    "Table",
    "Vehicle",
    "ardupilot_table",
    "px4_table",
]
