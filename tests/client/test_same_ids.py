"""Two vehicles with the same ids at two peers: one warning, no writes, and an end of it."""

from __future__ import annotations

import anyio
import pytest

from paramclient import AmbiguousVehicle
from paramclient.links import Peer
from paramclient.sim import Endpoint
from tests.client.conftest import fetched
from tests.shell import PeersLink, Tap, generic, small_px4


async def test_another_live_peer_is_one_warning_and_forbids_writes(caplog: pytest.LogCaptureFixture) -> None:
    first, second = small_px4(uid=1), Tap(small_px4(uid=2))
    peers: dict[Peer, Endpoint] = {"one": first, "two": second}
    second.is_mute = True
    async with fetched(PeersLink(peers)) as (_, component):
        second.is_mute = False
        await anyio.sleep(3.0)
        for write in (component.set("PARAM_01", 5), component.set_many({"PARAM_01": 5})):
            with pytest.raises(AmbiguousVehicle, match="nothing was written"):
                await write
        assert (first.params["PARAM_01"].value, len(second.messages(object))) == (1, len(second.received))
        assert (await component.get("PARAM_01")).value == 1
        second.is_mute = True
        await anyio.sleep(10.0)
        assert (await component.set("PARAM_01", 5)).actual == 5
    warnings = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert len(warnings) == 1
    assert "two vehicles have the same ids" in warnings[0]


async def test_the_new_connection_of_a_vehicle_has_its_ids_at_once() -> None:
    """As of a vehicle that connects to us again after its TCP connection broke."""
    first = Tap(generic())
    link = PeersLink({"one": first})
    async with fetched(link) as (client, component):
        first.is_mute = True
        client.core.station.receive(b"", "one", anyio.current_time())
        link.endpoints["two"] = generic()
        await anyio.sleep(1.1)
        assert (await component.set("PARAM_01", 5)).actual == 5
