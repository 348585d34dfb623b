"""The links of the service and the parameters on them, as the hub holds them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import anyio

from paramclient.client.client import ParamClient
from paramclient.client.component import Component
from paramclient.metadata import Metadata, ParamInfo
from paramclient.model.identity import Identity
from paramclient.protocol.fetch import Progress
from paramclient.protocol.identity import expects_extended

__all__ = ["ServiceLink", "Target"]


@dataclass(eq=False)
class Target:
    """The plain or the extended parameters of one component on a link.

    Attributes:
        link: its link.
        component: the component.
        setup: held by the running apply or restore of plain or extended parameters.
        metadata: the metadata of its parameters, or None: extended ones have none.
        described: the identity to which `metadata` belongs.
        progress: the progress of a running fetch, or None.
        fetches: number of ended fetches: a page loads the table again when it has changed.
        published: the last published state.
    """

    link: ServiceLink
    component: Component
    setup: anyio.Lock
    metadata: Metadata | None = None
    described: Identity | None = None
    progress: Progress | None = None
    fetches: int = 0
    published: object = None

    @property
    def address(self) -> dict[str, Any]:
        """The members that name it in an event."""
        return {
            "link": self.link.name,
            "system": self.component.system,
            "component": self.component.component,
            "extended": self.component.is_extended,
        }

    @property
    def is_listed(self) -> bool:
        """Whether it is in lists: extended parameters are if there are some, or usually."""
        component = self.component
        is_usual = expects_extended(component.identity.vehicle_type, component.component)
        return not component.is_extended or is_usual or bool(component.params)

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
        targets: the parameters on it, by system and component id, and whether they are extended.
    """

    name: str
    make: Callable[[], ParamClient]
    state: str = "opening"
    error: str | None = None
    client: ParamClient | None = None
    targets: dict[tuple[int, int, bool], Target] = field(default_factory=dict)
