"""A vehicle that lies: what it may cost, and what it cannot do."""

from __future__ import annotations

import pytest

from paramclient import events as events_room
from paramclient.errors import NoReply
from paramclient.events import Changes
from paramclient.protocol import authors as authors_room
from paramclient.protocol import component as component_room
from paramclient.protocol import station as station_room
from paramclient.protocol import table as table_room
from paramclient.protocol.authors import Authors
from paramclient.protocol.events import ComponentForgotten
from paramclient.protocol.ftp import blocks as blocks_room
from paramclient.protocol.ftp.blocks import Blocks
from paramclient.protocol.table import Change, Room, Table
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
from tests.liar import LiarVehicle
from tests.simulation import PEER, Simulation, known, listing_ardupilot, param_value


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


def test_the_tables_of_a_link_share_a_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """When it is full, each may still hold as many as an autopilot has."""
    monkeypatch.setattr(table_room, "MOST_NAMES_OF_LINK", 6)
    monkeypatch.setattr(table_room, "ENOUGH_NAMES", 2)
    room = Room()
    liar, honest = Table(room=room), Table(room=room)
    for name in "ABCDEFGH":
        heard(liar, name)
    assert [*liar.params] == [*"ABCDEF"]
    for name in "ABCD":
        heard(honest, name)
    assert [*honest.params] == [*"AB"]
    liar.forget()
    assert room.taken == 2
    for name in "CDEFGH":
        heard(honest, name)
    assert len(honest.params) == room.taken == 6


def test_a_link_has_so_many_components_and_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that are there keep their place; a lost one without a parameter gives it up."""
    monkeypatch.setattr(station_room, "MOST_COMPONENTS", 3)
    session = Simulation()
    for system in (1, 2, 3, 4):
        beat(session, system=system)
    say(session, param_value("A", 1.0), system=2)
    session.events.clear()
    assert [*session.station.components] == [(1, 1), (2, 1), (3, 1)]
    for _ in range(20):  # the first is heard, the others are lost, and the second has told of a parameter
        session.run(1)
        beat(session, system=1)
    beat(session, system=4)
    beat(session, system=5)
    session.exchange()
    assert [*session.station.components] == [(1, 1), (2, 1), (4, 1)]
    forgotten = [event for event in session.events if isinstance(event, ComponentForgotten)]
    assert [(event.machine.system, event.machine.component) for event in forgotten] == [(3, 1)]


def test_changes_that_nobody_takes_are_so_many_and_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(events_room, "MOST_CHANGES", 3)
    changes = Changes()
    for name in "ABCDE":
        changes.push(Change(name, None, known(name)))
    assert [*changes._waiting] == ["C", "D", "E"]


def test_what_is_remembered_of_changes_is_so_much_and_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(authors_room, "MOST_CHANGES", 3)
    authors = Authors()
    for at, name in enumerate("ABCDABCD"):
        authors.changed(name, at / 100, False)
    assert [*authors._changed_at] == ["B", "C", "D"]
    for _ in range(2):
        for name in "BCDE":
            authors.changed(name, 0.1, False)
    assert len(authors._doubts) <= 3


def test_names_that_go_are_told_to_the_cache_up_to_a_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table_room, "MOST_GONE", 4)
    table = Table()
    for name in "ABCDE":
        heard(table, name)
    assert len(table.take_dirty()) == 5
    table.forget()
    assert [*table.dirty] == [*"ABCD"]
    heard(table, "F")  # what is there is always told
    assert "F" in table.dirty


def test_a_value_that_flips_is_asked_for_only_so_often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(component_room, "MOST_DOUBTED", 2)
    session = Simulation()
    beat(session)
    for value in (1.0, 2.0):
        for name in "ABCDE":
            say(session, param_value(name, value))
    session.run(1.2)
    assert len(session.machine.reads) == 2


def test_a_file_has_so_many_gaps_and_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """What would leave one more is passed over; all else still fits, and the file is whole in the end."""
    monkeypatch.setattr(blocks_room, "MOST_GAPS", 2)
    blocks = Blocks()
    for offset in (2, 6, 10, 14):
        blocks.take(offset, b"ab")
    assert (blocks.reached, blocks.received, [*blocks.missing(9)]) == (8, 4, [0, 4])
    for offset in (0, 4, 8, 10, 12, 14):
        blocks.take(offset, b"cd")
    blocks.ends_at(16)
    assert blocks.is_complete
    assert blocks.content == b"cdabcdabcdcdcdcd"


def test_one_head_after_the_other_keeps_no_turn() -> None:
    """Each `_HASH_CHECK` says that the list begins; without a list it is over with the usual time-out."""
    honest, liar = listing_ardupilot(), LiarVehicle("endless hashes")
    session = Simulation(honest, liar)
    session.meet()
    session.until(lambda: (66, 1) in session.station.components)
    fetch = session.station.components[66, 1].begin_fetch(session.now)
    session.run(0.2)
    assert session.fetch(limit=5).complete
    session.until(lambda: fetch.done, limit=60)
    assert isinstance(fetch.error, NoReply)
