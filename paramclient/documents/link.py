"""A link that the service holds, and the service itself."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from paramclient.documents.document import Document, Maybe

if TYPE_CHECKING:
    from paramclient.client.stats import ClientStats

__all__ = ["HealthDoc", "HealthLinkDoc", "LinkDoc", "LinksDoc", "MeDoc", "StatsDoc"]


class StatsDoc(Document):
    """What has gone over a link since it was opened; the members are those of `ClientStats`.

    `round_trips` are in seconds, by `system/component`.
    """

    bytes_received: int
    bytes_sent: int
    frames_received: int
    frames_sent: int
    skipped: int
    damaged: int
    unusable_names: int
    lost: int | None
    repeated: int | None
    reads: int
    writes: int
    retries: int
    downloads: int
    cache_hits: int
    round_trips: dict[str, float]

    @classmethod
    def of(cls, stats: ClientStats) -> StatsDoc:
        """All of it."""
        members = {name: getattr(stats, name) for name in cls.model_fields if name != "round_trips"}
        trips = {f"{system}/{number}": trip for (system, number), trip in stats.round_trips.items()}
        return cls(**members, round_trips=trips)


class LinkDoc(Document):
    """One link: open; away, and being opened again by itself; failed, and tried again; or a log that is over.

    `error` is the reason for the last two, `name` what the service calls it, `stats` null while it is not
    open. `openings` counts how often it was opened anew: everything that was known of it began again then.
    """

    name: str
    state: str
    error: str | None
    listens_only: bool
    components: int
    openings: int
    stats: StatsDoc | None


class LinksDoc(Document):
    """All links."""

    links: list[LinkDoc]


class HealthLinkDoc(Document):
    """The state of a link."""

    name: str
    state: str


class HealthDoc(Document):
    """That the service answers, and since when, in seconds."""

    status: str
    version: str
    up_s: float
    links: Maybe[list[HealthLinkDoc]] = None


class MeDoc(Document):
    """Who asks, by the name of the token, and what that allows; where it is `read_only`, nobody may write.

    `asker` is how they stand in the history.
    """

    name: str
    asker: str
    role: Literal["read", "write"]
    read_only: bool
