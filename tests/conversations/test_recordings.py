"""Recordings of real autopilots as dialogues: requests get the recorded answers."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Awaitable, Hashable, Iterable

import pytest

from paramclient.errors import UnknownParameter
from paramclient.model.values import Encoding, Param, ParamType
from paramclient.protocol.dialect import PLAIN
from paramclient.protocol.fetch import fetch_all
from paramclient.protocol.reads import read
from paramclient.protocol.station import Station
from paramclient.protocol.writes import write
from paramclient.sim import SimParam, ardupilot_table, px4_table
from paramclient.wire import messages
from tests.conversations.virtual import Puppet, talking
from tests.recordings import NAMES, answers, from_vehicle, param_values, requests_in
from tests.recordings import read as records_of

PX4_HASH = 0xCF579589


def key(request: messages.Message) -> Hashable:
    """Return what equal requests have in common."""
    return type(request), *(getattr(request, name, None) for name in ("param_id", "param_index", "raw"))


class Recorded(Puppet):
    """A vehicle that answers as in a recording, a repeated request as the last time.

    A read that the recording does not have is answered with the first value of that name.
    """

    def __init__(self, name: str) -> None:
        said = from_vehicle(name)
        super().__init__(
            self._answers_to, heartbeat=next(each for _, each in said if isinstance(each, messages.Heartbeat))
        )
        self._values = {each.param_id: each for each in reversed(param_values(said))}
        dialogue: list[tuple[float, messages.Message, list[messages.Message]]]
        dialogue = [(time, request, []) for time, request in requests_in(name)]
        for time, message in said:
            for at, request, found in reversed(dialogue):
                is_listed = (
                    isinstance(request, messages.ParamRequestList) and message in self._values.values()
                )
                if at <= time and (is_listed or answers(message, request)):
                    found.append(message)
                    break
        self._answers: defaultdict[Hashable, list[list[messages.Message]]] = defaultdict(list)
        for _, request, found in dialogue:
            self._answers[key(request)].append(found)

    def _answers_to(self, request: messages.Message) -> Iterable[messages.Message]:
        if (recorded := self._answers.get(key(request))) is not None:
            return recorded.pop(0) if len(recorded) > 1 else recorded[0]
        value = isinstance(request, messages.ParamRequestRead) and self._values.get(request.param_id)
        return [value] if value else []


@pytest.mark.parametrize(
    ("name", "table", "digest"),
    [("px4_full_download", px4_table(), PX4_HASH), ("ardupilot_full_download", ardupilot_table(), None)],
)
async def test_a_list_and_its_hash_are_proven(name: str, table: list[SimParam], digest: int | None) -> None:
    async with talking(Recorded(name)) as (conversation, session):
        session.serves_file = False
        result = await fetch_all(session)
        assert (result.source, result.count, result.hash) == ("stream", len(table), digest)
        params = {
            param: (each.type, each.bits) for param, each in result.params.items() if each.index is not None
        }
        assert params == {row.name: (row.type, row.bits) for row in table}
        assert len(conversation.sent_of(messages.ParamRequestList)) == 1
        if digest:
            assert session.table.volatile == {row.name for row in table if row.volatile}


@pytest.mark.parametrize("name", ["px4_get_set", "px4_20_sets", "ardupilot_get_set", "ardupilot_30_sets"])
async def test_reads_and_sets_end_as_they_did(name: str) -> None:
    encoding = Encoding.BYTEWISE if name.startswith("px4") else Encoding.C_CAST
    said = from_vehicle(name)

    def param(message: messages.ParamValue | messages.ParamSet, kind: int) -> Param:
        return PLAIN.param(message.param_id.upper(), message.raw, kind, None, encoding)

    async with talking(Recorded(name)) as (_, session):
        call: Awaitable[object]
        for at, request in requests_in(name):
            found = param_values(each for each in said if each[0] >= at and answers(each[1], request))
            match request:
                case messages.ParamRequestRead(param_id=which, param_index=index):
                    call = reading = read(session, which or index)
                    if found:
                        assert (await reading).raw in {each.raw for each in found}  # the last one of several
                case messages.ParamSet(param_id=which) if found or which == "NO_SUCH_PARAM":
                    wanted = param(
                        request, ParamType.REAL32 if encoding is Encoding.C_CAST else request.param_type
                    )
                    call = writing = write(session, which, wanted.settable)
                    if found:
                        result, held = await writing, param(found[0], found[0].param_type)
                        assert (result.actual, session.table.params[which].bits) == (held.value, held.bits)
                        assert result.status == ("accepted" if held.value == wanted.value else "adjusted")
                case _:
                    continue
            if not found:
                with pytest.raises(UnknownParameter):
                    await call


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
