"""Names that no parameter file can hold: dropped, counted, and without effect on other names."""

from __future__ import annotations

from pathlib import Path

import pytest

from paramclient import ParamClient, UsageError
from paramclient.errors import FileError
from paramclient.files import FileFormat, dumps, loads
from paramclient.model.paramset import ParamSet as Parameters
from paramclient.model.paramset import WrittenParam
from paramclient.model.values import ParamType, is_portable_name
from paramclient.sim import ArduPilotVehicle, GenericVehicle
from paramclient.wire.messages import NO_INDEX, ParamError, ParamSet, ParamValue, encode
from tests.commands import Command, Put, behind, in_process, leaping
from tests.shell import in_simulated_time
from tests.simulation import PEER, Simulation, known, param_value

UNUSABLE = [
    "A\nB",
    "A B",
    "A\tB",
    "\x1b[2J",
    "A,B",
    "#A",
    "A;B",
    "A=B",
    "@A",
    "/A",
    "A:",
    "\xb5\xdf",
    "12",
    "\x7f",
]
FORMS = list(FileFormat)


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Command:
    """Runs the command in this process, on a clock that leaps."""
    leaping(monkeypatch)
    return in_process(capsys)


@pytest.fixture
def put(monkeypatch: pytest.MonkeyPatch) -> Put:
    """Puts a simulated vehicle behind every URL; gives a URL."""
    return behind(monkeypatch, "sim:px4")


def say(session: Simulation, message: ParamValue | ParamSet | ParamError, system: int = 1) -> None:
    """Receive a message under an address."""
    session.station.receive(encode(message, system=system, component=1, sequence=0), PEER, session.now)


def is_held(name: str, form: FileFormat) -> bool:
    """Whether a file of this form keeps a name."""
    try:
        data = dumps(Parameters({name: WrittenParam(name, 1.5, ParamType.REAL32)}, 1, 1), file_format=form)
        return name in loads(data, file_format=form).sets[0]
    except FileError:
        return False


@pytest.mark.parametrize("shape", ["{}", "A{}B", "{}AB", "AB{}"])
def test_a_name_is_portable_if_every_form_of_file_holds_it(shape: str) -> None:
    names = [shape.format(chr(number)) for number in range(1, 256)]
    portable = [name for name in names if is_portable_name(name)]
    assert portable == [name for name in names if all(is_held(name, form) for form in FORMS)]
    assert len(portable) > 50


def test_a_portable_name_has_1_to_16_characters() -> None:
    assert [is_portable_name(name) for name in ("", "A", "A" * 16, "A" * 17)] == [False, True, True, False]


@pytest.mark.parametrize("name", UNUSABLE)
def test_messages_with_unusable_names_are_dropped_and_counted(name: str) -> None:
    session = Simulation(
        vehicle := GenericVehicle({"A": (ParamType.REAL32, 1.0), "B": (ParamType.REAL32, 2.0)})
    )
    session.fetch()
    say(session, param_value(name, 5.0, index=NO_INDEX, count=2))
    say(session, param_value(name, 5.0, index=0, count=7))
    say(session, ParamError(*session.station.own_address, name, -1, 1))
    say(session, ParamSet(1, 1, name, bytes(4), 9), system=254)
    table = session.machine.table
    assert ([*table.params], table.count, table.left_out, table.left_out_name) == (["A", "B"], 2, 4, name)
    result = session.fetch(refresh=True)
    assert (result.complete, [*result.params], result.notes) == (True, [*vehicle.params], ())


@pytest.mark.parametrize("ftp", [False, True])
def test_a_vehicle_with_such_a_name_is_fetched_but_for_its_index(ftp: bool) -> None:
    odd = {"A": (ParamType.REAL32, 1.0), "B C": (ParamType.REAL32, 2.0), "D": (ParamType.REAL32, 3.0)}
    session = Simulation(ArduPilotVehicle(table=odd, ftp=ftp))
    result = session.fetch(limit=30)
    assert (result.source, [*result.params], result.missing) == ("ftp" if ftp else "stream", ["A", "D"], (1,))
    assert any("no parameter file can contain this name" in note and "'B C'" in note for note in result.notes)
    assert not session.machine.table.complete
    again = session.fetch(limit=30)
    assert (again.missing, [*again.params]) == ((1,), ["A", "D"])


def test_a_cached_list_with_such_a_name_is_downloaded_anew() -> None:
    session = Simulation(GenericVehicle({"A": (ParamType.REAL32, 1.0), "B": (ParamType.REAL32, 2.0)}))
    session.meet().use_cached(
        {"A": known("A", 1.0, index=0), "A\nB": known("A\nB", 1.0, index=1)},
        session.now,
        count=2,
        confirmed=5,
        complete=True,
        volatile=frozenset(),
        volatile_known=False,
    )
    table = session.machine.table
    assert ([*table.params], table.complete, table.hash) == (["A"], False, None)
    result = session.fetch()
    assert (result.complete, result.resumed, [*result.params]) == (True, 0, ["A", "B"])


@in_simulated_time
async def test_no_such_name_can_be_requested_or_set() -> None:
    async with ParamClient(GenericVehicle({"A": (ParamType.REAL32, 1.0)}), cache=False) as client:
        vehicle = await client.component()
        with pytest.raises(UsageError, match="no parameter file can hold it"):
            await vehicle.get("A B")
        with pytest.raises(UsageError, match="no parameter file can hold it"):
            await vehicle.set("A B", 1.0)


class _Forged(GenericVehicle):
    """A vehicle under whose address another sender sends too."""

    def data_to_send(self) -> list[bytes]:
        sent = super().data_to_send()
        forged = encode(param_value("A\nB", 5.0, index=NO_INDEX, count=2), system=1, component=1, sequence=0)
        return [*sent, forged] if sent else sent


def test_a_forged_value_blocks_no_export(command: Command, put: Put, tmp_path: Path) -> None:
    vehicle = _Forged({"A": (ParamType.REAL32, 1.0), "B": (ParamType.REAL32, 2.0)})
    for form in ("qgc", "json"):
        saved = command("save", put(vehicle), path := tmp_path / form, "--format", form, "--no-cache")
        assert saved.code == 0, saved.err
        assert [*loads(path.read_bytes()).sets[0]] == ["A", "B"]
