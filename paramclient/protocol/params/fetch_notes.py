"""The sentences of `FetchResult.notes`."""

from __future__ import annotations

__all__ = [
    "FILE_IN_USE",
    "CACHED_UNVERIFIED",
    "LEFT_OUT",
    "CHANGED_MEANWHILE",
    "NOT_REQUESTED",
    "NOT_CONFIRMED",
    "NOT_REFRESHED",
    "NOT_RESUMED",
    "NO_FILE",
    "NO_HASH_BEFORE_DOWNLOAD",
    "UNPROVEN",
    "UNSETTLED",
]

UNPROVEN = (
    "The parameters that this firmware excludes from its hash are not verified: "
    "a start from the cache reads every value again."
)
LEFT_OUT = "Skipped {!r}{}: no parameter file can contain this name."
CHANGED_MEANWHILE = (
    "The table changed during the download and has no hash: the next session downloads it again."
)
NO_HASH_BEFORE_DOWNLOAD = (
    "No hash was received before the download, and the parameters that this firmware excludes from it are "
    "not verified: the table has no hash, and the next session downloads it again."
)
NOT_REQUESTED = (
    "The policy is cache-only: the values are the last known ones, without requests to the vehicle."
)
NOT_CONFIRMED = (
    "The vehicle's hash does not match the cached table, and the policy hash-only allows no download: "
    "the values are the last known ones."
)
NO_FILE = "The parameters were downloaded as a list instead of a file: {}."
FILE_IN_USE = (
    "The parameters were downloaded as a list: the file could not be opened, because another station reads "
    "one or has left one open."
)
NOT_REFRESHED = "The values outside the hash were not read again, because the policy is hash-only."
UNSETTLED = "The number of parameters kept changing during the download."
NOT_RESUMED = (
    "The vehicle's hash does not match the values of an earlier download: "
    "the whole table was downloaded again."
)
CACHED_UNVERIFIED = (
    "{} values are from an earlier session: this vehicle has no hash to verify them. "
    "A fetch with refresh=True reads them again."
)
