"""The blocking client, for scripts and notebooks: the calls of `paramclient.ParamClient` without `await`.

The classes have the names and the calls of the asynchronous ones, and return the same results. Exceptions and
all other classes are those of `paramclient`::

    with ParamClient("udpin:0.0.0.0:14550") as client:
        vehicle = client.component()
        print(vehicle.get("MC_ROLL_P"))

- `blocking`: the classes, generated from the asynchronous ones.
- `client_thread`: the thread in which the asynchronous client runs, and calls to it.
- `fetch_iterator`: a fetch as an iterator of its progress.
- `wrappers`: base classes of those in `blocking`: opening and closing, streams, mappings.
"""

from __future__ import annotations

from paramclient.sync.blocking import (
    Changes,
    Component,
    Contested,
    Event,
    Events,
    ExtChanges,
    ExtParams,
    Found,
    Ftp,
    Heard,
    Lost,
    ParamClient,
    Rebooted,
    Resynced,
    Uncontested,
)
from paramclient.sync.fetch_iterator import FetchIterator

__all__ = [
    "Changes",
    "Component",
    "Contested",
    "Event",
    "Events",
    "ExtChanges",
    "ExtParams",
    "FetchIterator",
    "Found",
    "Ftp",
    "Heard",
    "Lost",
    "ParamClient",
    "Rebooted",
    "Resynced",
    "Uncontested",
]
