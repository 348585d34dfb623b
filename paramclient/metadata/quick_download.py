"""Automatic download of a vehicle's metadata, where it is quick."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from paramclient.client.component import Component
from paramclient.client.local import local
from paramclient.errors import NoReply, UsageError, VehicleError
from paramclient.metadata.download import metadata_of
from paramclient.metadata.info import Metadata
from paramclient.metadata.metadata_cache import MetadataStore
from paramclient.protocol.quick_transfer import obstacle_to_quick_transfer

__all__ = ["QUICK_TIMEOUT", "QuickDownload", "load_if_quick", "obstacle_to_load"]

QUICK_TIMEOUT: Final = 2.0
"""Seconds after which the download is given up: 0.1 MB over UDP and USB take less than 1 s, and a user who
has not requested the download is delayed by no more."""


@dataclass(frozen=True, slots=True)
class QuickDownload:
    """The end of a download that the user has not requested.

    Attributes:
        metadata: the metadata, or None.
        note: why there is none, in half a sentence; "" with metadata.
    """

    metadata: Metadata | None
    note: str = ""


def obstacle_to_load(component: Component) -> str | None:
    """Return why metadata is not requested from a vehicle now; None for no reason."""
    vehicle = local(component)
    if vehicle.machine.context.is_ardupilot:
        return "ArduPilot does not serve its metadata"
    return obstacle_to_quick_transfer(vehicle.client.station, vehicle.machine)


async def load_if_quick(
    component: Component, *, store: MetadataStore | bool = True, timeout: float | None = None
) -> QuickDownload:
    """Return the parameter metadata of a component if it can be read within 2 s, else the reason.

    Nothing is requested from an armed vehicle, over a slow link, or by a client that only listens.
    Cancellation and the end of the time close open files on board.

    Args:
        component: from `ParamClient.component`.
        store: as in `metadata_of`; the metadata is remembered there for the firmware.
        timeout: seconds, if less than 2 s remain for the complete operation; else None.

    Raises:
        LinkError: the link failed, or the client was closed.
    """
    obstacle = obstacle_to_load(component)
    if obstacle is not None:
        return QuickDownload(None, obstacle)
    seconds = QUICK_TIMEOUT if timeout is None else min(timeout, QUICK_TIMEOUT)
    try:
        found = await metadata_of(component, store=store, timeout=seconds)
    except NoReply:
        return QuickDownload(None, f"the transfer did not end within {seconds:g} s")
    except (UsageError, VehicleError) as error:
        return QuickDownload(None, str(error))
    return QuickDownload(found, "" if found is not None else "the vehicle serves no metadata")
