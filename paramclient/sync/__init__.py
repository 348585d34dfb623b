"""The blocking client, for scripts and notebooks: the calls of `paramclient.ParamClient` without `await`.

The classes have the names and the calls of the asynchronous ones, and return the same results. Exceptions and
all other classes are those of `paramclient`::

    with ParamClient("udpin:0.0.0.0:14550") as client:
        vehicle = client.component()
        print(vehicle.get("MC_ROLL_P"))

- `blocking`: the classes, generated from the asynchronous ones by `tests/sync_interface.py` (`make sync`).
- `client_thread`: the thread in which the asynchronous client runs, and calls to it.
- `functions`: the functions that take a client or a component, such as `apply`.
- `fetch_iterator`: a fetch as an iterator of its progress.
- `wrappers`: base classes of those in `blocking`: opening and closing, streams, mappings.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from paramclient.sync.blocking import (
    Changes,
    Component,
    Contested,
    Discovered,
    Event,
    Events,
    ExtChanges,
    ExtParams,
    Found,
    Ftp,
    Lost,
    ParamClient,
    Rebooted,
    Resynced,
    Uncontested,
)
from paramclient.sync.fetch_iterator import FetchIterator

if TYPE_CHECKING:
    from paramclient.sync.functions import (
        Wanted,
        apply,
        apply_all,
        apply_extended,
        check_vehicle,
        load_extended_state,
        metadata_of,
        prepare,
        restore,
        restore_all,
        restore_extended,
        verify,
        verify_all,
        verify_extended,
    )

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
    "Discovered",
    "Lost",
    "ParamClient",
    "Rebooted",
    "Resynced",
    "Uncontested",
    "Wanted",
    "apply",
    "apply_all",
    "apply_extended",
    "check_vehicle",
    "load_extended_state",
    "metadata_of",
    "prepare",
    "restore",
    "restore_all",
    "restore_extended",
    "verify",
    "verify_all",
    "verify_extended",
]


def __getattr__(name: str) -> Any:
    """Import `functions` at the first use of one of its names: it loads three more packages."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("paramclient.sync.functions"), name)
