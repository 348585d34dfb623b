"""Parameter metadata of firmwares: units, ranges, names of values and bits, descriptions.

The metadata is optional. It comes from a file (`read_metadata`) or from the vehicle (`metadata_of`).

- `info`, `metadata_cache`, `download`: the metadata of a firmware, cached files, downloads.
- `quick_download`: automatic downloads, where the link is quick.
- `added_files`: files that the user has added for a vehicle type and firmware version.
- `formats`, `ardupilot`, `px4`: detection of the format, and one module for each format.
- `json_parser`: JSON that is parsed value by value.
"""

from __future__ import annotations

from paramclient.metadata.added_files import AddedFiles, AddedMetadata, VehicleKind
from paramclient.metadata.download import metadata_of
from paramclient.metadata.formats import read_content, read_metadata
from paramclient.metadata.info import Metadata, ParamInfo
from paramclient.metadata.metadata_cache import MetadataStore
from paramclient.metadata.quick_download import QuickDownload, load_if_quick

__all__ = [
    "AddedFiles",
    "AddedMetadata",
    "Metadata",
    "MetadataStore",
    "ParamInfo",
    "QuickDownload",
    "VehicleKind",
    "load_if_quick",
    "metadata_of",
    "read_content",
    "read_metadata",
]
