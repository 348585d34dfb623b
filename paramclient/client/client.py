"""ParamClient: what users open to reach the components on a link, or on the links of a service.

`ParamClient` is one concrete class that forwards its calls to an implementation: `LinkClient` where the
link is opened in this process, `ServiceClient` (in `paramclient.remote`) where a service has the links.
`__init__` chooses it by the name of the link. So `ParamClient(link)` and `isinstance(client, ParamClient)`
hold for both, a subclass of `ParamClient` works over both, and type checkers see one signature with its
docstring. The implementations offer the same calls with the same arguments. They are no subclasses, and do
not import this module. Their components are subclasses of the abstract class `Component`, which users do not
construct.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Self, TypeAlias

from paramclient.cache import ParamCache
from paramclient.client.arguments import HEARING_PATIENCE
from paramclient.client.component import Component
from paramclient.client.events import Events
from paramclient.client.fetch_all import FetchedAll
from paramclient.client.files import Ftp
from paramclient.client.link_client import LinkClient, LinkOptions
from paramclient.client.local import LocalClient, not_given
from paramclient.client.signing import Signing
from paramclient.client.stats import ClientStats
from paramclient.errors import UsageError
from paramclient.links import Link
from paramclient.links.names import names_service
from paramclient.model.values import Encoding
from paramclient.protocol.addresses import Address
from paramclient.protocol.params.fetch_result import Policy, Progress
from paramclient.protocol.stats.traffic import TrafficReport
from paramclient.protocol.wire import SigningKey, SigningReport

if TYPE_CHECKING:
    from paramclient.remote.service_client import ServiceClient
    from paramclient.sim import Endpoint

__all__ = ["ParamClient", "implementation_of", "local_client"]

Implementation: TypeAlias = "LinkClient | ServiceClient"
"""What a `ParamClient` forwards its calls to."""


class ParamClient:
    """The ground station's side of the parameter protocol on one link, as an async context manager.

    Inside the `async with`, it sends its heartbeat once a second, follows every component that it hears, and
    keeps their tables in the cache. At its end every call that still waits, in other tasks, raises
    ClientClosed, what is new is written, and neither task nor socket nor thread remains. What the body
    raises comes out as it is. File sessions are closed on board first, also when the body is cancelled: a
    vehicle that does not acknowledge that takes at most `SESSION_PATIENCE` (2 s).

    A TCP connection that drops, a serial port that is unplugged or a UDP socket that fails is opened again
    with back-off for as long as the client lives. Calls that wait meanwhile go on when it is back: what had
    not been answered is asked for again. After `LINK_PATIENCE` seconds without a link they raise LinkError,
    and new ones do so at once. A link that cannot come back (`tcpin`, when nobody can be let in) ends every
    call with its LinkError.

    Args:
        link: a link's name, such as `udpin:0.0.0.0:14550` (`paramclient.links.FORMS` says which there are), a
            link object, or a simulated vehicle. With `http://HOST:8765` a service of `paramclient serve` has
            the links (see `paramclient.remote`); of the other arguments only `token` goes with that.
        cache: where tables are kept: None for the user's cache, a path, a `ParamCache` (which stays open), or
            False for none. A log that is replayed neither reads nor writes one.
        system, component: who we are on the link.
        encoding: how all components lay out values, for those who know better than the evidence.
        watch_interval: seconds after which it is looked again whether a table that was fetched still is the
            vehicle's, while the link is idle. An update is sent once, and lost with its frame: so it is found
            within one interval. None: every 30 seconds where the vehicle has a hash, which costs two small
            messages and what the hash leaves out, or gives its table as a file, less often where that takes
            more than 1.5 s, and never elsewhere. A number goes for every vehicle, the whole table of those
            without a hash. 0 for never. See `Component.sync_state`.
        policy: what may be asked of vehicles to bring tables up to date, see `Policy`: "auto", "hash-only"
            or "cache-only". Anything but "auto" also ends the watch. Single reads and writes go out all the
            same.
        traffic: whether to count everything that is heard, for `traffic_report`. That takes time for each
            frame, also of those that a client otherwise steps over.
        listen_only: never send a byte, not even a heartbeat. Tables fill by what others on the link ask for;
            `fetch_all` waits for their list, and `get`, `set` and the like raise UsageError.
        forward: the link to one other program, by its name or as an object, such as
            `udpout:127.0.0.1:14551`: it gets every frame that comes, and what it sends goes to the vehicles;
            with `listen_only` it is not. A program that is slow or absent holds nothing up.
        tlog: a telemetry log to be made, of every frame on the link, both ways. One that exists is not
            written over; a full disk ends it with a warning, and nothing else.
        signing: the key with which what is sent is signed and what comes is checked, or a `Signing`, which
            says more. None: nothing is signed, and signatures count for nothing.
        token: what a service wants to see; None for PARAMCLIENT_TOKEN of the environment.
        split_peers: whether components with equal ids are different ones where they come from different UDP
            addresses or TCP connections: for vehicles that share a system id. A vehicle with two ways to this
            computer is then two, and so is one that was restarted with another port.

    Attributes:
        cache: where tables are kept, or None.

    Raises:
        UsageError: no such link, ids outside 1 to 255, or an interval or policy that cannot be; on entering:
            for the second time, or the telemetry log exists or cannot be made.
        LinkError: on entering: the link, or the one to the other program, cannot be opened.
    """

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
        token: str | None = None,
        split_peers: bool = False,
    ) -> None:
        options = LinkOptions(
            cache=cache,
            system=system,
            component=component,
            encoding=encoding,
            watch_interval=watch_interval,
            policy=policy,
            traffic=traffic,
            listen_only=listen_only,
            forward=forward,
            tlog=tlog,
            signing=signing,
            split_peers=split_peers,
        )
        self._implementation: Implementation
        if names_service(link):
            from paramclient.remote.service_client import ServiceClient  # only here: it loads httpx

            options.check_unset()
            self._implementation = ServiceClient(str(link), token=token)
        elif token is not None:
            raise UsageError("a token is for a service, whose name is http://HOST:PORT; a link takes none")
        else:
            self._implementation = LinkClient(link, options)
        self.cache = self._implementation.cache

    def __repr__(self) -> str:
        return repr(self._implementation)

    async def __aenter__(self) -> Self:
        await self._implementation.open()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._implementation.close(failed=kind is not None)

    @property
    def components(self) -> Mapping[Address, Component]:
        """Every component heard so far, by (system, component).

        With `split_peers`, ids may be there several times, and a key stands for the ids at one peer: it is
        what `Component.address` gives, and the ids alone are none.
        """
        return self._implementation.components

    @property
    def autopilots(self) -> list[Component]:
        """The autopilot of each system heard so far, by system id: vehicles, without what they carry."""
        return self._implementation.autopilots

    @property
    def link(self) -> Link:
        """The link."""
        return self._implementation.link

    @property
    def listens_only(self) -> bool:
        """Whether nothing is ever sent: by choice, or as the link is a log."""
        return self._implementation.listens_only

    @property
    def bytes_received(self) -> int:
        """Bytes that have come over the link."""
        return self._implementation.bytes_received

    @property
    def bytes_sent(self) -> int:
        """Bytes of the frames that were sent, our heartbeats among them."""
        return self._implementation.bytes_sent

    @property
    def stats(self) -> ClientStats:
        """What it has done so far, in numbers; also when it is closed."""
        return self._implementation.stats

    def events(self) -> Events:
        """What happens to components from now on: `async for event in client.events()`.

        They are Heard, Lost, Found, Rebooted, Resynced, Contested and Uncontested. An absence of the link
        does not end it; it ends when nobody holds it any more. Whoever is very slow to ask misses the oldest
        ones. In a log it ends with that.

        Raises:
            LinkError: while waiting, when the link failed for good or the client was closed. What had come
                before is given first.
        """
        return self._implementation.events()

    def ftp(self, component: Component) -> Ftp:
        """The files of a component, over MAVFTP."""
        return self._implementation.ftp(component)

    async def component(
        self,
        system: int | None = None,
        component: int | None = None,
        *,
        peer: str | None = None,
        timeout: float | None = HEARING_PATIENCE,
    ) -> Component:
        """The component with this address, as soon as it has been heard.

        Without arguments the first autopilot; with a system alone, that system's autopilot; with a component
        alone, the first of that id. Which one is the first is a matter of chance where there are several:
        programs that write use `only_component`. If the cache may have its table, it is in `params` on
        return, unless the vehicle does not say who it is.

        Args:
            system: system id.
            component: component id.
            peer: the peer that its messages come from, as `Component.peer` says it, or its host alone.
            timeout: seconds; None waits for ever.

        Raises:
            NoReply: it was not heard in time.
            LinkError: the link failed, or the client was closed.
        """
        return await self._implementation.component(system, component, peer=peer, timeout=timeout)

    async def only_component(
        self,
        system: int | None = None,
        component: int | None = None,
        *,
        peer: str | None = None,
        timeout: float | None = HEARING_PATIENCE,
    ) -> Component:
        """Return the component with this address if no other vehicle can be meant; for programs that write.

        Without arguments it is the only autopilot on the link; with a component alone, the component of that
        id of the only vehicle. For `LOOK_TIME` (1.2 s) from the first autopilot heard on, a second one is
        looked for: every autopilot sends a heartbeat once a second. With a system alone it is that system's
        autopilot: component 1 as soon as it is heard, or another one when it is the only one for as long.
        With both ids it is that component, as soon as it is heard. A vehicle that is lost is not there.
        Nothing is sent but what identifies vehicles.

        The call takes no time where a second autopilot would have been heard already. So a program that did
        something else since can make sure by another call, directly before it writes.

        Args:
            system: system id.
            component: component id.
            peer: as in `component`.
            timeout: seconds for everything; None waits for ever.

        Raises:
            AmbiguousVehicle: several vehicles are on the link, or the only one has several autopilots.
                `vehicles` and the text list them.
            NoReply: it was not heard in time, or not for long enough to see that it is the only one.
            LinkError: the link failed, or the client was closed.
        """
        return await self._implementation.only_component(system, component, peer=peer, timeout=timeout)

    async def successor(
        self, component: Component, system: int, *, timeout: float | None = HEARING_PATIENCE
    ) -> Component:
        """The same component of the same vehicle under another system id, as soon as it speaks under that.

        For a vehicle whose system id was set: ArduPlane and Rover take it at once (SYSID_THISMAV), ArduCopter
        and PX4 (MAV_SYS_ID) when they start again (see `Component.reboot`). That it is the same one is shown
        by its hardware id; where there is none, by its autopilot and type, and by its silence under the id of
        before.

        Args:
            component: what it was before.
            system: its new system id.
            timeout: seconds; None waits for ever.

        Raises:
            AnotherVehicle: another vehicle has this system id.
            NoReply: it was not heard under this id in time, or did not say who it is.
            LinkError: the link failed, or the client was closed.
        """
        return await self._implementation.successor(component, system, timeout=timeout)

    async def fetch_all(
        self,
        system: int | None = None,
        *,
        refresh: bool = False,
        timeout: float | None = None,
        progress: Callable[[Mapping[Address, Progress]], None] | None = None,
    ) -> FetchedAll:
        """Bring the tables of all components of one system, or of every system heard, up to date.

        They are fetched side by side; those that begin to speak meanwhile join in, and so does everyone who
        is heard within `LISTENING_TIME` of opening. A component that stays silent is given up soon after
        another one is done.

        Args:
            system: this system's components only, asked for with one list request to all of them.
            refresh: as in `Component.fetch_all`.
            timeout: seconds, after which what has come is given.
            progress: called about ten times a second with the progress of each, from this task.

        Raises:
            UsageError: `refresh`, and the policy allows no download.
            CacheError: nothing is cached of anybody, and the policy allows no download.
            NoReply: nobody was heard, or nobody answered.
            LinkError: the link failed, or the client was closed.
        """
        return await self._implementation.fetch_all(
            system, refresh=refresh, timeout=timeout, progress=progress
        )

    def traffic_report(self) -> TrafficReport:
        """What has gone over the link so far: who was heard, how fast, and what was lost on the way.

        Raises:
            UsageError: the client was made without `traffic=True`.
            LinkError: the link failed, or the client was closed.
        """
        return self._implementation.traffic_report()

    def signing_report(self) -> SigningReport | None:
        """How the signatures on the link stand: what came signed, what was refused and why.

        None where the client has no key.
        """
        return self._implementation.signing_report()


def implementation_of(client: ParamClient) -> Implementation:
    """Return what a client forwards its calls to. For the modules of this package, as is `local_client`."""
    return client._implementation


def local_client(client: ParamClient) -> LocalClient:
    """Return what the package needs of a client beyond its public calls.

    Raises:
        UsageError: its links are those of a service.
    """
    implementation = client._implementation
    if not isinstance(implementation, LinkClient):
        raise not_given("what this needs")
    return implementation
