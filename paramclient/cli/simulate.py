"""The command that plays a vehicle for other programs: sim."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

from anyio.abc import TaskStatus
from cyclopts import Parameter
from cyclopts.validators import Number

from paramclient.cli.output import print_line
from paramclient.client.signing import read_key, timestamp_now
from paramclient.errors import UsageError
from paramclient.links import Link, LinkKind, LinkSpec, create_link, parse_link, serve_endpoint
from paramclient.links.tcp import TcpIn
from paramclient.links.udp import UdpIn

if TYPE_CHECKING:
    from paramclient.sim import OtherStation, Vehicle
    from paramclient.sim.vehicle import VehicleOptions

__all__ = ["Faults", "Misfortunes", "sim"]


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True, slots=True)
class Faults:
    """What `Air.symmetric` takes. The texts below the fields are their help."""

    loss: float = 0.0
    """The share of datagrams that never arrive, 0 to 1; this and the others count for each direction."""

    loss_burst: float = 1.0
    """How many in a row are lost, on average: more than 1 for a link that fades."""

    delay: float = 0.0
    """Seconds on the way."""

    jitter: float = 0.0
    """Further seconds on the way, at random between 0 and this."""

    duplicate: float = 0.0
    """The share that arrives twice."""

    reorder: float = 0.0
    """The share that is overtaken."""

    bit_errors: float = 0.0
    """The chance of each single bit to arrive turned over."""

    rate: float | None = None
    """Bytes per second. Without it, no limit."""

    queue: int | None = None
    """Bytes that may wait for their turn at --rate. Without it, no limit."""

    seed: int = 0
    """Of the random numbers: the same faults for the same seed."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True, slots=True)
class Misfortunes:
    """What befalls the vehicle. The texts below the fields are their help."""

    dead: tuple[str, ...] = ()
    """An index or a name that is never listed, and never answered when it is read; may be given again."""

    list_stops_at: int | None = None
    """After how many values the list falls silent. Without it, never."""

    list_stops: float = 1
    """How many lists --list-stops-at happens to; inf for all."""

    boot_time: float = 0.0
    """Seconds after each start in which it says that it boots, and does not send its list."""

    reboot_at: int | None = None
    """After how many values of a list it starts anew, once. Without it, never."""

    reboot_down: float = 1.0
    """Seconds for which it is off then, and when it was told to start again."""

    armed: bool = False
    """Say that it is armed: then it does not start again when it is told to."""

    high_latency: bool = False
    """Speak as on a satellite link: HIGH_LATENCY2 every 5 s, and no list."""

    other_list_every: float | None = None
    """Seconds after which another ground station asks for the list, again and again. Without it, never."""

    @property
    def options(self) -> VehicleOptions:
        """What is said when the vehicle is made."""
        return {
            "dead": [int(each) if each.isdecimal() else each for each in self.dead],
            "list_stops_at": self.list_stops_at,
            "list_stops": self.list_stops,
            "boot_time": self.boot_time,
            "high_latency": self.high_latency,
            "armed": self.armed,
            "reboot_down": self.reboot_down,
        }

    def befall(self, vehicle: Vehicle) -> list[OtherStation]:
        """See to the rest; the other stations on the channel."""
        from paramclient.sim import OtherStation

        if self.reboot_at is not None:
            vehicle.when_listed(self.reboot_at, partial(vehicle.reboot, down=self.reboot_down))
        if self.other_list_every is None:
            return []
        return [
            OtherStation(
                target_system=vehicle.system,
                target_component=vehicle.component,
                list_every=self.other_list_every,
            )
        ]


_NO_FAULTS: Final = Faults()
_NO_MISFORTUNES: Final = Misfortunes()
_Id = Annotated[int, Parameter(validator=Number(gte=1, lte=255))]


async def sim(
    autopilot: Literal["px4", "ardupilot"],
    /,
    *,
    link: str = "udpout:127.0.0.1:14550",
    system: _Id = 1,
    component: _Id = 1,
    param_error: bool = False,
    signing_key: Path | None = None,
    usb: bool = False,
    misfortunes: Misfortunes = _NO_MISFORTUNES,
    faults: Faults = _NO_FAULTS,
) -> None:
    """Run a simulated vehicle for other programs, until Ctrl-C.

    Args:
        autopilot: Which one.
        link: Whom it speaks to, or where it listens; with port 0 the system chooses one, which is printed.
        system: Its system id.
        component: Its component id.
        param_error: Answer what cannot be done with PARAM_ERROR, as newer firmware does.
        signing_key: A file with the key with which it signs, and everybody else must.
        usb: With a key, still take what is not signed, as ArduPilot does over USB.
    """
    from paramclient.sim import Air, ArduPilotVehicle, PX4Vehicle  # only here: no other command needs them

    spec = parse_link(link)
    if spec.kind is LinkKind.SIM:
        raise UsageError(f"{spec.name} is a vehicle itself; a simulated one needs a link to other programs")
    real = create_link(spec)
    make = PX4Vehicle if autopilot == "px4" else ArduPilotVehicle
    options = misfortunes.options
    options.update({"param_error": param_error, "stream": real.is_stream, "usb": usb})
    if signing_key is not None:
        options.update({"signing_key": read_key(signing_key), "signing_timestamp": timestamp_now()})
    vehicle = make(system=system, component=component, **options)
    air = Air.symmetric([vehicle], others=misfortunes.befall(vehicle), **asdict(faults))
    announcement = _Announcement(f"{autopilot} {system}/{component}", spec)
    await serve_endpoint(air, real, task_status=announcement)


class _Announcement(TaskStatus[Link]):
    """Prints where the vehicle is, as soon as the link is open."""

    def __init__(self, who: str, spec: LinkSpec) -> None:
        self._who = who
        self._spec = spec

    def started(self, value: Link | None = None) -> None:
        where = f"speaks to {self._spec}"
        if isinstance(value, UdpIn | TcpIn) and value.address is not None:
            where = f"listens on {replace(self._spec, port=value.address[1])}"
        print_line(f"{self._who} {where}; Ctrl-C ends it")
