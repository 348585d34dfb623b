"""The blocking client, for scripts and notebooks: the calls of `paramclient.ParamClient` without `await`.

The classes have the names and the calls of the asynchronous ones, and return the same results. Exceptions and
all other classes are those of `paramclient`::

    with ParamClient("udpin:0.0.0.0:14550") as client:
        vehicle = client.component()
        print(vehicle.get("MC_ROLL_P"))

The functions have the arguments and the results of those in `paramclient.provision` and
`paramclient.metadata`; the call of `for_each` blocks.

- `proxy`: the one class behind all of them.

`tests/sync_stub.py` writes the types into `__init__.pyi` (`make sync`).
"""

from __future__ import annotations

from paramclient import metadata, provision
from paramclient.client.client import Event
from paramclient.provision.inspection import Wanted
from paramclient.sync.proxy import Changes, Component, Events, ParamClient, blocking, for_each

__all__ = [
    "Changes",
    "Component",
    "Event",
    "Events",
    "ParamClient",
    "Wanted",
    "apply",
    "for_each",
    "metadata_of",
    "plan",
    "restore",
]

plan = blocking(provision.plan)
apply = blocking(provision.apply)
restore = blocking(provision.restore)
metadata_of = blocking(metadata.metadata_of)
