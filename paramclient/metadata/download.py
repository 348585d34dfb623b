"""Download of parameter metadata from a vehicle: MAVLink's component metadata protocol.

COMPONENT_METADATA names a general file, which names the parameter metadata file. Both are on board and are
read over MAVFTP, or from the metadata cache (MAVLink guide, "Component Metadata Protocol").
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Final

from anyio.to_thread import run_sync

from paramclient.client.component import Component
from paramclient.errors import FileError, UsageError
from paramclient.metadata.info import Metadata
from paramclient.metadata.store import (
    PACKED_SIZE_MAX,
    MetadataStore,
    has_checksum,
    json_of,
    naming,
    read_content,
    unpacked,
)
from paramclient.protocol.commands import request_message
from paramclient.wire.messages import ComponentMetadata

PARAMETER_TYPE: Final = 1
"""COMP_METADATA_TYPE_PARAMETER."""


async def metadata_of(
    component: Component,
    *,
    store: MetadataStore | bool = True,
    timeout: float | None = None,
    progress: Callable[[int, int | None], None] | None = None,
) -> Metadata | None:
    """Return the parameter metadata of a component, or None if the component has none.

    Always requests COMPONENT_METADATA; a cached file is used if it has the announced checksum. Downloads
    nothing from the internet. Cancellation closes open files on board. A metadata cache that cannot be
    written costs one warning, together with the client's cache.

    Args:
        component: from `ParamClient.component`.
        store: the metadata cache; True for the one beside the client's cache, if it has one; False for none.
        timeout: seconds for the complete operation; None for the number of attempts, which depends on the
            link.
        progress: as in `Component.read_file`, for each of the two files.

    Raises:
        FileError: the metadata is only on the internet (`source` is the address), is on an unknown
            component, does not have the announced checksum, or is damaged.
        FileTransferError: the vehicle does not serve the file that it names.
        NoReply: no response in time.
        LinkError: the link failed, or the client was closed.
    """
    kept = None if isinstance(store, bool) else store
    if store is True and component.core.cache is not None:
        kept = MetadataStore.beside(component.core.cache.path)
    files = _Files(component, kept, progress)
    with component.limited(timeout, f"the metadata of {files.label}"):
        before = component.identity
        announced = await request_message(component.node.channel, ComponentMetadata)
        if announced is None or not announced.uri:
            return None
        general = await files.get(announced.uri, announced.file_crc or None)
        places = await run_sync(_places_of_parameters, general, f"{announced.uri} of {files.label}")
        if not places:
            return None
        uri, crc = next((place for place in places if place[0].startswith("mftp://")), places[0])
        content = await files.get(uri, crc)
        read = await run_sync(partial(read_content, content, source=f"{uri} of {files.label}"))
        now = component.identity
        if kept is not None and crc is not None and before.uid in (None, now.uid):
            keep = partial(kept.keep, files.received, now, component.component, crc)
            await component.core.cache_writer.attempt(keep)
        return read


@dataclass(frozen=True, slots=True)
class _Files:
    """The metadata files of a component, from the metadata cache or from on board.

    Attributes:
        component: the component.
        kept: the metadata cache, or None.
        progress: called for each file.
        received: by checksum, the files from on board.
    """

    component: Component
    kept: MetadataStore | None
    progress: Callable[[int, int | None], None] | None
    received: dict[int, bytes] = field(default_factory=dict)

    @property
    def label(self) -> str:
        return f"{self.component.system}/{self.component.component}"

    async def get(self, uri: str, crc: int | None) -> bytes:
        """Return one file, as stored on board.

        Args:
            uri: the file's address.
            crc: the file's checksum, or None if unknown; the file is not cached then.
        """
        if self.kept is not None and crc is not None:
            content = await run_sync(self.kept.get, crc)
            if content is not None:
                return content
        server, path = self._on_board(uri)
        try:
            content = await server.read_file(path, progress=self.progress, size_max=PACKED_SIZE_MAX)
        except UsageError as error:
            raise FileError(f"announced by {self.label}: {error}", source=uri) from error
        if crc is not None:
            if not await run_sync(has_checksum, content, crc):
                problem = f"the file of {self.label} does not have the announced checksum {crc:08x}"
                raise FileError(problem, source=uri)
            self.received[crc] = content
        return content

    def _on_board(self, uri: str) -> tuple[Component, str]:
        """Return component and path of `mftp://PATH`, or of `mftp://[;comp=ID]PATH` on another component."""
        found = _ON_BOARD.fullmatch(uri)
        if found is None:
            raise FileError(
                f"{self.label} has its metadata at this address, from which it is not downloaded: download"
                " the file, and pass it to read_metadata or --metadata",
                source=uri,
            )
        number, path = found.groups()
        other: Component | None = self.component
        if number is not None and int(number) != self.component.component:
            other = self.component.client.components.get((self.component.system, int(number)))
        if other is None:
            raise FileError(
                f"announced by {self.label}, but component {number} has not been heard", source=uri
            )
        return other, path


def _places_of_parameters(general: bytes, source: str) -> list[tuple[str, int | None]]:
    """Return the addresses and checksums of the parameter metadata in a general file."""
    from paramclient.metadata.schemas import read_general

    with naming(source):
        files = read_general(json_of(unpacked(general)))
    return [
        (uri, crc)
        for file in files
        if file.type == PARAMETER_TYPE
        for uri, crc in ((file.uri, file.crc), (file.fallback_uri, file.fallback_crc))
        if uri
    ]


_ON_BOARD: Final = re.compile(r"mftp://(?:\[;comp=([0-9]{1,3})\])?(.+)")
