"""Documents of the links of a service, of its health, and of the caller's role."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from paramclient.documents.document import Document, Maybe

if TYPE_CHECKING:
    from paramclient.client.stats import ClientStats

__all__ = ["HealthDoc", "HealthLinkDoc", "LinkDoc", "LinksDoc", "TokenHolderDoc", "StatsDoc"]


class StatsDoc(Document):
    """The traffic of a link since it was opened; the members are those of `ClientStats`.

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
        """Return the document of a `ClientStats`."""
        members = {name: getattr(stats, name) for name in cls.model_fields if name != "round_trips"}
        trips = {f"{system}/{number}": trip for (system, number), trip in stats.round_trips.items()}
        return cls(**members, round_trips=trips)


class LinkDoc(Document):
    """One link: open; reconnecting; failed and retried; or a log that has ended.

    `name` is its name in the service, `error` the reason for the last two states, `stats` null while it is
    not open. `openings` counts how often it was opened again; each time its components and counters start
    anew.
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
    """The health of the service; `up_s` is the time since its start in seconds."""

    status: str
    version: str
    up_s: float
    links: Maybe[list[HealthLinkDoc]] = None


class TokenHolderDoc(Document):
    """The caller: the name of the token and its role. If `read_only`, the service allows no writes.

    `author` is the author of the caller's changes in the history.
    """

    name: str
    author: str
    role: Literal["read", "write"]
    read_only: bool
