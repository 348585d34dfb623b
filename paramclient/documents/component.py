"""Documents of a component in the service: its identity, its state, and the progress of a fetch."""

from __future__ import annotations

from typing import TYPE_CHECKING

from paramclient.documents.document import Document
from paramclient.model.notation import hash_text, rounded

if TYPE_CHECKING:
    from paramclient.client.component import Component
    from paramclient.model.identity import Identity
    from paramclient.protocol.fetch import FetchResult, Progress
    from paramclient.protocol.vehicle.address_contest import Contest

__all__ = [
    "ComponentDoc",
    "ComponentsDoc",
    "ContestDoc",
    "ExtendedStateDoc",
    "IdentityDoc",
    "LastFetchDoc",
    "ProgressDoc",
]


class IdentityDoc(Document):
    """The identity of a vehicle; the members are those of `Identity`."""

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
        """Return the document of an `Identity`."""
        return cls(**{name: getattr(identity, name) for name in cls.model_fields})


class ProgressDoc(Document):
    """The progress of a fetch: parameters received, their total, rate per second, and seconds left."""

    received: int
    total: int | None
    rate: float
    seconds_left: float | None

    @classmethod
    def of(cls, progress: Progress) -> ProgressDoc:
        """Return the document of a `Progress`."""
        return cls(
            received=progress.received,
            total=progress.total,
            rate=round(progress.rate, 1),
            seconds_left=rounded(progress.seconds_left),
        )


class LastFetchDoc(Document):
    """The source and duration of the last fetch of a component."""

    source: str
    elapsed_s: float


class ContestDoc(Document):
    """Several vehicles use the address of a component: the vehicles, and the difference between them."""

    claimants: list[str]
    difference: str

    @classmethod
    def of(cls, contest: Contest) -> ContestDoc:
        """Return the document of a `Contest`."""
        return cls(claimants=list(contest.claimants), difference=contest.difference)


class ExtendedStateDoc(Document):
    """The state of the extended parameters of a component; see `Component`. `params` is their number."""

    is_spoken: bool
    is_expected: bool
    is_complete: bool
    count: int | None
    params: int

    @classmethod
    def of(cls, ext: Component) -> ExtendedStateDoc:
        """Return the document of the present state."""
        return cls(
            is_spoken=ext.is_spoken,
            is_expected=ext.is_expected,
            is_complete=ext.is_complete,
            count=ext.count,
            params=len(ext.params),
        )


class ComponentDoc(Document):
    """One component on one link.

    `key` is the cache key of its table, null until the vehicle is identified. `peer` is the source address of
    its messages. `params` is the number of known parameters, `count` the number that the component announces,
    `fetch` the progress of a running fetch. `contest` names the vehicles if several use the address.
    `extended` is the state of the extended parameters.
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
    extended: ExtendedStateDoc

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
        """Return the document of the present state of a component.

        Args:
            component: the component.
            link: the name of its link.
            link_state: the state of the link in a word.
            key: the cache key of its table, or None while the vehicle is not identified.
            progress: the progress of a running fetch, or None.
            last: the result of the last fetch, or None.
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
            extended=ExtendedStateDoc.of(component.ext),
        )


class ComponentsDoc(Document):
    """All components, with the run of the service and the number of the last event that they include."""

    run: str
    seq: int
    components: list[ComponentDoc]
