"""Metadata in the command line: where it comes from, names of values, units, descriptions, defaults.

The subcommands metadata add, list and remove: metadata files that are stored for a firmware.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Final, TypeAlias

import anyio
import anyio.to_thread
from cyclopts import Parameter, Token

from paramclient.cache import ParamCache
from paramclient.cli.json_output import JsonObject, info_of
from paramclient.cli.options import CacheOptions, LinkOptions
from paramclient.cli.output import Status, print_result, say, show
from paramclient.cli.session import CommandSession, wait_for_firmware
from paramclient.errors import UsageError
from paramclient.metadata import Metadata, MetadataStore, VehicleKind, metadata_of, read_metadata
from paramclient.metadata.store import AddedFiles, AddedMetadata
from paramclient.model.names import counted
from paramclient.model.paramset import Default, DefaultSource, ParamSet, WrittenParam, default_of
from paramclient.model.values import Param

VEHICLE: Final = "vehicle"
"""The value of --metadata that downloads the metadata from the vehicle."""
METADATA_HINT: Final = (
    "`paramclient fetch LINK --metadata vehicle` requests metadata from a vehicle that serves it, as PX4 "
    "does, and stores it; --metadata FILE takes a file, and `paramclient metadata add FILE` remembers one. "
    "ArduPilot's files are at https://autotest.ardupilot.org/Parameters/"
)
"""What to do if metadata is not known."""


def _file(_: object, tokens: Sequence[Token]) -> Metadata:
    """Return the metadata of the file that --metadata names.

    Raises:
        UsageError: the file has no metadata.
    """
    return read_metadata(tokens[0].value)


def _choice(_: object, tokens: Sequence[Token]) -> Metadata | str:
    """Return `VEHICLE`, or the metadata as `_file` does."""
    return VEHICLE if tokens[0].value == VEHICLE else _file(_, tokens)


_NAME: Final = Parameter(name="--metadata", n_tokens=1, accepts_keys=False)
MetadataChoice: TypeAlias = Annotated[Metadata | str | None, _NAME, Parameter(converter=_choice)]
"""The metadata of a file, or `VEHICLE`."""
MetadataFile: TypeAlias = Annotated[Metadata | None, _NAME, Parameter(converter=_file)]
"""The metadata of a file, of a subcommand without a link to a vehicle."""


async def known_of_session(
    session: CommandSession, choice: Metadata | str | None, *, needed_for: str = ""
) -> Metadata | None:
    """Return the metadata of a file, else of the vehicle, or None.

    Downloads it from the vehicle if --metadata is `vehicle`, or with `needed_for`, as for values that are
    written. Otherwise uses the stored metadata of its firmware, without any request.

    Args:
        session: the session.
        choice: the value of --metadata.
        needed_for: why the subcommand cannot continue without metadata, for the error; "" if it can.

    Raises:
        UsageError: the vehicle provides no metadata although it is required.
        VehicleError, NoReply, LinkError: as `metadata_of`.
    """
    if isinstance(choice, Metadata):
        return choice
    if choice is None and not needed_for:
        return await _stored(session)
    what = f"the parameter metadata of {session.label}"
    with Status(f"waiting for {what}", f"downloading {what}, bytes:") as status:
        found = await metadata_of(session.component, timeout=session.deadline.left(), progress=status.count)
    if found is None and choice is None:
        found = await _stored(session, added_only=True)
    if found is None:
        problem = f"{needed_for}. " if needed_for else ""
        raise UsageError(f"{problem}{session.label} does not describe its parameters; {METADATA_HINT}")
    return found


async def _stored(session: CommandSession, *, added_only: bool = False) -> Metadata | None:
    """Return the stored or added metadata of the vehicle's firmware, without any request to it; or None.

    With `added_only`, metadata that a vehicle has provided is left out: the firmware may have been built from
    other sources since, and only the vehicle can confirm it.
    """
    if session.options.no_cache:
        return None
    cache = session.client.cache or ParamCache(session.options.cache)
    store, component = MetadataStore.beside(cache.path), session.component
    if not store.has_notes:
        return None
    await wait_for_firmware([component], session.deadline)
    find = store.added.find if added_only else store.known
    return await anyio.to_thread.run_sync(find, component.identity, component.component)


def known_of_sets(
    sets: Sequence[ParamSet], options: CacheOptions | LinkOptions, given: Metadata | None
) -> list[Metadata | None]:
    """Return the given metadata, else that of each set's firmware; see `MetadataStore.known_of_sets`."""
    if given is not None or options.no_cache:
        return [given] * len(sets)
    return MetadataStore.beside(ParamCache(options.cache).path).known_of_sets(sets)


# Defaults


def defaults_in(metadata: Metadata | None, names: Iterable[str]) -> Mapping[str, int | float]:
    """Return the defaults that metadata gives for parameters, by name; see `default_of`."""
    return {} if metadata is None else metadata.defaults_of(names)


def default_in(metadata: Metadata | None, param: Param | WrittenParam) -> Default | None:
    """Return the default of a parameter: that of the vehicle, else that of the metadata; see `default_of`."""
    info = info_of(metadata, param.name)
    return default_of(param, None if info is None else info.default)


def say_sources(label: str, defaults: Iterable[Default | None]) -> None:
    """Print how many defaults of a vehicle are from the metadata of the firmware, if any are."""
    sources = [default.source for default in defaults if default is not None]
    if described := sources.count(DefaultSource.METADATA):
        what = f"{described} of {counted(len(sources), 'default')} from the metadata of the firmware"
        say(f"{label}: {what}, which does not have the defaults of an airframe")


# Subcommands


def metadata_add(
    file: Path,
    /,
    *,
    vehicle: VehicleKind | None = None,
    firmware: str | None = None,
    options: CacheOptions = CacheOptions(),
) -> None:
    """Store a metadata file for a vehicle type and a firmware version, for all commands and the service.

    ArduPilot's vehicles do not provide their metadata; its files are at autotest.ardupilot.org/Parameters. A
    file that was added before for the same vehicle type and version is replaced.

    Args:
        file: The file: apm.pdef.xml or apm.pdef.json of ArduPilot, or parameters.json of PX4.
        vehicle: The vehicle type, if the file does not name it.
        firmware: Use the file only for this firmware version, such as 4.6 for 4.6.0, 4.6.1 and so on.
            Default: for every version for which no other file was added.
    """
    added, metadata = _files(options).add(file, vehicle, firmware)
    words = f"{counted(len(metadata), 'description')} from {file} for {added}"
    print_result(_added_json(added, metadata), words, json=options.json)


def metadata_list(*, options: CacheOptions = CacheOptions()) -> None:
    """Print the metadata files that were added."""
    found = [_added_json(each, read_metadata(each.path)) for each in _files(options)]
    rows = ((each["vehicle"], each["firmware"] or "any", each["descriptions"]) for each in found)
    columns = ("vehicle", "firmware", "descriptions")
    show({"metadata": found}, columns, rows, json=options.json, empty="no metadata was added")


def metadata_remove(
    vehicle: VehicleKind, /, *, firmware: str | None = None, options: CacheOptions = CacheOptions()
) -> None:
    """Remove a metadata file that was added.

    Args:
        vehicle: The vehicle type.
        firmware: The firmware version for which the file was added. Default: the file for every version.
    """
    removed = _files(options).remove(vehicle, firmware)
    found = {"vehicle": removed.kind, "firmware": removed.firmware}
    print_result(found, f"the metadata for {removed} was removed", json=options.json)


def _added_json(added: AddedMetadata, metadata: Metadata) -> JsonObject:
    return {"vehicle": added.kind, "firmware": added.firmware, "descriptions": len(metadata)}


def _files(options: CacheOptions) -> AddedFiles:
    """Return the added files beside the cache that the options name."""
    return MetadataStore.beside(ParamCache(options.cache).path).added
