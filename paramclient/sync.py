"""The blocking client, for scripts and notebooks: the calls of `paramclient.ParamClient` without `await`.

The classes have the names and the calls of the asynchronous ones, and return the same results. Exceptions and
all other classes are those of `paramclient`::

    with ParamClient("udpin:0.0.0.0:14550") as client:
        vehicle = client.component()
        print(vehicle.get("MC_ROLL_P"))

The functions have the arguments and the results of those in `paramclient.provision` and
`paramclient.metadata`; the call of `for_each` blocks.

`tests/sync_stub.py` writes the types into `sync.pyi` (`make sync`).
"""

from collections.abc import Callable, Iterable
from typing import Any

from paramclient import metadata, provision
from paramclient.client.blocking import Changes, Component, Events, ParamClient, blocking, call_each
from paramclient.client.client import Event
from paramclient.model.paramset import AnyParams

__all__ = [
    "Changes",
    "Component",
    "Event",
    "Events",
    "ParamClient",
    "AnyParams",
    "apply",
    "for_each",
    "metadata_of",
    "plan",
    "restore",
]

plan, apply, restore = map(blocking, (provision.plan, provision.apply, provision.restore))
metadata_of = blocking(metadata.metadata_of)


def for_each(components: Iterable[Any], call: Callable[[Any], Any]) -> provision.FleetResult[Any]:
    """Make a call for each vehicle, each in a thread; see `paramclient.provision.for_each`."""
    return provision.FleetResult(*call_each(components, call))
