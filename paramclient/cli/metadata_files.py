"""The subcommands metadata add, list and remove: metadata files that are stored for a firmware."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from paramclient.cache import ParamCache
from paramclient.cli.exit_codes import ExitCode
from paramclient.cli.options import CacheOptions
from paramclient.cli.output import print_json, print_table, printable, say
from paramclient.metadata import AddedMetadata, MetadataStore, VehicleKind, read_metadata
from paramclient.metadata.added_files import AddedFiles
from paramclient.model.wording import counted

__all__ = ["metadata_add", "metadata_list", "metadata_remove"]

_DEFAULTS: Final = CacheOptions()


def metadata_add(
    file: Path,
    /,
    *,
    vehicle: VehicleKind | None = None,
    firmware: str | None = None,
    options: CacheOptions = _DEFAULTS,
) -> ExitCode:
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
    if options.json:
        print_json(_added_json(added, len(metadata)))
    else:
        say(printable(f"{counted(len(metadata), 'description')} from {file} for {added}"))
    return ExitCode.DONE


def metadata_list(*, options: CacheOptions = _DEFAULTS) -> ExitCode:
    """Print the metadata files that were added."""
    rows = [(each, len(read_metadata(each.path))) for each in _files(options)]
    if options.json:
        print_json({"metadata": [_added_json(*row) for row in rows]})
    elif rows:
        cells = ((each.kind, each.firmware or "any", count) for each, count in rows)
        print_table(["vehicle", "firmware", "descriptions"], cells, right="descriptions")
    else:
        say("no metadata was added")
    return ExitCode.DONE


def metadata_remove(
    vehicle: VehicleKind, /, *, firmware: str | None = None, options: CacheOptions = _DEFAULTS
) -> ExitCode:
    """Remove a metadata file that was added.

    Args:
        vehicle: The vehicle type.
        firmware: The firmware version for which the file was added. Default: the file for every version.
    """
    removed = _files(options).remove(vehicle, firmware)
    if options.json:
        print_json({"vehicle": removed.kind, "firmware": removed.firmware})
    else:
        say(f"the metadata for {removed} was removed")
    return ExitCode.DONE


def _added_json(added: AddedMetadata, count: int) -> dict[str, object]:
    """Return the JSON of an added file with this number of descriptions."""
    return {"vehicle": added.kind, "firmware": added.firmware, "descriptions": count}


def _files(options: CacheOptions) -> AddedFiles:
    """Return the added files beside the cache that the options name."""
    with ParamCache(options.cache) as cache:
        return MetadataStore.beside(cache.path).added
