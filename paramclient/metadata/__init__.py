"""Parameter metadata of firmwares: units, ranges, names of values and bits, descriptions.

The metadata is optional. It comes from a file (`read_metadata`) or from the vehicle (`metadata_of`).

- `info`, `download`: the metadata of a firmware, downloads from a vehicle.
- `store`: cached files, and files that the user has added for a vehicle type and firmware version.
- `formats`, `ardupilot`, `px4`: detection of the format, and one module for each format.
"""

from __future__ import annotations

from paramclient.metadata.download import metadata_of
from paramclient.metadata.formats import read_content, read_metadata
from paramclient.metadata.info import Metadata, ParamInfo
from paramclient.metadata.store import AddedFiles, AddedMetadata, MetadataStore, VehicleKind

__all__ = [
    "AddedFiles",
    "AddedMetadata",
    "Metadata",
    "MetadataStore",
    "ParamInfo",
    "VehicleKind",
    "metadata_of",
    "read_content",
    "read_metadata",
]
