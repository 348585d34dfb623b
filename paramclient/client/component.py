"""Component: the parameters of one component of a vehicle, and the calls on it, wherever its link is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import SupportsFloat, SupportsIndex

from paramclient.client.subscription import Changes
from paramclient.model.identity import Identity
from paramclient.model.params import ParamMap
from paramclient.model.values import Encoding, Param
from paramclient.protocol.addresses import Address
from paramclient.protocol.params.fetch_result import FetchResult, Progress
from paramclient.protocol.params.sampling import SAMPLE_SIZE
from paramclient.protocol.params.sync import SyncState
from paramclient.protocol.params.writes import SetResult
from paramclient.protocol.vehicle.peers import Contest
from paramclient.protocol.wire import SigningKey

__all__ = ["Component"]


class Component(ABC):
    """One component of a vehicle, as `ParamClient.component` gives it.

    All of its calls may be cancelled at any point, and the next call works. All of them wait on while a link
    that comes back by itself is away, up to `LINK_PATIENCE` (in `client.link_task`); then, and when the
    client is closed, they raise LinkError. A component that is lost (see `Lost`) is not asked: calls that
    wait for an answer and new ones raise NoReply at once, but for a `fetch_all` under way, which goes on for
    a while, as the vehicle may only be starting again. A component whose address several vehicles have (see
    `Contested`) is not asked either: calls raise ContestedAddress. The table stays, and what is in it is
    *cached* until the vehicle is back and has confirmed it.

    Attributes:
        system, component: its address.
        params: all that is known of its parameters now, by name: live, verified or cached, see `Trust`. The
            mapping is read-only and follows what is heard.
    """

    system: int
    component: int
    params: ParamMap

    @property
    @abstractmethod
    def autopilot(self) -> str:
        """What its heartbeat says it runs: px4, ardupilot, generic, …; "unknown" before a heartbeat came."""

    @property
    @abstractmethod
    def identity(self) -> Identity:
        """Who the vehicle is: hardware id, firmware, capabilities, as far as known."""

    @property
    @abstractmethod
    def encoding(self) -> Encoding:
        """How it lays values into messages."""

    @property
    @abstractmethod
    def encoding_reason(self) -> str:
        """Why that is believed, in words."""

    @property
    @abstractmethod
    def count(self) -> int | None:
        """The number of parameters that it says it has, or None before it said so."""

    @property
    @abstractmethod
    def hash(self) -> int | None:
        """The PX4 hash under which the vehicle would confirm the table as it stands here, or None."""

    @property
    @abstractmethod
    def state(self) -> str:
        """The table's state in a word: new, cached, fetching, synced, partial, contested, lost."""

    @property
    @abstractmethod
    def sync_state(self) -> SyncState:
        """How the table stands to the vehicle's: up to date, or what is done about it."""

    @property
    @abstractmethod
    def address(self) -> Address:
        """System and component: its key in `ParamClient.components`; with `split_peers` of this peer."""

    @property
    @abstractmethod
    def peer(self) -> str:
        """The address and port that its messages come from and requests go to; empty while not known."""

    @property
    @abstractmethod
    def contest(self) -> Contest | None:
        """Why it is open which vehicle this is, where several have its address; else None.

        Meanwhile every call raises ContestedAddress, `params` stays as it was, and nothing goes to the cache.
        """

    @property
    @abstractmethod
    def is_armed(self) -> bool | None:
        """Whether its motors may turn, by its last heartbeat.

        None where that is not known: before a heartbeat, while it is lost, and in high-latency mode, in which
        it sends none.
        """

    @property
    @abstractmethod
    def silence(self) -> float:
        """Seconds since it was heard last. After five without a word it is lost, see `Lost`."""

    @property
    @abstractmethod
    def round_trip(self) -> float | None:
        """The measured round trip in seconds, smoothed, or None before anything was answered."""

    @abstractmethod
    async def get(self, name: str | int, *, timeout: float | None = None) -> Param:
        """Ask the vehicle for one parameter.

        Equal calls at the same time share one request. Different ones run side by side.

        Args:
            name: param_id, or an index from 0.
            timeout: seconds until giving up; None leaves it to the number of tries, which follows the
                measured round trip and loss.

        Raises:
            UsageError: no such name or index can exist, or the client only listens.
            UnknownParameter: the vehicle does not have it.
            Refused: it gave a reason not to tell.
            NoReply: it did not answer.
            LinkError: the link failed, or the client was closed.
        """

    @abstractmethod
    async def set(
        self,
        name: str,
        value: SupportsIndex | SupportsFloat | bytes,
        *,
        timeout: float | None = None,
        settle: float = 0.0,
        force: bool = False,
        durable: bool = False,
        asker: str | None = None,
    ) -> SetResult:
        """Write one parameter and prove by its value that the vehicle has taken it.

        The type is learnt first when it is not known. Writes to one name are done in the order of the calls,
        those to different names side by side.

        Args:
            name: param_id.
            value: a number; or the 4 bytes of the message for what cannot be said as a number.
            timeout: as in `get`.
            settle: seconds, up to 60, for which the value is watched after its acknowledgement; then it is
                read once more, and the result tells what has become of it. 1.2 is enough for PX4, whose
                modules clamp values within a second. Without it such a change only comes as one of
                `changes`.
            force: send NaN and infinity also to PX4, which cannot save them and may stop, and to ArduPilot,
                which ignores them.
            durable: return only when the value and its line of history are on the disk, past a loss of power.
                Without it they are written within 0.25 s, and a loss of power may cost them later too.
            asker: for whom it is done, in printable ASCII: the change, and its line of history, are then by
                "us for ASKER".

        Returns:
            Accepted, or adjusted: the vehicle made another value of it.

        Raises:
            UsageError: the name, the value or another argument cannot be right, the value is NaN or infinite
                and the autopilot cannot store that, or the client only listens. Nothing was written.
            UnknownParameter: the vehicle does not have it.
            Refused: it gave a reason.
            TypeMismatch: it holds the parameter in another type.
            ValueNotApplied: it keeps the value it had and gives no reason.
            NoReply: it did not answer. Whether it has taken the value is not known, as after cancellation.
            ContestedAddress: several vehicles have its address.
            NotDurable: the vehicle has taken the value, and it could not be written to the disk.
            CacheError: with `durable`, nothing can be written to the disk; nothing was sent.
            LinkError: the link failed, or the client was closed.
        """

    @abstractmethod
    async def fetch_all(
        self,
        *,
        refresh: bool = False,
        accept: str = "verified",
        sample: int = SAMPLE_SIZE,
        seed: int | None = None,
        timeout: float | None = None,
        progress: Callable[[Progress], None] | None = None,
    ) -> FetchResult:
        """Bring the whole table up to date.

        Where the cache has a table and the vehicle a hash, the hash is asked for first; when it confirms the
        table, nothing is downloaded. Then the values that the hash does not cover are read afresh in the
        background: they stay *cached* until they have come, and `refreshed` waits for them.

        Otherwise the table comes as one packed file over MAVFTP where the component serves that: quicker than
        the list, exact, and with the firmware's defaults. Else it comes by list. `source` and `notes` of the
        result say what was done, and why.

        Where the client only listens, nothing is asked for: it waits for a list that others ask for, and then
        ends when the table is whole, or 5 seconds after the last new value.

        It ends by itself in every case: indices that never answer are given up and named in `missing`.
        Calls at the same time share one fetch. Cancelling it leaves what has come in the table.

        Args:
            refresh: download even when the hash would confirm the cached table.
            accept: "sampled" where a vehicle without a hash may be believed to have the cached table when a
                sample of it agrees (name, value, index and count), of the same hardware id, firmware version
                and git hash. `sample` of the result then says how far that can be trusted, and nothing counts
                as verified. Else "verified".
            sample: how many parameters are read for that.
            seed: of their draw; None for another one each time.
            timeout: seconds, after which what has come is given with `missing`; None is 20 where the client
                only listens.
            progress: called about ten times a second, from this task.

        Raises:
            UsageError: there is no such `accept`, the sample is empty, or `refresh` is given where the policy
                of the client allows no download, or it only listens.
            CacheError: nothing is cached, and the policy allows no download.
            NoReply: nothing came at all, or it is lost.
            LinkError: the link failed, or the client was closed.
        """

    @abstractmethod
    async def refreshed(self, *, timeout: float | None = None) -> None:
        """Wait until the values that a hash does not cover have been read afresh after `fetch_all`.

        Returns at once where there are none. A value that cannot be read stays *cached*.

        Raises:
            NoReply: that took longer than `timeout`.
            LinkError: the link failed, or the client was closed.
        """

    @abstractmethod
    async def setup_signing(self, key: SigningKey | None, *, link_is_safe: bool = False) -> None:
        """Give a vehicle its signing key, or with None take it away, by SETUP_SIGNING.

        The key goes over the link in clear, so only where nobody listens: over a USB cable, a wire. Nothing
        answers it; whether the vehicle has obeyed shows in a session with the new key. This one goes on with
        its own, which must be the vehicle's until then, unless that trusts the link (ArduPilot trusts USB).

        Args:
            key: its new key.
            link_is_safe: that the user has said so.

        Raises:
            UsageError: nobody has said that the link is safe, or the component speaks MAVLink 1.
            LinkError: the link failed, or the client was closed.
        """

    @abstractmethod
    async def reboot(self, *, system: int | None = None, timeout: float | None = None) -> Component:
        """Let the vehicle start again, and wait until the same one is back.

        It is told to when what was written through this client has had the time to be saved (2.5 s after the
        last write). That it has started again is seen by its clock, its heartbeat, the sequence numbers of
        its frames or its silence, so an acknowledgement may be lost. Then its hardware id is asked for, or
        where it has none, its heartbeat must name the same autopilot and type. Its table is *cached*
        afterwards until it is confirmed, as after any start; parameters may be others now.

        Calls at the same time share one restart. When the call is cancelled, the vehicle may start again all
        the same.

        Args:
            system: the system id that it takes with the start, where another one was set (MAV_SYS_ID of PX4,
                SYSID_THISMAV of ArduCopter); then `ParamClient.successor` finds it there.
            timeout: seconds until giving up; None for `REBOOT_PATIENCE`.

        Returns:
            The component that it is now: this one, or the one with the other system id.

        Raises:
            CommandRefused: it does not want to, most likely because it is armed.
            AnotherVehicle: another vehicle answers under its system id.
            NoReply: it does not answer, or did not come back in time.
            LinkError: the link failed, or the client was closed.
        """

    @abstractmethod
    def changes(self) -> Changes:
        """What changes from now on: `async for change in component.changes()`.

        Each change names the parameter, what was known before and what is known now. A value that is heard
        for the first time is one too. Whoever is slow to ask gets several changes of one parameter as one,
        so what waits is never more than one change for each parameter. An absence of the link does not end
        it; it ends when nobody holds it any more. In a log it ends with that.

        Raises:
            LinkError: while waiting, when the link failed for good or the client was closed. What had come
                before is given first.
        """
