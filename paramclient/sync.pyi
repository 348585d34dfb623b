"""The types of the blocking client. `make sync` writes this file."""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Literal, Self, TypeAlias, Unpack

from paramclient.cache import ParamCache
from paramclient.client.client import COMPONENT_TIMEOUT, FetchedAll
from paramclient.client.component import REBOOT_TIMEOUT, ComponentState
from paramclient.client.signing import Signing
from paramclient.client.taps import TrafficReport
from paramclient.links import Link
from paramclient.metadata.info import Metadata
from paramclient.metadata.store import MetadataStore
from paramclient.model.identity import Identity
from paramclient.model.paramset import ParamMap, WrittenParam
from paramclient.model.values import Encoding, Param, Settable
from paramclient.protocol import ftp
from paramclient.protocol.addresses import Address
from paramclient.protocol.fetch import FetchResult, Policy, Progress
from paramclient.protocol.set_results import SetManyResult, SetOutcome, SetResult
from paramclient.protocol.table import Change
from paramclient.protocol.watch import SyncState
from paramclient.provision.apply_restore import FleetResult, Outcome
from paramclient.provision.execution import ApplyOptions, ApplyResult
from paramclient.provision.planning import Plan, PlanOptions
from paramclient.sim import Endpoint
from paramclient.wire.signing import SigningKey, SigningReport

__all__ = [
    "AnyParams",
    "Changes",
    "Component",
    "Event",
    "Events",
    "ParamClient",
    "apply",
    "for_each",
    "metadata_of",
    "plan",
    "restore",
]

class Component:
    """One component of a vehicle; see `ParamClient.component`."""

    system: int
    component: int
    is_extended: bool
    params: ParamMap

    @property
    def ext(self) -> Component:
        """The extended parameters of the component (PARAM_EXT_*), whose values are also text and bytes."""

    @property
    def autopilot(self) -> str:
        """Autopilot of its heartbeat: px4, ardupilot, generic, …; "unknown" before the first heartbeat."""

    @property
    def identity(self) -> Identity:
        """Identity of the vehicle from AUTOPILOT_VERSION: hardware id, firmware, capabilities, if known."""

    @property
    def encoding(self) -> Encoding:
        """Encoding of its parameter values in messages: bytewise or C cast."""

    @property
    def encoding_reason(self) -> str:
        """The reason for `encoding`, as text."""

    @property
    def count(self) -> int | None:
        """The `param_count` of the component; None before its first value."""

    @property
    def hash(self) -> int | None:
        """PX4's hash or ArduPilot's checksum of the complete table; None if it is not known."""

    @property
    def state(self) -> ComponentState:
        """State of the table."""

    @property
    def sync_state(self) -> SyncState:
        """Whether the table matches the vehicle, and the running check or update."""

    @property
    def address(self) -> Address:
        """Its key in `ParamClient.components`: (system, component), with `split_peers` also the peer."""

    @property
    def peer(self) -> str:
        """Address and port from which its messages arrive, and to which requests go."""

    @property
    def is_armed(self) -> bool | None:
        """Whether the vehicle is armed, from `base_mode` of its last heartbeat."""

    @property
    def silence(self) -> float:
        """Seconds since its last message. After 5 s the component is lost, see `Event`."""

    @property
    def round_trip(self) -> float | None:
        """Smoothed round-trip time in seconds; None before the first response."""

    def get(self, name: str | int, *, timeout: float | None = None) -> Param:
        """Read one parameter from the vehicle."""

    def set(
        self,
        name: str,
        value: Settable,
        *,
        timeout: float | None = None,
        settle: float = 0.0,
        force: bool = False,
        durable: bool = False,
        author: str | None = None,
    ) -> SetResult:
        """Write one parameter, and verify the value that the vehicle acknowledges."""

    def set_many(
        self,
        values: Mapping[str, Settable] | Iterable[tuple[str, Settable]],
        *,
        progress: Callable[[SetOutcome], None] | None = None,
        timeout: float | None = None,
        settle: float = 0.0,
        force: bool = False,
        durable: bool = False,
        author: str | None = None,
    ) -> SetManyResult:
        """Write many parameters in one call, and verify each as `set` does."""

    def fetch_all(
        self,
        *,
        refresh: bool = False,
        timeout: float | None = None,
        progress: Callable[[Progress], None] | None = None,
    ) -> FetchResult:
        """Fetch all parameters. Uses the cache if the vehicle confirms it, otherwise downloads."""

    def setup_signing(self, key: SigningKey | None, *, link_is_safe: bool = False) -> None:
        """Give the vehicle a signing key with SETUP_SIGNING, or with None, disable its signing."""

    def reboot(self, *, system: int | None = None, timeout: float | None = REBOOT_TIMEOUT) -> Component:
        """Reboot the vehicle, and wait until it is back and identified. Written values are saved before."""

    def read_file(
        self,
        path: str,
        *,
        size_max: int = ftp.FILE_SIZE_MAX,
        progress: Callable[[int, int | None], None] | None = None,
        timeout: float | None = None,
    ) -> bytes:
        """Read a file over MAVFTP. Its session on board is closed, also on cancellation."""

    def file_checksum(self, path: str, *, timeout: float | None = None) -> int:
        """Return the CRC-32 of a file, computed by the component; see `crc32_px4`."""

    def changes(self) -> Changes:
        """Return a stream of parameter changes from now on: `async for change in component.changes()`."""

AnyParams: TypeAlias = Mapping[str, WrittenParam | Param | Settable]

class Changes(Iterator[Change]):
    """Stream of the changes since its creation; see `Component.changes`."""

    def __next__(self) -> Change: ...
    def next(self, timeout: float | None = None) -> Change: ...

@dataclass(frozen=True, slots=True)
class Event:
    """What has happened to a component."""

    component: Component
    kind: Literal["discovered", "lost", "found", "rebooted", "resynced"]
    silence: float | None = None
    changed: tuple[str, ...] = ()
    hash: int | None = None

class Events(Iterator[Event]):
    """Stream of the component events since its creation; see `ParamClient.events`."""

    def __next__(self) -> Event: ...
    def next(self, timeout: float | None = None) -> Event: ...

class ParamClient:
    """A ground station for the MAVLink parameter protocol on one link, as an async context manager."""

    link: Link
    cache: ParamCache | None
    listens_only: bool

    def __enter__(self) -> Self: ...
    def __exit__(self, *error: object) -> None: ...
    def open(self) -> Self: ...
    def close(self) -> None: ...
    def __init__(
        self,
        link: str | Link | Endpoint,
        *,
        cache: ParamCache | str | os.PathLike[str] | bool | None = None,
        system: int = 255,
        component: int = 190,
        encoding: Encoding | None = None,
        watch_interval: float | None = None,
        policy: Policy | str = Policy.AUTO,
        traffic: bool = False,
        listen_only: bool = False,
        tlog: str | os.PathLike[str] | None = None,
        signing: Signing | SigningKey | None = None,
        split_peers: bool = False,
    ) -> None: ...
    @property
    def components(self) -> Mapping[Address, Component]:
        """All components from which messages have arrived, by (system, component). Read-only and live."""

    @property
    def autopilots(self) -> list[Component]:
        """The autopilot of each system, sorted by system id, without cameras, gimbals and the like."""

    @property
    def bytes_received(self) -> int:
        """Bytes received over the link."""

    @property
    def bytes_sent(self) -> int:
        """Bytes of all sent frames, including heartbeats."""

    def events(self) -> Events:
        """Return a stream of component events from now on: `async for event in client.events()`."""

    def component(
        self,
        system: int | None = None,
        component: int | None = None,
        *,
        peer: str | None = None,
        timeout: float | None = COMPONENT_TIMEOUT,
    ) -> Component:
        """Return the component with this address, after its first message."""

    def find_autopilots(
        self, *, expect: int | None = None, timeout: float | None = COMPONENT_TIMEOUT
    ) -> list[Component]:
        """Return the autopilot of every vehicle on the link, sorted by system id; for programs for fleets."""

    def only_component(
        self,
        system: int | None = None,
        component: int | None = None,
        *,
        peer: str | None = None,
        timeout: float | None = COMPONENT_TIMEOUT,
    ) -> Component:
        """Return the component with this address if the choice is unambiguous; for programs that write."""

    def successor(
        self, component: Component, system: int, *, timeout: float | None = COMPONENT_TIMEOUT
    ) -> Component:
        """Return the component of the same vehicle under its new system id, after its first message there."""

    def fetch_all(
        self, system: int | None = None, *, refresh: bool = False, timeout: float | None = None
    ) -> FetchedAll:
        """Update the tables of all components of one system, or of every system on the link."""

    def traffic_report(self, *, is_recent: bool = False) -> TrafficReport:
        """Return the traffic statistics of the link: components, message rates, packet loss."""

    def signing_report(self) -> SigningReport | None:
        """Return the signing statistics of the link: signed frames, and refused frames with the reasons."""

def plan(component: Component, wanted: AnyParams, **options: Unpack[PlanOptions]) -> Plan:
    """Return what `apply` would write to a vehicle, and in which order. Only reads."""

def apply(component: Component, wanted: AnyParams, **options: Unpack[ApplyOptions]) -> ApplyResult:
    """Write the wanted values to a vehicle, and verify each of them by reading it back at the end."""

def restore(component: Component, state: AnyParams, **options: Unpack[ApplyOptions]) -> ApplyResult:
    """Restore an earlier state of a vehicle: `apply`, with its own identity and calibration included."""

def for_each(components: Iterable[Component], call: Callable[[Component], Outcome]) -> FleetResult[Outcome]:
    """Make a call for each vehicle, concurrently; a failure of one does not stop the others."""

def metadata_of(
    component: Component,
    *,
    store: MetadataStore | bool = True,
    timeout: float | None = None,
    progress: Callable[[int, int | None], None] | None = None,
) -> Metadata | None:
    """Return the parameter metadata of a component, or None if the component has none."""
