"""The blocking client, for scripts and notebooks: the calls of `paramclient.ParamClient` without `await`.

The classes have the names and the calls of the asynchronous ones, and return the same results. Exceptions and
all other classes are those of `paramclient`::

    with ParamClient("udpin:0.0.0.0:14550") as client:
        vehicle = client.component()
        print(vehicle.get("MC_ROLL_P"))

The functions have the arguments and the results of those in `paramclient.provision` and
`paramclient.metadata`.

- `proxy`: the one class behind all of them.

`tests/sync_stub.py` writes the types into `__init__.pyi` (`make sync`).
"""

from __future__ import annotations

from paramclient import metadata, provision
from paramclient.client.events import Discovered, Event, Found, Lost, Rebooted, Resynced
from paramclient.provision.fleet import Wanted
from paramclient.sync.proxy import Changes, Component, Events, Ftp, ParamClient, blocking

__all__ = [
    "Changes",
    "Component",
    "Discovered",
    "Event",
    "Events",
    "Found",
    "Ftp",
    "Lost",
    "ParamClient",
    "Rebooted",
    "Resynced",
    "Wanted",
    "apply",
    "apply_all",
    "metadata_of",
    "prepare",
    "restore",
    "restore_all",
    "verify",
    "verify_all",
]

prepare = blocking(provision.prepare)
apply = blocking(provision.apply)
verify = blocking(provision.verify)
restore = blocking(provision.restore)
apply_all = blocking(provision.apply_all)
verify_all = blocking(provision.verify_all)
restore_all = blocking(provision.restore_all)
metadata_of = blocking(metadata.metadata_of)
