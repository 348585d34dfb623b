"""The sentences of `FetchResult.notes`."""

from __future__ import annotations

__all__ = [
    "FILE_IN_USE",
    "FROM_MEMORY",
    "LEFT_OUT",
    "MOVED",
    "NOT_ASKED",
    "NOT_CONFIRMED",
    "NOT_REFRESHED",
    "NOT_RESUMED",
    "NOT_SAMPLED",
    "NO_FILE",
    "SAMPLED",
    "UNBRACKETED",
    "UNPROVEN",
    "UNSETTLED",
]

UNPROVEN = (
    "Which parameters this firmware leaves out of its hash could not be proven, "
    "so after a start from the cache every value is read afresh."
)
LEFT_OUT = "Left out, as no parameter file can hold the name: what came under {!r}{}."
MOVED = "The table moved during the download, so no hash stands for it; the next session downloads it again."
UNBRACKETED = (
    "No hash was heard before the download, and what this firmware leaves out of it could not be proven, "
    "so none stands for the table; the next session downloads it again."
)
NOT_ASKED = "The vehicle was not asked, as the policy is cache-only: the values are those last known."
NOT_CONFIRMED = (
    "The vehicle's hash did not confirm the cached table, and the policy hash-only allows no download: "
    "the values are those last known."
)
NO_FILE = "The parameters did not come as a file, so they were listed: {}."
FILE_IN_USE = (
    "The parameters were listed: the file could not be opened, as another station reads one, "
    "or has left one open."
)
SAMPLED = "A sample of the cached table agreed with the vehicle; nothing else was asked."
NOT_SAMPLED = "The sample did not confirm the cached table: {}."
NOT_REFRESHED = "What the hash leaves out was not read afresh, as the policy is hash-only."
UNSETTLED = "The number of parameters kept changing during the download."
NOT_RESUMED = (
    "What an earlier download had brought could not be confirmed by the vehicle's hash, "
    "so all was downloaded anew."
)
FROM_MEMORY = (
    "{} values are those of an earlier session: this vehicle has no hash to confirm them. "
    "A fetch with refresh=True reads them anew."
)
