"""The document of the vehicle that a subcommand writes to."""

from __future__ import annotations

from typing import TYPE_CHECKING

from paramclient.documents.document import Document
from paramclient.model.identity import autopilot_name, version_text
from paramclient.protocol.kinds import kind_in_words

if TYPE_CHECKING:
    from paramclient.client.component import Component
    from paramclient.model.identity import Identity

__all__ = ["ReceiverDoc"]


class ReceiverDoc(Document):
    """The vehicle that a subcommand writes to; `kind` is in words, and `firmware` null if it is not known."""

    system: int
    component: int
    autopilot: str
    kind: str
    firmware: str | None
    uid: str | None

    @classmethod
    def of(cls, component: Component) -> ReceiverDoc:
        """Return the document of a component."""
        return cls.at(component.system, component.component, component.identity)

    @classmethod
    def at(cls, system: int, component: int, identity: Identity) -> ReceiverDoc:
        """Return the document of a component by address and identity."""
        return cls(
            system=system,
            component=component,
            autopilot=autopilot_name(identity.autopilot),
            kind=kind_in_words(identity.autopilot, identity.vehicle_type),
            firmware=version_text(identity.firmware) if identity.firmware else None,
            uid=identity.uid,
        )
