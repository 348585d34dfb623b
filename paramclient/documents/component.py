"""A component as the service tells of it: who it is, how it stands, and how far a fetch of it is."""

from __future__ import annotations

from typing import TYPE_CHECKING

from paramclient.documents.document import Document
from paramclient.model.notation import hash_text, rounded

if TYPE_CHECKING:
    from paramclient.client.component import Component
    from paramclient.model.identity import Identity
    from paramclient.protocol.params.fetch_result import FetchResult, Progress
    from paramclient.protocol.vehicle.peers import Contest

__all__ = ["ComponentDoc", "ComponentsDoc", "ContestDoc", "IdentityDoc", "LastFetchDoc", "ProgressDoc"]


class IdentityDoc(Document):
    """Who a vehicle is; the members are those of `Identity`."""

    system: int
    link: str
    uid: str | None
    autopilot: int
    vehicle_type: int
    firmware: int
    git_hash: str
    board: int
    vendor_id: int
    product_id: int
    capabilities: int

    @classmethod
    def of(cls, identity: Identity) -> IdentityDoc:
        """All of it."""
        return cls(**{name: getattr(identity, name) for name in cls.model_fields})


class ProgressDoc(Document):
    """How far a fetch is: parameters that have come, of how many, a second, and the seconds left."""

    received: int
    total: int | None
    rate: float
    seconds_left: float | None

    @classmethod
    def of(cls, progress: Progress) -> ProgressDoc:
        """As `Progress` has it."""
        return cls(
            received=progress.received,
            total=progress.total,
            rate=round(progress.rate, 1),
            seconds_left=rounded(progress.seconds_left),
        )


class LastFetchDoc(Document):
    """How the last fetch of a component ended."""

    source: str
    elapsed_s: float


class ContestDoc(Document):
    """Several vehicles have the address of a component: what each says, and what tells them apart."""

    claimants: list[str]
    difference: str

    @classmethod
    def of(cls, contest: Contest) -> ContestDoc:
        """As `Contest` has it."""
        return cls(claimants=list(contest.claimants), difference=contest.difference)


class ComponentDoc(Document):
    """One component on one link.

    `key` is the name under which its table is kept, null until the vehicle has said who it is. `peer` is
    where its messages come from. `params` is how many are known, `count` how many it says it has, `fetch` how
    far one is that is under way. `contest` says which vehicles have the address where these are several.
    """

    link: str
    link_state: str
    system: int
    component: int
    peer: str
    autopilot: str
    vehicle_type: int
    key: str | None
    identity: IdentityDoc
    encoding: str
    encoding_reason: str
    count: int | None
    params: int
    hash: str | None
    state: str
    sync_state: str
    is_armed: bool | None
    is_lost: bool
    contest: ContestDoc | None
    silence_s: float
    round_trip_s: float | None
    fetch: ProgressDoc | None
    last_fetch: LastFetchDoc | None

    @classmethod
    def of(
        cls,
        component: Component,
        *,
        link: str,
        link_state: str,
        key: str | None,
        progress: Progress | None,
        last: FetchResult | None,
    ) -> ComponentDoc:
        """As it stands at this moment.

        Args:
            component: which one.
            link: the name of its link, and `link_state` its state in a word.
            key: under which its table is kept, or None while that is open.
            progress: of the fetch under way, or None.
            last: the result of the fetch that ended last, or None.
        """
        identity = component.identity
        sync = component.sync_state
        return cls(
            link=link,
            link_state=link_state,
            system=component.system,
            component=component.component,
            peer=component.peer,
            autopilot=component.autopilot,
            vehicle_type=identity.vehicle_type,
            key=key,
            identity=IdentityDoc.of(identity),
            encoding=component.encoding.value,
            encoding_reason=component.encoding_reason,
            count=component.count,
            params=len(component.params),
            hash=hash_text(component.hash),
            state=component.state,
            sync_state=sync.value,
            is_armed=component.is_armed,
            is_lost=sync == "lost",
            contest=None if component.contest is None else ContestDoc.of(component.contest),
            silence_s=round(component.silence, 3),
            round_trip_s=rounded(component.round_trip),
            fetch=None if progress is None else ProgressDoc.of(progress),
            last_fetch=None
            if last is None
            else LastFetchDoc(source=last.source, elapsed_s=round(last.elapsed, 4)),
        )


class ComponentsDoc(Document):
    """All components, and the place in the list of events up to which that holds."""

    run: str
    seq: int
    components: list[ComponentDoc]
