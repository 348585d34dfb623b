"""The types of the blocking client. `make sync` writes this file."""

import builtins
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Self, TypeAlias

from paramclient.cache import ParamCache, SnapshotSummary
from paramclient.client.arguments import COMPONENT_TIMEOUT
from paramclient.client.fetch_all import FetchedAll
from paramclient.client.reset import ResetResult
from paramclient.client.signing import Signing
from paramclient.client.stats import ClientStats
from paramclient.links import Link
from paramclient.metadata.info import Metadata
from paramclient.metadata.metadata_cache import MetadataStore
from paramclient.model.ext_params import ExtParam, ExtSettable
from paramclient.model.ext_paramset import ExtParamSet
from paramclient.model.identity import Identity
from paramclient.model.params import ParamMap
from paramclient.model.paramset import ParamSet
from paramclient.model.renames import Renames
from paramclient.model.values import Encoding, Param, Settable, WireValue
from paramclient.protocol.addresses import Address
from paramclient.protocol.ext.change import ExtChange
from paramclient.protocol.ext.fetch import ExtFetchResult
from paramclient.protocol.ext.write_batch import ExtSetManyResult, ExtSetOutcome
from paramclient.protocol.ext.writes import ExtSetResult
from paramclient.protocol.ftp import FILE_SIZE_MAX, DirectoryEntry
from paramclient.protocol.params.change import Change
from paramclient.protocol.params.fetch_result import FetchResult, Policy, Progress
from paramclient.protocol.params.sync import ComponentState, SyncState
from paramclient.protocol.params.write_batch import SetManyResult, SetOutcome
from paramclient.protocol.params.writes import SetResult
from paramclient.protocol.stats.traffic import TrafficReport
from paramclient.protocol.vehicle.address_contest import Contest
from paramclient.protocol.wire import SigningKey, SigningReport
from paramclient.provision.extended import ExtApplyResult, ExtPlan
from paramclient.provision.planning import ParamInfo, Plan
from paramclient.provision.results import ApplyProgress, ApplyResult, FleetApplied, FleetVerified
from paramclient.sim import Endpoint

__all__ = [
    "Changes",
    "Component",
    "Contested",
    "Discovered",
    "Event",
    "Events",
    "ExtChanges",
    "ExtParams",
    "Found",
    "Ftp",
    "Lost",
    "ParamClient",
    "Rebooted",
    "Resynced",
    "Uncontested",
    "Wanted",
    "apply",
    "apply_all",
    "apply_extended",
    "load_extended_state",
    "metadata_of",
    "prepare",
    "restore",
    "restore_all",
    "restore_extended",
    "verify",
    "verify_all",
    "verify_extended",
]

class Changes(Iterator[Change]):
    "Stream of the parameter changes of one component since its creation; see `Component.changes`."
    def __next__(self) -> Change: ...
    def next(self, timeout: float | None = None) -> Change: ...

class ExtChanges(Iterator[ExtChange]):
    "Stream of the changes of one component's extended parameters since its creation."
    def __next__(self) -> ExtChange: ...
    def next(self, timeout: float | None = None) -> ExtChange: ...

class ExtParams:
    "The extended parameters of a component (PARAM_EXT_*); see `Component.ext`."

    params: Mapping[str, ExtParam]
    @property
    def count(self) -> int | None:
        """The `param_count` of the component; None before its first PARAM_EXT_VALUE."""
    @property
    def is_spoken(self) -> bool:
        """Whether the component has sent an extended parameter."""
    @property
    def is_expected(self) -> bool:
        """Whether the component has sent an extended parameter, or is of a kind that usually has them."""
    @property
    def is_complete(self) -> bool:
        """Whether `params` has a parameter for every index below `count`."""
    def get(self, name: str | int, *, timeout: float | None = None) -> ExtParam:
        """Read one parameter with PARAM_EXT_REQUEST_READ."""
    def set(
        self,
        name: str,
        value: ExtSettable,
        *,
        timeout: float | None = None,
        durable: bool = False,
        author: str | None = None,
    ) -> ExtSetResult:
        """Write one parameter with PARAM_EXT_SET; return when the component has acknowledged the value."""
    def set_many(
        self,
        values: Mapping[str, ExtSettable] | Iterable[tuple[str, ExtSettable]],
        *,
        progress: Callable[[ExtSetOutcome], None] | None = None,
        timeout: float | None = None,
        durable: bool = False,
        author: str | None = None,
    ) -> ExtSetManyResult:
        """Write many parameters in one call, each as `set` does."""
    def fetch_all(
        self, *, timeout: float | None = None, progress: Callable[[Progress], None] | None = None
    ) -> ExtFetchResult:
        """Download all parameters with PARAM_EXT_REQUEST_LIST, and read the values that the list lacks."""
    def store_snapshot(self, *, reason: str) -> int | None:
        """Store a snapshot of the known parameters in the cache, as a restore point."""
    def snapshots(self) -> list[SnapshotSummary]:
        """Return the snapshots of the component's extended parameters, the newest last."""
    def load_state(self, when: float) -> ExtParamSet:
        """Return an earlier state of the parameters, from the cache."""
    def changes(self) -> ExtChanges:
        """Return a stream of changes from now on, like `Component.changes`."""

class Ftp:
    "Reads and writes files of one component over MAVFTP; see `ParamClient.ftp`."
    def read(
        self,
        path: str,
        *,
        timeout: float | None = None,
        progress: Callable[[int, int | None], None] | None = None,
        limit: int = FILE_SIZE_MAX,
    ) -> bytes:
        """Read a file and return its content."""
    def write(self, path: str, data: bytes, *, timeout: float | None = None) -> None:
        """Write a file, replacing an existing one."""
    def list(self, path: str = "/", *, timeout: float | None = None) -> builtins.tuple[DirectoryEntry, ...]:
        """Return the entries of a directory."""
    def checksum(self, path: str, *, timeout: float | None = None) -> int:
        """Return the CRC-32 of a file, computed on board: initial value 0, no final xor, as in PX4's hash."""

class Component:
    "One component of a vehicle; see `ParamClient.component`."

    system: int
    component: int
    params: ParamMap
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
    def ext(self) -> ExtParams:
        """The extended parameters of the component (PARAM_EXT_*), with their own calls."""
    @property
    def count(self) -> int | None:
        """The `param_count` of the component; None before its first PARAM_VALUE."""
    @property
    def hash(self) -> int | None:
        """The PX4 hash (`_HASH_CHECK`) of the complete table; None if it is not known."""
    @property
    def state(self) -> ComponentState:
        """State of the table: new, cached, fetching, synced, partial, contested or lost."""
    @property
    def sync_state(self) -> SyncState:
        """Whether the table matches the vehicle, and the running check or update."""
    @property
    def address(self) -> Address:
        """Its key in `ParamClient.components`: (system, component), with `split_peers` also the peer."""
    @property
    def peer(self) -> str:
        """Address and port from which its messages arrive, and to which requests go; empty if unknown."""
    @property
    def contest(self) -> Contest | None:
        """The vehicles that share its address, and their differences; None if there is only one vehicle."""
    @property
    def is_armed(self) -> bool | None:
        """Whether the vehicle is armed, from `base_mode` of its last heartbeat."""
    @property
    def silence(self) -> float:
        """Seconds since its last message. After 5 s the component is lost, see `Lost`."""
    @property
    def round_trip(self) -> float | None:
        """Smoothed round-trip time in seconds; None before the first response."""
    def get(self, name: str | int, *, timeout: float | None = None) -> Param:
        """Read one parameter from the vehicle with PARAM_REQUEST_READ."""
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
        """Write one parameter with PARAM_SET and verify the value that the vehicle acknowledges."""
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
    def reset(
        self,
        *names: str,
        defaults: Mapping[str, WireValue] | None = None,
        progress: Callable[[SetOutcome], None] | None = None,
        timeout: float | None = None,
        settle: float = 0.0,
        durable: bool = False,
        author: str | None = None,
    ) -> ResetResult:
        """Set parameters to the firmware's defaults, and verify each as `set` does."""
    def fetch_all(
        self,
        *,
        refresh: bool = False,
        timeout: float | None = None,
        progress: Callable[[Progress], None] | None = None,
    ) -> FetchResult:
        """Fetch all parameters. Uses the cache if the vehicle's hash matches, otherwise downloads."""
    def refreshed(self, *, timeout: float | None = None) -> None:
        """Wait until the values outside the hash have been read after `fetch_all`."""
    def setup_signing(self, key: SigningKey | None, *, link_is_safe: bool = False) -> None:
        """Send a new signing key to the vehicle with SETUP_SIGNING, or with None remove its key."""
    def reboot(self, *, system: int | None = None, timeout: float | None = None) -> Component:
        """Reboot the vehicle, and wait until the same vehicle is back."""
    def changes(self) -> Changes:
        """Return a stream of parameter changes from now on: `async for change in component.changes()`."""

Wanted: TypeAlias = ParamSet | Mapping[tuple[int, int], ParamSet] | Callable[[Component], ParamSet]

@dataclass(frozen=True, slots=True)
class Discovered:
    "The first message of a component has arrived."

    component: Component

@dataclass(frozen=True, slots=True)
class Lost:
    "A component is lost: it has sent heartbeats before, and no message for the heartbeat timeout: 5 s,"

    component: Component
    silence: float

@dataclass(frozen=True, slots=True)
class Found:
    "A lost component sends again. The client requests its identity and its hash."

    component: Component
    silence: float

@dataclass(frozen=True, slots=True)
class Rebooted:
    "A vehicle has rebooted: its clock has jumped back, or its heartbeat reports MAV_STATE_BOOT."

    component: Component

@dataclass(frozen=True, slots=True)
class Resynced:
    "A table that was stale, or possibly stale, matches the vehicle again."

    component: Component
    changed: tuple[str, ...]
    hash: int | None

@dataclass(frozen=True, slots=True)
class Contested:
    "Several vehicles use the address of a component."

    component: Component
    contest: Contest

@dataclass(frozen=True, slots=True)
class Uncontested:
    "Only one vehicle uses the address of a component again. The client requests its identity and its hash."

    component: Component

Event: TypeAlias = Discovered | Lost | Found | Rebooted | Resynced | Contested | Uncontested

class Events(Iterator[Event]):
    "Stream of the component events since its creation; see `ParamClient.events`."
    def __next__(self) -> Event: ...
    def next(self, timeout: float | None = None) -> Event: ...

class ParamClient:
    "A ground station for the MAVLink parameter protocol on one link, as an async context manager."

    cache: ParamCache | None
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
        forward: str | Link | None = None,
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
    def link(self) -> Link:
        """The link object of the client."""
    @property
    def listens_only(self) -> bool:
        """Whether the client sends nothing: because of `listen_only`, or because the link is a log."""
    @property
    def bytes_received(self) -> int:
        """Bytes received over the link."""
    @property
    def bytes_sent(self) -> int:
        """Bytes of all sent frames, including heartbeats."""
    @property
    def stats(self) -> ClientStats:
        """Counters of the client since its creation, also after it is closed."""
    def events(self) -> Events:
        """Return a stream of component events from now on: `async for event in client.events()`."""
    def ftp(self, component: Component) -> Ftp:
        """Return the MAVFTP file calls of a component."""
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
        self,
        system: int | None = None,
        *,
        refresh: bool = False,
        timeout: float | None = None,
        progress: Callable[[Mapping[Address, Progress]], None] | None = None,
    ) -> FetchedAll:
        """Update the tables of all components of one system, or of every system on the link."""
    def traffic_report(self) -> TrafficReport:
        """Return the traffic statistics of the link: components, message rates, packet loss."""
    def signing_report(self) -> SigningReport | None:
        """Return the signing statistics of the link: signed frames, and refused frames with the reasons."""

def prepare(
    component: Component,
    wanted: ParamSet,
    *,
    include: str | Iterable[str] = (),
    info: Mapping[str, ParamInfo] | None = None,
    force: bool = False,
    renames: Renames | None = None,
) -> Plan:
    """Return the plan of what `apply` would send to a vehicle, and in which order. Only reads."""

def apply(
    component: Component,
    wanted: ParamSet | Plan,
    *,
    include: str | Iterable[str] = (),
    info: Mapping[str, ParamInfo] | None = None,
    reboot: bool = False,
    allow_armed: bool = False,
    skip_invalid: bool = False,
    force: bool = False,
    renames: Renames | None = None,
    durable: bool = False,
    backup: str | os.PathLike[str] | None = None,
    timeout: float | None = None,
    author: str | None = None,
    progress: Callable[[ApplyProgress], None] | None = None,
    before_writing: Callable[[], object] | None = None,
) -> ApplyResult:
    """Write the wanted values to a vehicle, and verify each of them by reading it back at the end."""

def verify(
    component: Component,
    wanted: ParamSet,
    *,
    include: str | Iterable[str] = (),
    info: Mapping[str, ParamInfo] | None = None,
    force: bool = False,
    renames: Renames | None = None,
) -> Plan:
    """Compare a vehicle with the wanted parameters. Only reads."""

def restore(
    component: Component,
    state: ParamSet,
    *,
    include: str | Iterable[str] = (),
    info: Mapping[str, ParamInfo] | None = None,
    reboot: bool = False,
    allow_armed: bool = False,
    force: bool = False,
    backup: str | os.PathLike[str] | None = None,
    timeout: float | None = None,
    author: str | None = None,
    progress: Callable[[ApplyProgress], None] | None = None,
    before_writing: Callable[[], object] | None = None,
) -> ApplyResult:
    """Restore an earlier state of a vehicle: `apply`, with its own identity and calibration included."""

def apply_all(
    components: Iterable[Component],
    wanted: Wanted,
    *,
    include: str | Iterable[str] = (),
    info: Callable[[Component], Mapping[str, ParamInfo] | None] | None = None,
    reboot: bool = False,
    allow_armed: bool = False,
    skip_invalid: bool = False,
    force: bool = False,
    renames: Renames | None = None,
    durable: bool = False,
    backup: Callable[[Component], str | os.PathLike[str]] | None = None,
    timeout: float | None = None,
    author: str | None = None,
    progress: Callable[[Component, ApplyProgress], None] | None = None,
    before_writing: Callable[[Component], object] | None = None,
) -> FleetApplied:
    """`apply` to several vehicles concurrently. A failure of one vehicle does not stop the others."""

def verify_all(
    components: Iterable[Component],
    wanted: Wanted,
    *,
    include: str | Iterable[str] = (),
    info: Callable[[Component], Mapping[str, ParamInfo] | None] | None = None,
    force: bool = False,
    renames: Renames | None = None,
) -> FleetVerified:
    """`verify` several vehicles concurrently."""

def restore_all(
    components: Iterable[Component],
    states: Wanted,
    *,
    include: str | Iterable[str] = (),
    info: Callable[[Component], Mapping[str, ParamInfo] | None] | None = None,
    reboot: bool = False,
    allow_armed: bool = False,
    force: bool = False,
    backup: Callable[[Component], str | os.PathLike[str]] | None = None,
    timeout: float | None = None,
    author: str | None = None,
    progress: Callable[[Component, ApplyProgress], None] | None = None,
    before_writing: Callable[[Component], object] | None = None,
) -> FleetApplied:
    """`restore` several vehicles concurrently. A failure of one vehicle does not stop the others."""

def apply_extended(
    component: Component,
    wanted: ExtParamSet,
    *,
    durable: bool = False,
    backup: str | os.PathLike[str] | None = None,
    timeout: float | None = None,
    author: str | None = None,
    progress: Callable[[ExtSetOutcome], None] | None = None,
    before_writing: Callable[[], object] | None = None,
) -> ExtApplyResult:
    """Write the wanted values that differ to a component, and verify them by another download."""

def verify_extended(component: Component, wanted: ExtParamSet, *, timeout: float | None = None) -> ExtPlan:
    """Compare wanted extended parameters with those of a component, after a download. Writes nothing."""

def restore_extended(
    component: Component,
    state: ExtParamSet,
    *,
    durable: bool = False,
    backup: str | os.PathLike[str] | None = None,
    timeout: float | None = None,
    author: str | None = None,
    progress: Callable[[ExtSetOutcome], None] | None = None,
    before_writing: Callable[[], object] | None = None,
) -> ExtApplyResult:
    """Restore an earlier state of a component: `apply_extended` with a snapshot *before restore*."""

def load_extended_state(component: Component, when: float | None = None) -> ExtParamSet:
    """Return an earlier state of the extended parameters of a component, from the cache."""

def metadata_of(
    component: Component,
    *,
    store: MetadataStore | bool = True,
    timeout: float | None = None,
    progress: Callable[[int, int | None], None] | None = None,
) -> Metadata | None:
    """Return the parameter metadata of a component, or None if the component has none."""
