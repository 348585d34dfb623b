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


@dataclass(eq=False)
class Target:
    """One component on a link.

    Attributes:
        link: its link.
        component: the component.
        metadata: the metadata of its parameters, or None.
        progress: the progress of a running fetch, or None.
        fetches: number of ended fetches: a page loads the table again when it has changed.
        running_setup: the author of a running apply or restore, or None.
        published: the last published state.
        described: the identity to which `metadata` belongs.
    """

    link: ServiceLink
    component: Component
    metadata: Metadata | None = None
    progress: Progress | None = None
    fetches: int = 0
    running_setup: str | None = None
    published: object = None
    described: Identity | None = None

    @property
    def address(self) -> dict[str, Any]:
        """The members that name it in an event."""
        return {
            "link": self.link.name,
            "system": self.component.system,
            "component": self.component.component,
        }

    def parameters(self, *, ext: bool) -> Component:
        """Return the component with its extended or its plain parameters."""
        return self.component.ext if ext else self.component

    def described_by(self, *, ext: bool) -> Metadata | None:
        """Return the metadata of the parameters, or None; extended parameters have none."""
        return None if ext else self.metadata

    def info(self, name: str, *, ext: bool) -> ParamInfo | None:
        """Return the metadata of a parameter, or None."""
        metadata = self.described_by(ext=ext)
        return None if metadata is None else metadata.find(name)


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
