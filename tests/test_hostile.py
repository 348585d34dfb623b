"""A vehicle that lies: what it may cost, and what it cannot do."""

from __future__ import annotations

import pytest

from paramclient.errors import NoReply
from paramclient.protocol import table as table_room
from paramclient.protocol.table import Table
from paramclient.protocol.wire import (
    MAV_AUTOPILOT_ARDUPILOTMEGA,
    MOST_PARAMETERS,
    NO_INDEX,
    Heartbeat,
    Message,
    ParamRequestRead,
    ParamValue,
    encode,
)
from tests.simulation import PEER, Simulation, known, param_value


def say(session: Simulation, message: Message, *, system: int = 1, component: int = 1) -> None:
    """Let a vehicle say something, without a vehicle."""
    data = encode(message, system=system, component=component, sequence=0)
    session.station.receive(data, PEER, session.now)


def beat(session: Simulation, *, system: int = 1, component: int = 1, autopilot: int = 0) -> None:
    say(session, Heartbeat(2, autopilot), system=system, component=component)


# Numbers that cannot be


@pytest.mark.parametrize("count", [MOST_PARAMETERS + 1, NO_INDEX - 1, NO_INDEX])
def test_a_count_above_what_can_be_asked_for_is_none(count: int) -> None:
    """PARAM_REQUEST_READ has a signed index: one above 32767 cannot even be written down."""
    session = Simulation()
    beat(session)
    say(session, param_value("A", 1.0, index=MOST_PARAMETERS, count=count))
    table = session.machine.table
    assert (table.count, table.params["A"].index) == (None, None)
    fetch = session.machine.begin_fetch(session.now)
    say(session, param_value("B", 1.0, index=count - 1, count=count))
    read = session.machine.read("NOT_THERE", session.now)
    session.run(60)  # with the question for an index that is known to be there
    assert isinstance(read.error, NoReply)
    assert isinstance(fetch.error, NoReply)
    assert all(request.param_index < 10 for request in session.sent_of(ParamRequestRead))


def test_the_largest_count_is_one() -> None:
    session = Simulation()
    beat(session)
    say(session, param_value("A", 1.0, index=MOST_PARAMETERS - 1, count=MOST_PARAMETERS))
    assert session.machine.table.count == MOST_PARAMETERS
    assert session.machine.table.params["A"].index == MOST_PARAMETERS - 1
    session.machine.read(MOST_PARAMETERS - 1, session.now)
    session.exchange()
    assert MOST_PARAMETERS - 1 in [request.param_index for request in session.sent_of(ParamRequestRead)]


def test_a_cached_count_above_what_can_be_asked_for_is_none() -> None:
    session = Simulation()
    beat(session)
    session.machine.use_cached(
        {"A": known("A", 1.0, index=40_000)},
        session.now,
        count=NO_INDEX - 1,
        confirmed=None,
        complete=True,
        volatile=frozenset(),
        volatile_known=False,
    )
    assert (session.machine.table.count, session.machine.table.complete) == (None, False)
    assert session.machine.table.params["A"].index is None


@pytest.mark.parametrize("letter", ["\xb5", "\xdf", "\xff"])
def test_a_name_whose_capitals_no_message_can_hold_is_left_as_it_is(letter: str) -> None:
    """ArduPilot's names are taken in capitals; the capital of µ is Greek, that of ß two letters."""
    session = Simulation()
    beat(session, autopilot=MAV_AUTOPILOT_ARDUPILOTMEGA)
    name = f"rc{letter}{'x' * 13}"
    for value in (1.0, 2.0, 3.0):  # what flips is asked for by its name
        say(session, param_value(name, value))
        session.run(0.1)
    session.run(3)
    assert [*session.machine.table.params] == [f"RC{letter}{'X' * 13}"]
    assert f"RC{letter}{'X' * 13}" in [request.param_id for request in session.sent_of(ParamRequestRead)]


# More than there can be


def heard(table: Table, name: str) -> None:
    table.hear(ParamValue(name, bytes(4), 9, 10, NO_INDEX), "vehicle")


def test_a_table_holds_so_many_names_and_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table_room, "MOST_NAMES", 3)
    table = Table()
    for name in "ABCD":
        heard(table, name)
    assert [*table.params] == ["A", "B", "C"]
    assert table.take("E", 9, 0, 0, None, is_older=False) is None
    assert table.fill({"F": known("F")}) == []
    assert [*table.params] == ["A", "B", "C"]
    assert table.take("C", 9, 1, 0, None, is_older=False) is not None
    table.remove(lambda param: param.name == "A")
    heard(table, "D")
    assert [*table.params] == ["B", "C", "D"]
