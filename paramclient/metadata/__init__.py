"""Parameter metadata of firmwares: units, ranges, names of values and bits, descriptions.

The metadata is optional. It comes from a file (`read_metadata`) or from the vehicle (`metadata_of`).

- `info`, `schemas`: the metadata of a firmware, and its file formats.
- `store`: reading of files, cached files, and files that the user has added for a vehicle type and firmware
  version.
- `download`: downloads from a vehicle.
"""

from paramclient.metadata.download import metadata_of
from paramclient.metadata.info import Metadata, ParamInfo
from paramclient.metadata.store import AddedFiles, AddedMetadata, MetadataStore, VehicleKind, read_metadata

__all__ = [
    "AddedFiles",
    "AddedMetadata",
    "Metadata",
    "MetadataStore",
    "ParamInfo",
    "VehicleKind",
    "metadata_of",
    "read_metadata",
]
