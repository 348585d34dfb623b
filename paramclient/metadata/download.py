"""What a vehicle says of its parameters by itself: MAVLink's component metadata protocol.

COMPONENT_METADATA names a general file, which names the file of descriptions; both lie on board and come over
MAVFTP, or are kept from before (MAVLink guide, "Component Metadata Protocol").
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final, ParamSpec, TypeVar

import anyio
import anyio.to_thread

from paramclient.client.component import Component
from paramclient.client.files import Ftp
from paramclient.client.local import LocalComponent, local
from paramclient.errors import MetadataError, UsageError
from paramclient.metadata.formats import LARGEST_PACKED, json_of, read_content, unpacked
from paramclient.metadata.info import Metadata
from paramclient.metadata.metadata_cache import MetadataStore, has_checksum
from paramclient.protocol.wire import ComponentMetadata

__all__ = ["announced_metadata", "metadata_of"]

P = ParamSpec("P")
Result = TypeVar("Result")

PARAMETER_TYPE: Final = 1
"""COMP_METADATA_TYPE_PARAMETER."""


async def metadata_of(
    component: Component,
    *,
    store: MetadataStore | bool = True,
    timeout: float | None = None,
    progress: Callable[[int, int | None], None] | None = None,
) -> Metadata | None:
    """What a component says of its parameters, or None where it says that it has nothing to say.

    It is asked in every case; a file that is kept from before is not read again where its checksum is still
    the announced one. Nothing is fetched from the internet. Cancelling it closes what is open on board.

    Args:
        component: as `ParamClient.component` gives it.
        store: where files are kept; True for beside the client's cache, if it has one; False for nowhere.
        timeout: seconds for everything; None leaves it to the number of tries, which follows the link.
        progress: as in `Ftp.read`, for each of the two files.

    Raises:
        MetadataError: the descriptions are only on the internet (`source` is the address), on a component
            that was not heard, do not have the announced checksum, or are damaged.
        FileTransferError: it does not give the file that it names.
        NoReply: it did not answer in time.
        LinkError: the link failed, or the client was closed.
    """
    vehicle = local(component)
    if isinstance(store, bool):
        cache = vehicle.client.cache
        kept = MetadataStore.beside(cache.path) if store and cache is not None else None
    else:
        kept = store
    deadline = None if timeout is None else anyio.current_time() + timeout
    files = _Files(vehicle, kept, deadline, progress)
    before = component.identity
    announced = await announced_metadata(component, files.left())
    if announced is None:
        return None
    general = await files.get(announced.uri, announced.file_crc or None)
    places = await _in_thread(_places_of_parameters, general, f"{announced.uri} of {files.who}")
    if not places:
        return None
    uri, crc = next((place for place in places if place[0].startswith(_SCHEME)), places[0])
    content = await files.get(uri, crc)
    read = await _in_thread(_read_parameters, content, f"{uri} of {files.who}")
    now = component.identity
    if kept is not None and crc is not None and before.uid in (None, now.uid):
        await _in_thread(kept.remember, now, component.component, crc)
    return read


@dataclass(frozen=True, slots=True)
class _Files:
    """The files of a component, from before or from on board.

    Attributes:
        component: whose.
        kept: those from before, or None.
        deadline: when everything is to be over, or None.
        progress: is told of each that comes.
    """

    component: LocalComponent
    kept: MetadataStore | None
    deadline: float | None
    progress: Callable[[int, int | None], None] | None

    @property
    def who(self) -> str:
        return f"{self.component.system}/{self.component.component}"

    def left(self) -> float | None:
        """Seconds that are left, or None for any number."""
        return None if self.deadline is None else max(self.deadline - anyio.current_time(), 0.0)

    async def get(self, uri: str, crc: int | None) -> bytes:
        """One file, as it lies on board.

        Args:
            uri: where it is.
            crc: its checksum, or None where that is not known; it is not kept then.
        """
        if self.kept is not None and crc is not None:
            content = await _in_thread(self.kept.get, crc)
            if content is not None:
                return content
        files, path = self._on_board(uri)
        try:
            content = await files.read(
                path, timeout=self.left(), progress=self.progress, limit=LARGEST_PACKED
            )
        except UsageError as error:
            raise MetadataError(
                f"{self.who} says that its descriptions are at {uri}: {error}", source=uri
            ) from error
        if crc is not None:
            if not await _in_thread(has_checksum, content, crc):
                raise MetadataError(
                    f"{uri} of {self.who} does not have the checksum {crc:08x} that was announced", source=uri
                )
            if self.kept is not None:
                await _in_thread(self.kept.put, content, crc)
        return content

    def _on_board(self, uri: str) -> tuple[Ftp, str]:
        """Who has a file, and under which path: `mftp://PATH`, or `mftp://[;comp=ID]PATH` for another one."""
        found = _ON_BOARD.fullmatch(uri)
        if found is None:
            raise MetadataError(
                f"{self.who} says that its descriptions are at {uri}, and nothing is fetched from there: "
                f"download the file, and read that",
                source=uri,
            )
        number, path = found.groups()
        other: Component | None = self.component
        if number is not None and int(number) != self.component.component:
            other = self.component.client.components.get((self.component.system, int(number)))
        if other is None:
            raise MetadataError(
                f"{self.who} says that its descriptions are at {uri}, and no component {number} was heard",
                source=uri,
            )
        return Ftp(other), path


async def announced_metadata(component: Component, timeout: float | None) -> ComponentMetadata | None:
    """Return where a component says that its general metadata file is; None where it names none.

    Args:
        component: as `ParamClient.component` gives it.
        timeout: seconds; None leaves it to the number of attempts.

    Raises:
        NoReply: it did not answer in time.
        LinkError: the link failed, or the client was closed.
    """
    asked = local(component)
    asked.client.check_open()
    what = f"COMPONENT_METADATA of {component.system}/{component.component}"
    machine, now = asked.machine, anyio.current_time()
    machine.check_present(what, now)
    ask = machine.descriptions.ask(now)
    try:
        return await asked.wait(ask, timeout, lambda: (what, ask.attempts))
    finally:
        machine.descriptions.release(ask)


def _places_of_parameters(general: bytes, source: str) -> list[tuple[str, int | None]]:
    """Where the general file says that the descriptions of parameters are, and their checksum."""
    from paramclient.metadata.px4 import read_general  # only here: it loads pydantic

    files = read_general(json_of(unpacked(general, source=source), source=source), source=source)
    return [
        (uri, crc)
        for file in files
        if file.type == PARAMETER_TYPE
        for uri, crc in ((file.uri, file.crc), (file.fallback_uri, file.fallback_crc))
        if uri
    ]


def _read_parameters(content: bytes, source: str) -> Metadata:
    return read_content(content, source=source)


async def _in_thread(work: Callable[P, Result], *args: P.args, **kwargs: P.kwargs) -> Result:
    """Do something that takes milliseconds, while the loop goes on."""
    return await anyio.to_thread.run_sync(partial(work, *args, **kwargs))


_SCHEME: Final = "mftp://"
_ON_BOARD: Final = re.compile(r"mftp://(?:\[;comp=([0-9]{1,3})\])?(.+)")
