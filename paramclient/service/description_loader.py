"""DescriptionLoader: parameter descriptions of vehicles, loaded without a request where the link is quick."""

from __future__ import annotations

import logging
from collections.abc import Callable, Coroutine
from typing import Final, TypeAlias

from paramclient.client.local import LocalComponent
from paramclient.errors import LinkError, ParamClientError
from paramclient.metadata import MetadataStore
from paramclient.metadata.quick_download import load_if_quick, obstacle_to_load
from paramclient.model.identity import Identity
from paramclient.service.followed_component import FollowedComponent

__all__ = ["DescriptionLoader"]

ATTEMPTS_REMEMBERED_MAX: Final = 1_000
"""Attempts that are remembered, so that none is repeated: one for each vehicle and firmware. The oldest is
forgotten beyond that."""

logger = logging.getLogger(__name__)

Attempt: TypeAlias = tuple[str, tuple[int, int], Identity]


class DescriptionLoader:
    """Loads the descriptions of vehicles whose table is complete, one vehicle of a link at a time.

    An attempt takes at most 2 s. It is made once for each vehicle and firmware, also if it fails. While the
    vehicle is armed, or the link is slow or busy, none is made; see `obstacle_to_load`. The reason is in the
    state of the component, and that of a failure in the log.

    Args:
        store: the metadata cache, or None.
    """

    def __init__(self, store: MetadataStore | None) -> None:
        self._store = store
        self._attempts: dict[Attempt, None] = {}
        self._loading: set[str] = set()

    def check(self, followed: FollowedComponent) -> bool:
        """Return whether the descriptions of a component are to be loaded now, and note what prevents it.

        Takes some microseconds.
        """
        component = followed.component
        if (
            followed.metadata is not None
            or component.state != "synced"
            or followed.link.name in self._loading
        ):
            return False
        machine, identity = component.machine, component.settled_identity
        if identity is None or not machine.identification.has_parameters or machine.is_link_busy:
            return False
        if _attempt(followed, identity) in self._attempts:
            return False
        followed.metadata_note = obstacle_to_load(component)
        return followed.metadata_note is None

    def begin(self, followed: FollowedComponent) -> Callable[[], Coroutine[None, None, None]]:
        """Record an attempt, and return the call that makes it."""
        identity = followed.component.identity
        self._attempts[_attempt(followed, identity)] = None
        if len(self._attempts) > ATTEMPTS_REMEMBERED_MAX:
            del self._attempts[next(iter(self._attempts))]
        self._loading.add(followed.link.name)

        async def load() -> None:
            try:
                await self._load(followed, identity)
            finally:
                self._loading.discard(followed.link.name)

        return load

    async def _load(self, followed: FollowedComponent, identity: Identity) -> None:
        component = followed.component
        try:
            loaded = await load_if_quick(component, store=self._store or False)
        except LinkError:  # the request is repeated after the reconnection
            self._attempts.pop(_attempt(followed, identity), None)
            return
        except ParamClientError as error:
            self._note(followed, str(error))
            return
        if loaded.metadata is None:
            self._note(followed, loaded.note)
        elif followed.metadata is None:
            followed.describe(loaded.metadata, identity)
            logger.info("%s: %d descriptions loaded", _label(component), len(loaded.metadata))

    def _note(self, followed: FollowedComponent, note: str) -> None:
        logger.info("%s: descriptions not loaded: %s", _label(followed.component), note)
        if followed.metadata is None:
            followed.metadata_note = note


def _attempt(followed: FollowedComponent, identity: Identity) -> Attempt:
    return followed.link.name, followed.address, identity


def _label(component: LocalComponent) -> str:
    return f"{component.system}/{component.component} on {component.client.link.name}"
