"""The subcommand sim: runs a simulated vehicle for other programs."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

from anyio.abc import TaskStatus
from cyclopts import Parameter

from paramclient.cli.options import IN_ID_RANGE, Id, Positive
from paramclient.cli.output import print_line
from paramclient.client.signing import read_key, timestamp_now
from paramclient.errors import UsageError
from paramclient.links import Link, LinkKind, LinkSpec, create_link, parse_link, serve_endpoint
from paramclient.links.tcp import TcpIn
from paramclient.links.udp import UdpIn

if TYPE_CHECKING:
    from paramclient.sim import Vehicle

__all__ = ["FaultOptions", "VehicleFaults", "sim"]


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True, slots=True)
class FaultOptions:
    """Faults of the link, as `Air.symmetric` takes them. The texts below the fields are their help."""

    loss: float = 0.0
    """Share of lost datagrams, 0 to 1. This and the following options apply to each direction."""

    loss_burst: float = 1.0
    """Average number of consecutive lost datagrams; more than 1 for a fading link."""

    delay: float = 0.0
    """Delay in seconds."""

    jitter: float = 0.0
    """Maximum additional random delay in seconds."""

    duplicate: float = 0.0
    """Share of datagrams that arrive twice, 0 to 1."""

    reorder: float = 0.0
    """Share of datagrams that are overtaken by later ones, 0 to 1."""

    bit_errors: float = 0.0
    """Probability of each single bit to be inverted."""

    rate: float | None = None
    """Limit in bytes per second. Default: no limit."""

    queue: int | None = None
    """Bytes that may be queued at --rate. Default: no limit."""

    seed: int = 0
    """Seed of the random numbers: equal seeds give equal faults."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True, slots=True)
class VehicleFaults:
    """Faults of the vehicle. The texts below the fields are their help."""

    dead: tuple[str, ...] = ()
    """Index or name of a parameter that is never listed, and whose reads are never answered. May be given
    several times."""

    list_stops_at: Positive = None
    """Number of values after which the list stops, once. Default: never."""

    boot_time: float = 0.0
    """Seconds after each start in which the vehicle reports that it boots, and does not send its list."""

    reboot_at: Positive = None
    """Number of listed values after which the vehicle reboots, once. Default: never."""

    reboot_down: float = 1.0
    """Seconds that the vehicle is off during each reboot."""

    armed: bool = False
    """Report that the vehicle is armed; it then refuses to reboot."""

    @property
    def options(self) -> dict[str, Any]:
        """The arguments for the simulated vehicle."""
        return {
            "dead": [int(each) if each.isdecimal() else each for each in self.dead],
            "boot_time": self.boot_time,
            "armed": self.armed,
            "reboot_down": self.reboot_down,
        }

    def apply_to(self, vehicle: Vehicle) -> None:
        """Apply the faults that are no arguments."""
        if self.reboot_at is not None:
            vehicle.when_listed(self.reboot_at, partial(vehicle.reboot, down=self.reboot_down))
        if self.list_stops_at is not None:
            vehicle.when_listed(self.list_stops_at, vehicle.stop_list)


_NO_FAULTS: Final = FaultOptions()
_NO_VEHICLE_FAULTS: Final = VehicleFaults()


async def sim(
    autopilot: Literal["px4", "ardupilot", "camera"],
    /,
    *,
    link: str = "udpout:127.0.0.1:14550",
    system: Annotated[int, IN_ID_RANGE] = 1,
    component: Id = None,
    param_error: bool = False,
    signing_key: Path | None = None,
    usb: bool = False,
    metadata: bool = False,
    vehicle_faults: VehicleFaults = _NO_VEHICLE_FAULTS,
    faults: FaultOptions = _NO_FAULTS,
) -> None:
    """Run a simulated vehicle for other programs, until Ctrl-C.

    Args:
        autopilot: The firmware to simulate, or a camera with extended parameters.
        link: The link to send to or to listen on. With port 0, the system chooses the port, which is printed.
        system: System id of the vehicle.
        component: Component id of the vehicle. Default: 1; 100 for a camera.
        param_error: Answer invalid requests with PARAM_ERROR, as newer firmware does.
        signing_key: A file with the signing key: the vehicle signs its frames and requires signed ones.
        usb: With a key, also accept unsigned frames, as ArduPilot does over USB.
        metadata: px4: describe the parameters on request, as PX4 on a board with enough memory does.
    """
    from paramclient.sim import (  # only here: other subcommands need none
        Air,
        ArduPilotVehicle,
        Camera,
        PX4Vehicle,
    )

    if metadata and autopilot != "px4":
        raise UsageError(
            "--metadata is for px4; the other simulated vehicles do not describe their parameters"
        )
    spec = parse_link(link)
    if spec.kind is LinkKind.SIM:
        raise UsageError(
            f"{spec.name} is itself a simulated vehicle; sim needs a link to other programs, such as "
            "udpout:127.0.0.1:14550"
        )
    real = create_link(spec)
    kinds = {"px4": PX4Vehicle, "ardupilot": ArduPilotVehicle, "camera": Camera}
    options = vehicle_faults.options
    options.update({"param_error": param_error, "stream": real.is_stream, "usb": usb})
    if signing_key is not None:
        options.update({"signing_key": read_key(signing_key), "signing_timestamp": timestamp_now()})
    chosen = (100 if autopilot == "camera" else 1) if component is None else component
    make = partial(PX4Vehicle, metadata=True) if metadata else kinds[autopilot]
    vehicle = make(system=system, component=chosen, **options)
    vehicle_faults.apply_to(vehicle)
    air = Air.symmetric([vehicle], **asdict(faults))
    announcement = _Announcement(f"{autopilot} {system}/{chosen}", spec)
    await serve_endpoint(air, real, task_status=announcement)


class _Announcement(TaskStatus[Link]):
    """Prints the link of the vehicle as soon as it is open."""

    def __init__(self, vehicle: str, spec: LinkSpec) -> None:
        self._vehicle = vehicle
        self._spec = spec

    def started(self, value: Link | None = None) -> None:
        """Print the link, with the port that the system chose."""
        where = f"speaks to {self._spec}"
        if isinstance(value, UdpIn | TcpIn) and value.address is not None:
            where = f"listens on {replace(self._spec, port=value.address[1])}"
        print_line(f"{self._vehicle} {where}; Ctrl-C ends it")
