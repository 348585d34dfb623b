"""The links of the service and the components on them, as the hub holds them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from paramclient.client.client import ParamClient
from paramclient.client.component import Component
from paramclient.metadata import Metadata, ParamInfo
from paramclient.model.identity import Identity
from paramclient.protocol.fetch import Progress

__all__ = ["ServiceLink", "Target"]


@dataclass
class Setup:
    """The running apply or restore of a component.

    Attributes:
        author: its author; None if none runs.
    """

    author: str | None = None


@dataclass(eq=False)
class Target:
    """The plain or the extended parameters of one component on a link.

    Attributes:
        link: its link.
        component: the component.
        setup: the running apply or restore of plain or extended parameters.
        extended: the target with the extended parameters; None if it is this one.
        metadata: the metadata of its parameters, or None: extended ones have none.
        progress: the progress of a running fetch, or None.
        fetches: number of ended fetches: a page loads the table again when it has changed.
        published: the last published state.
        described: the identity to which `metadata` belongs.
    """

    link: ServiceLink
    component: Component
    setup: Setup
    extended: Target | None = None
    metadata: Metadata | None = None
    progress: Progress | None = None
    fetches: int = 0
    published: object = None
    described: Identity | None = None

    @classmethod
    def of(cls, link: ServiceLink, component: Component) -> Target:
        """Return the target with the plain parameters of a component; it has that with the extended ones."""
        setup = Setup()
        return cls(link, component, setup, cls(link, component.ext, setup))

    @property
    def address(self) -> dict[str, Any]:
        """The members that name it in an event."""
        return {
            "link": self.link.name,
            "system": self.component.system,
            "component": self.component.component,
        }

    def info(self, name: str) -> ParamInfo | None:
        """Return the metadata of a parameter, or None."""
        return None if self.metadata is None else self.metadata.find(name)


@dataclass(eq=False)
class ServiceLink:
    """One link: `opening`, `open`, `failed` (opened again after a delay) or `ended` (of a log).

    Attributes:
        name: its name in the service.
        make: creates a client for it.
        state: its state.
        error: the reason of `failed`, or None.
        client: the open client, or None.
        targets: the components on it, by system and component id.
    """

    name: str
    make: Callable[[], ParamClient]
    state: str = "opening"
    error: str | None = None
    client: ParamClient | None = None
    targets: dict[tuple[int, int], Target] = field(default_factory=dict)
