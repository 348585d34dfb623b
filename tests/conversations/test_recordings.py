"""Recordings of real autopilots, received by a station that only listens."""

from __future__ import annotations

import pytest

from paramclient.model.values import Encoding
from paramclient.protocol.dialect import PLAIN
from paramclient.protocol.station import Station
from paramclient.wire import messages
from tests.recordings import NAMES
from tests.recordings import read as records_of


@pytest.mark.parametrize("name", NAMES)
async def test_a_listener_takes_every_value_and_sends_nothing(name: str) -> None:
    sent: list[bytes] = []
    options = {"is_stream": False, "spawn": lambda *work: None, "listens_only": True}
    station = Station(link="log", send=lambda data, peer: sent.append(data), **options)  # type: ignore[arg-type]
    last: dict[str, bytes] = {}
    for record in records_of(name):
        station.receive(record.data, "peer", record.time)
        if isinstance(record.message, messages.ParamValue) and record.message.param_id != messages.HASH_CHECK:
            last[record.message.param_id.upper()] = record.message.raw  # one read was of rtl_alt
    session = station.nodes[1, 1].plain
    assert not sent
    assert set(session.table.params) == set(last)
    encoding = session.table.encoding
    assert encoding is (Encoding.BYTEWISE if name.startswith("px4") else Encoding.C_CAST)
    for param_id, raw in last.items():
        held = session.table.params[param_id]
        assert held.bits == PLAIN.param(param_id, raw, held.type, None, encoding).bits
