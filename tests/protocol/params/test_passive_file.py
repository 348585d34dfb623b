"""Parameter files that other stations read over MAVFTP, in logs and where a client only listens."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import anyio
import pytest

from paramclient import ParamCache, ParamClient, ParamType, SyncState
from paramclient.cli import run
from paramclient.logs.imported_table import ImportedTable
from paramclient.logs.telemetry import import_log
from paramclient.model.values import Param, bits_of
from paramclient.protocol import wire
from paramclient.protocol.component import ComponentMachine
from paramclient.protocol.ftp import ObservedRead, ObservedReads
from paramclient.protocol.ftp.packets import Opcode, Packet
from paramclient.protocol.ftp.param_pck import PackedParam, decode, decode_prefix, encode
from paramclient.protocol.ftp.passive import IDLE_TIMEOUT, OFFSETS_MAX, OPENINGS_MAX, PIECES_MAX, READS_MAX
from paramclient.protocol.params.fetch_result import FetchResult
from paramclient.protocol.params.sync import SyncSettings
from paramclient.protocol.station import Station
from paramclient.sim import ArduPilotVehicle, Endpoint
from tests.recordings import DATA
from tests.shell import Tap, in_simulated_time
from tests.simulation import param_value
from tests.telemetry import BLOCK, STATION, FileLog

MAVPROXY = DATA / "stations" / "mavproxy_ftp.tlog"
RECORDINGS = [*sorted(DATA.glob("ardupilot_*ftp*.tlog")), MAVPROXY]
COUNT = 360
OTHER = (255, 190)


def table(**changed: int) -> list[PackedParam]:
    """COUNT parameters of several types; every third one is not its default, which is 1."""
    kinds = (ParamType.INT8, ParamType.INT16, ParamType.INT32, ParamType.REAL32)
    rows = []
    for number in range(COUNT):
        name, kind = f"GRP{number // 10}_VALUE_{number:03}", kinds[number % 4]
        value = changed.get(name, number % 100)
        default = None if number % 3 else bits_of(1, kind)
        rows.append(PackedParam(name, kind, bits_of(value, kind), default))
    return rows


def packed(rows: list[PackedParam]) -> bytes:
    return encode(rows, with_defaults=True)


FILE = packed(table())
NAMES = [row.name for row in table()]
BLOCKS = -(-len(FILE) // BLOCK)
assert BLOCKS > 9


def imported(log: FileLog | Path, tmp_path: Path, cache: Path | None = None) -> list[ImportedTable]:
    path = log if isinstance(log, Path) else log.write(tmp_path / "flight.tlog")

    async def work() -> list[ImportedTable]:
        with ParamCache(cache or tmp_path / "cache") as kept:
            return list(await import_log(path, kept))

    return anyio.run(work)


def kept(tmp_path: Path, key: str) -> dict[str, Param]:
    with ParamCache(tmp_path / "cache") as cache:
        return dict(cache.component(key).params)


async def replayed(path: Path) -> tuple[FetchResult, ParamClient]:
    async with ParamClient(f"replay:{path}?speed=0") as client:
        component = await client.component(1, 1)
        return await component.fetch_all(), client


def as_rows(params: dict[str, Param]) -> list[tuple[str, object, object, object]]:
    """Name, type, value and default by index."""
    placed = sorted((param.index, param) for param in params.values() if param.index is not None)
    return [(param.name, param.type, param.value, param.default) for _, param in placed]


EXPECTED = [
    (row.name, row.type, number % 100, 1 if not number % 3 else number % 100)
    for number, row in enumerate(table())
]


def assert_whole(log: FileLog, tmp_path: Path) -> ImportedTable:
    """Import and replay of a log give the whole table, of 1/1 only."""
    [reported] = imported(log, tmp_path)
    assert (reported.system, reported.component, reported.params, reported.complete, reported.notes) == (
        1,
        1,
        COUNT,
        True,
        (),
    )
    assert as_rows(kept(tmp_path, reported.key)) == EXPECTED
    result, client = anyio.run(replayed, tmp_path / "flight.tlog")
    assert as_rows(dict(result.params)) == EXPECTED
    assert (result.source, result.missing, result.notes, result.count) == ("ftp", (), (), COUNT)
    assert [address for address in client.components if address[0] == 1] == [(1, 1)]
    return reported


def a_read(data: bytes = FILE) -> FileLog:
    """A log with one read of the whole file."""
    return FileLog().beat().open().burst(data).close().wait(1.0).beat()


# whole


def test_a_log_of_mavproxy_gives_the_vehicle_with_types_and_defaults(tmp_path: Path) -> None:
    log = FileLog().beat().open().burst(FILE)
    log.made_up([(name, float(number)) for number, name in enumerate(NAMES)]).close().wait(1.0).beat()
    reported = assert_whole(log, tmp_path)
    assert reported.autopilot == wire.MAV_AUTOPILOT_ARDUPILOTMEGA
    with ParamCache(tmp_path / "cache") as cache:
        assert cache.history(reported.key) == []
        assert {(each.system, each.component) for each in cache.components()} == {(1, 1)}


def test_synthetic_values_alone_make_no_component(tmp_path: Path) -> None:
    log = FileLog().beat().made_up([("A", 1.0), ("B", 2.0)]).wait(1.0).beat()
    assert imported(log, tmp_path) == []

    async def receive() -> None:
        async with ParamClient(f"replay:{tmp_path / 'flight.tlog'}?speed=0") as client:
            component = await client.component()
            await anyio.sleep(0.1)
            assert list(client.components) == [(1, 1)]
            assert not component.params

    anyio.run(receive)


def test_synthetic_values_of_a_station_with_the_vehicles_system_id_make_no_component(tmp_path: Path) -> None:
    """MAVProxy as 1/190, recorded with `--source-system=1 --source-component=190`: it sends heartbeats."""
    station = (1, wire.COMP_ID_MISSIONPLANNER)
    beat = wire.Heartbeat(wire.MAV_TYPE_GCS, wire.MAV_AUTOPILOT_INVALID)
    log = FileLog().say(beat, component=190).beat().open(station=station).burst(FILE, station=station)
    log.made_up([(name, float(number)) for number, name in enumerate(NAMES)]).close(station=station)
    [reported] = imported(log.wait(1.0).say(beat, component=190).beat(), tmp_path)
    assert (reported.system, reported.component, reported.params, reported.complete, reported.notes) == (
        1,
        1,
        COUNT,
        True,
        (),
    )
    assert as_rows(kept(tmp_path, reported.key)) == EXPECTED

    async def replay() -> None:
        async with ParamClient(f"replay:{tmp_path / 'flight.tlog'}?speed=0") as client:
            result = await (await client.component(1, 1)).fetch_all()
            assert as_rows(dict(result.params)) == EXPECTED
            assert not client.components[station].params

    anyio.run(replay)


def test_a_ground_station_has_the_parameters_that_it_sends_on_request() -> None:
    station = Station(link="link", is_stream=False)
    beat = wire.Heartbeat(wire.MAV_TYPE_GCS, wire.MAV_AUTOPILOT_INVALID)
    for message in (beat, param_value("A", 7, index=0, count=1, kind=ParamType.INT32)):
        station.receive(wire.encode(message, system=254, component=190, sequence=0), "peer", 0.0)
    assert station.components[254, 190].table.params["A"].value == 7


def test_a_component_190_that_sends_heartbeats_has_parameters(tmp_path: Path) -> None:
    log = FileLog().beat(component=190).made_up([("A", 1.0), ("B", 2.0)]).wait(1.0).beat(component=190)
    assert [(each.component, each.params) for each in imported(log, tmp_path)] == [(190, 2)]


@pytest.mark.parametrize("speed", ["0", "20"])
def test_a_recording_gives_the_file_that_was_read(speed: str, tmp_path: Path) -> None:
    path = DATA / "ardupilot_ftp_download.tlog"
    expected = decode((DATA / "ardupilot_param_withdefaults.pck").read_bytes())
    rows = [
        (name, kind, bits, bits if default is None else default)
        for name, kind, bits, default in expected.entries
    ]
    [reported] = imported(path, tmp_path)
    assert (reported.params, reported.complete, reported.notes) == (1382, True, ())

    def bits(params: dict[str, Param]) -> list[tuple[str, object, int, int]]:
        found = sorted((each.index or 0, each) for each in params.values())
        return [
            (each.name, each.type, each.bits, bits_of(each.default, each.type))
            for _, each in found
            if each.default is not None
        ]

    @in_simulated_time
    async def replay() -> None:
        async with ParamClient(f"replay:{path}?speed={speed}") as client:
            component = await client.component(1, 1)
            result = await component.fetch_all()
            assert (result.source, result.complete) == ("ftp", True)
            assert bits(dict(result.params)) == rows
            assert component.sync_state is SyncState.SYNCED

    assert bits(kept(tmp_path, reported.key)) == rows
    replay()


def test_a_recording_of_mavproxy_gives_the_vehicle_with_types_and_defaults(tmp_path: Path) -> None:
    """MAVProxy 1.8.75 beside ArduCopter; of the 1,382 made-up values the first 600 are kept."""
    [reported] = imported(MAVPROXY, tmp_path)
    assert (reported.system, reported.component, reported.params, reported.complete, reported.notes) == (
        1,
        1,
        1382,
        True,
        (),
    )
    expected = [
        (name, kind, bits if default is None else default)
        for name, kind, bits, default in decode(
            (DATA / "ardupilot_param_withdefaults.pck").read_bytes()
        ).entries
    ]
    result, client = anyio.run(replayed, MAVPROXY)
    assert (result.source, result.missing, result.notes) == ("ftp", (), ())
    assert set(client.components) == {(1, 1), STATION}
    for params in (kept(tmp_path, reported.key), dict(result.params)):
        rows = sorted((param.index or 0, param) for param in params.values())
        assert [
            (param.name, param.type, bits_of(param.default, param.type))
            for _, param in rows
            if param.default is not None
        ] == expected


@pytest.mark.parametrize("path", RECORDINGS, ids=lambda path: path.stem)
def test_every_recording_of_a_read_gives_the_whole_table(path: Path, tmp_path: Path) -> None:
    """Left open, closed by others, beside a list, several in a row, by another program."""
    [reported] = imported(path, tmp_path)
    assert (reported.component, reported.params, reported.complete, reported.notes) == (1, 1382, True, ())
    kinds = {param.type for param in kept(tmp_path, reported.key).values()}
    assert kinds == {ParamType.INT8, ParamType.INT16, ParamType.INT32, ParamType.REAL32}
    result, _ = anyio.run(replayed, path)
    assert (result.source, result.complete, result.count) == ("ftp", True, 1382)


class LossyFiles(Tap):
    """A path to a vehicle on which every seventh message of MAVFTP is lost, and every fifth arrives twice."""

    def __init__(self, endpoint: Endpoint) -> None:
        super().__init__(endpoint)
        self.count = 0

    def data_to_send(self) -> list[bytes]:
        passed = []
        for data in super().data_to_send():
            if wire.Framer({110}, stream=False).receive(data):
                self.count += 1
                passed += [data] * ((self.count % 7 > 0) + (self.count % 5 == 0))
            else:
                passed.append(data)
        return passed


@pytest.mark.parametrize("way", [Tap, LossyFiles])
@in_simulated_time
async def test_our_own_log_gives_the_table_that_was_fetched(way: type[Tap], tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    vehicle = ArduPilotVehicle(table={f"NAME_{each:03}": each for each in range(300)})
    async with ParamClient(way(vehicle), cache=False, tlog=path) as client:
        component = await client.component()
        fetched = await component.fetch_all()
        assert fetched.source == "ftp"
    result, _ = await replayed(path)
    assert (result.source, result.complete) == ("ftp", True)
    assert result.params == fetched.params
    assert all(param.default is not None for param in result.params.values())


def single_reads(log: FileLog) -> FileLog:
    for number in range(BLOCKS):
        log.read(FILE, number * BLOCK)
    to = log.ask(Opcode.READ_FILE, session=11, size=BLOCK, offset=len(FILE))
    return log.reply(to, Opcode.READ_FILE, session=11, opcode=Opcode.NAK, data=b"\x06")


def gaps_filled(log: FileLog) -> FileLog:
    kept_blocks = [number for number in range(BLOCKS) if number not in (0, 3)]
    return log.burst(FILE, kept_blocks).read(FILE, 3 * BLOCK).read(FILE, 3 * BLOCK).read(FILE, 0)


def repeated_burst(log: FileLog) -> FileLog:
    log.burst(FILE, range(BLOCKS // 2), is_ended=False)
    return log.burst(FILE).burst(FILE, [0, 1], is_ended=False)


def opened_twice(log: FileLog) -> FileLog:
    """The open request was repeated, and its reply too, after the burst had begun."""
    data = b"@PARAM/param.pck?withdefaults=1"
    log.sequence = 50
    to = log.ask(Opcode.OPEN_FILE_RO, session=11, data=data)
    log.sequence = to
    log.ask(Opcode.OPEN_FILE_RO, session=11, data=data)
    log.reply(to, Opcode.OPEN_FILE_RO, session=11).burst(FILE, range(3), is_ended=False)
    return log.reply(to, Opcode.OPEN_FILE_RO, session=11).burst(FILE, range(3, BLOCKS))


def other_files_between(log: FileLog) -> FileLog:
    log.open("@SYS/threads.txt", session=12, station=OTHER)
    log.burst(FILE, range(2), is_ended=False)
    log.burst(b"x" * 700, session=12, station=OTHER)
    return log.burst(FILE, range(2, BLOCKS)).close(session=12, station=OTHER)


def another_station_on_the_same_session(log: FileLog) -> FileLog:
    log.open(session=11, station=OTHER)
    for number in range(BLOCKS):
        log.burst(packed(table(GRP0_VALUE_000=99)), [number], station=OTHER, is_ended=False)
        log.burst(FILE, [number], is_ended=False)
    return log.close(session=11, station=OTHER).burst(FILE, [])


def without_end(log: FileLog) -> FileLog:
    return log.burst(FILE, is_ended=False)


def numbers_wrap(log: FileLog) -> FileLog:
    log.close()
    log.sequence = 0xFFFF
    return log.open().burst(FILE)


def slow(log: FileLog) -> FileLog:
    """On a radio, with pauses that are shorter than the time-out."""
    return log.burst(FILE, gap=IDLE_TIMEOUT - 0.5)


@pytest.mark.parametrize(
    "reading",
    [
        single_reads,
        gaps_filled,
        repeated_burst,
        opened_twice,
        other_files_between,
        another_station_on_the_same_session,
        without_end,
        numbers_wrap,
        slow,
    ],
)
def test_however_the_file_was_read_it_is_put_together(
    reading: Callable[[FileLog], FileLog], tmp_path: Path
) -> None:
    log = reading(FileLog().beat().open()).close().wait(1.0).beat()
    if reading is another_station_on_the_same_session:
        [reported] = imported(log, tmp_path)
        assert as_rows(kept(tmp_path, reported.key)) == EXPECTED  # the one that ended last
        return
    assert_whole(log, tmp_path)


def test_a_log_that_begins_with_the_file(tmp_path: Path) -> None:
    """Nothing was received from the vehicle, and a station is reading."""
    assert_whole(FileLog().open().burst(FILE).close().wait(1.0).beat(), tmp_path)


def test_parts_of_the_file_make_up_the_whole(tmp_path: Path) -> None:
    log = FileLog().beat()
    for start in range(0, COUNT, 90):
        part = encode(table()[start : start + 90], total=COUNT, with_defaults=True)
        log.open(f"@PARAM/param.pck?start={start}&count=90&withdefaults=1").burst(part).close()
    [reported] = imported(log.wait(1.0).beat(), tmp_path)
    assert (reported.complete, reported.notes) == (True, ())
    assert as_rows(kept(tmp_path, reported.key)) == EXPECTED


# times


def test_values_have_the_time_at_which_the_file_was_opened(tmp_path: Path) -> None:
    log = FileLog().beat().wait(5.0).open().burst(FILE, gap=0.1).close()
    first = log.at
    log.wait(100.0).value(NAMES[5], 50, count=COUNT)
    opened = log.wait(100.0).open(session=12).at
    log.burst(packed(table(**{NAMES[5]: 50, NAMES[6]: 60})), session=12, gap=0.1)
    second = log.close(session=12).at
    log.wait(500.0).beat()
    [reported] = imported(log, tmp_path)
    with ParamCache(tmp_path / "cache") as cache:
        found = cache.component(reported.key)
        assert found.synced_at == pytest.approx(second, abs=0.3)
        assert found.heard_at[NAMES[4]] == pytest.approx(opened, abs=1e-3)
        assert [
            (each.name, each.old.value, each.new and each.new.value, round(each.at - first))
            for each in cache.history(reported.key)
        ] == [(NAMES[5], 5, 50, 100), (NAMES[6], 6, 60, round(opened - first))]
    before = [lines_of(tmp_path, reported.key), repr(kept(tmp_path, reported.key))]
    imported(log, tmp_path)
    assert [lines_of(tmp_path, reported.key), repr(kept(tmp_path, reported.key))] == before


def lines_of(tmp_path: Path, key: str) -> str:
    with ParamCache(tmp_path / "cache") as cache:
        return repr(cache.history(key))


def test_a_value_received_during_the_file_read_is_newer(tmp_path: Path) -> None:
    log = FileLog().beat().open().burst(FILE, range(2), is_ended=False)
    log.value(NAMES[1], 77, count=COUNT).burst(FILE, range(2, BLOCKS)).close().wait(1.0).beat()
    [reported] = imported(log, tmp_path)
    found = kept(tmp_path, reported.key)
    assert reported.complete
    assert (found[NAMES[1]].value, found[NAMES[1]].default, found[NAMES[1]].index) == (77, 1, 1)


def test_a_value_that_was_received_before_is_older(tmp_path: Path) -> None:
    log = FileLog().beat().value(NAMES[1], 77, count=COUNT).wait(1.0).open().burst(FILE).close().wait(1.0)
    [reported] = imported(log.beat(), tmp_path)
    assert kept(tmp_path, reported.key)[NAMES[1]].value == 1


def test_a_value_that_is_received_before_the_first_heartbeat_is_read_as_the_vehicle_means_it(
    tmp_path: Path,
) -> None:
    log = FileLog().value("A", 5, count=1).wait(5.0).beat().wait(1.0).beat()
    [reported] = imported(log, tmp_path)
    assert kept(tmp_path, reported.key)["A"].value == 5
    assert lines_of(tmp_path, reported.key) == "[]"


def test_a_read_that_stops_has_the_time_at_which_it_stopped(tmp_path: Path) -> None:
    log = FileLog().beat().open().burst(FILE, is_ended=False)
    at = log.at
    log.wait(3600.0).say(wire.Heartbeat(6, 8, system_status=4), system=255, component=230)
    [reported] = imported(log, tmp_path)
    with ParamCache(tmp_path / "cache") as cache:
        assert cache.component(reported.key).synced_at == pytest.approx(at, abs=0.3)


# gaps


@pytest.mark.parametrize("missing", [3, 7])
def test_of_a_file_with_a_gap_what_stands_before_it_is_taken(missing: int, tmp_path: Path) -> None:
    blocks = [number for number in range(BLOCKS) if number != missing]
    log = FileLog().beat().open().burst(FILE, blocks).close().wait(1.0).beat()
    pack, number = decode_prefix(FILE[: missing * BLOCK])
    assert (0 < len(pack.entries) < COUNT, number) == (True, COUNT)
    [reported] = imported(log, tmp_path)
    note = (
        f"{len(pack.entries)} of {COUNT} parameters were taken from the parameter file that station 255/230 "
        f"read: bytes from {missing * BLOCK} on are missing."
    )
    assert (reported.params, reported.complete, reported.notes) == (len(pack.entries), False, (note,))
    assert as_rows(kept(tmp_path, reported.key)) == EXPECTED[: len(pack.entries)]
    result, _ = anyio.run(replayed, tmp_path / "flight.tlog")
    assert (result.complete, result.received, result.count) == (False, len(pack.entries), COUNT)
    assert result.notes == (note,)


@pytest.mark.parametrize("end", ["nothing", "close", "open", "reset", "lost", "time", "silence", "reboot"])
def test_a_read_ends_in_many_ways(end: str, tmp_path: Path) -> None:
    log = FileLog().beat().open().burst(FILE, range(4), is_ended=False)
    if end == "close":
        log.ask(Opcode.TERMINATE_SESSION, session=11)
    elif end == "open":
        log.open("@SYS/tasks.txt")
    elif end == "reset":
        log.ask(Opcode.RESET_SESSIONS, session=0)
    elif end == "lost":
        to = log.ask(Opcode.READ_FILE, session=11, size=BLOCK, offset=4 * BLOCK)
        log.reply(to, Opcode.READ_FILE, session=11, opcode=Opcode.NAK, data=b"\x04")
    elif end == "time":
        log.wait(IDLE_TIMEOUT)
    elif end == "silence":
        log.wait(3600.0)
    elif end == "reboot":
        log.say(wire.Heartbeat(2, wire.MAV_AUTOPILOT_ARDUPILOTMEGA, system_status=wire.MAV_STATE_BOOT))
    if end != "nothing":
        log.beat().burst(FILE, range(4, BLOCKS))  # of that nothing belongs to the file any more
    [reported] = imported(log.wait(1.0).beat(), tmp_path)
    assert (reported.complete, len(reported.notes)) == (False, 1)
    assert reported.params == len(decode_prefix(FILE[: 4 * BLOCK])[0].entries)


@pytest.mark.parametrize(
    ("log", "note"),
    [
        (FileLog().beat().open().burst(FILE, range(1, BLOCKS)).close(), "its first bytes were not received"),
        (FileLog().beat().open().burst(b"\x11" * 500).close(), "does not begin with 0x1111"),
        (FileLog().beat().open().burst(FILE + b"x").close(), "bytes are left over"),
        (
            FileLog()
            .beat()
            .open()
            .burst(FILE, [0], is_ended=False)
            .value("A", 1, count=COUNT + 1)
            .burst(FILE, range(1, BLOCKS))
            .close(),
            f"it has {COUNT} parameters, and the vehicle has {COUNT + 1}",
        ),
    ],
)
def test_of_what_cannot_be_trusted_nothing_is_taken(log: FileLog, note: str, tmp_path: Path) -> None:
    [reported] = imported(log.wait(1.0).beat(), tmp_path)
    assert not reported.complete
    [said] = reported.notes
    assert said.startswith("The parameter file that station 255/230 read was not used: ")
    assert note in said
    if reported.params:
        assert kept(tmp_path, reported.key).keys() == {"A"}


@pytest.mark.parametrize(
    "log",
    [
        FileLog().beat().burst(FILE).close(),  # what file that is was not received
        FileLog().beat().open("APM/param.pck").burst(FILE).close(),
        FileLog().beat().open("@PARAM/param.pck2").burst(FILE).close(),
        FileLog().beat().open(),
    ],
)
def test_reads_of_other_files_are_ignored(log: FileLog, tmp_path: Path) -> None:
    assert imported(log.wait(1.0).beat(), tmp_path) == []


def test_a_later_whole_file_makes_up_for_one_with_gaps(tmp_path: Path) -> None:
    log = FileLog().beat().open().burst(FILE, range(4), is_ended=False).close()
    assert_whole(
        log.wait(5.0).open(session=12).burst(FILE, session=12).close(session=12).wait(1.0).beat(), tmp_path
    )


def test_a_whole_file_takes_out_what_the_vehicle_no_longer_has(tmp_path: Path) -> None:
    log = a_read().wait(10.0).open().burst(packed(table()[:-1])).close().wait(1.0).beat()
    [reported] = imported(log, tmp_path)
    assert (reported.params, reported.complete) == (COUNT - 1, True)
    assert NAMES[-1] not in kept(tmp_path, reported.key)


def test_the_command_says_what_is_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = FileLog().beat().open().burst(FILE, range(3)).close().wait(1.0).beat().write(tmp_path / "f.tlog")
    cache = str(tmp_path / "cache")
    assert run(["import", str(path), "--cache", cache, "--json"]) == 0
    reported = capsys.readouterr()
    [found] = json.loads(reported.out)["tables"]
    assert (found["complete"], len(found["notes"])) == (False, 1)
    assert f"f.tlog, 1/1: {found['notes'][0]}" in reported.err
    nothing = FileLog().beat().open().burst(FILE, [1]).close().wait(1.0).beat().write(tmp_path / "n.tlog")
    assert run(["import", str(nothing), "--cache", cache]) == 0
    assert "its first bytes were not received" in capsys.readouterr().err


# listening


def frames(log: FileLog) -> list[bytes]:
    """The frames of a log without their times."""
    from io import BytesIO

    from paramclient.links.tlog import read_records

    return [record.data for record in read_records(BytesIO(log.data))]


def listening() -> Station:
    sync_settings = SyncSettings.chosen(None, "auto", listen_only=True)
    return Station(link="test", is_stream=False, sync_settings=sync_settings)


def test_a_station_that_only_listens_follows_the_file() -> None:
    station = listening()
    now = 0.0
    log = FileLog().beat().open()
    for data in frames(log):
        station.receive(data, "peer", now)
    machine: ComponentMachine = station.components[1, 1]
    fetch = machine.begin_fetch(now)
    for number in range(BLOCKS):  # slower than a list that pauses for good
        now += 6.0
        station.receive(frames(FileLog().beat())[0], "peer", now)
        for data in frames(FileLog().burst(FILE, [number], is_ended=False)):
            station.receive(data, "peer", now)
        station.tick(now)
        assert not fetch.done
        assert not fetch.is_silent
    for data in frames(FileLog().burst(FILE, [])):
        station.receive(data, "peer", now)
    assert fetch.result is not None
    assert (fetch.result.source, fetch.result.complete) == ("ftp", True)
    assert as_rows(dict(fetch.result.params)) == EXPECTED
    assert station.data_to_send() == []


def test_a_file_that_stops_coming_ends_the_fetch_with_what_there_is() -> None:
    station = listening()
    for data in frames(FileLog().beat().open().burst(FILE, range(4), is_ended=False)):
        station.receive(data, "peer", 0.0)
    fetch = station.components[1, 1].begin_fetch(0.0)
    now = 0.0
    while not fetch.done:
        assert now < 60.0
        now = max(now, min(station.next_deadline(), now + 1.0))
        station.receive(frames(FileLog().beat())[0], "peer", now)
        station.tick(now)
    assert now >= IDLE_TIMEOUT
    assert fetch.result is not None
    assert (fetch.result.complete, len(fetch.result.notes)) == (False, 1)


# bounds


class Followed:
    """`ObservedReads` and its results."""

    def __init__(self, size_max: int = 10_000_000) -> None:
        self.ended: list[tuple[ObservedRead, float]] = []
        self.reads = ObservedReads(
            lambda path: path.startswith("f"),
            size_max=size_max,
            ended=lambda read, now: self.ended.append((read, now)),
        )

    def open(self, session: int, sequence: int = 0, path: bytes = b"file") -> None:
        self.reads.receive_request(Packet(sequence, session, Opcode.OPEN_FILE_RO, path), STATION, 0.0)
        reply = Packet(sequence + 1, session, Opcode.ACK, requested=Opcode.OPEN_FILE_RO)
        self.reads.receive_reply(reply, STATION, 0.0)

    def block(self, session: int, offset: int, data: bytes, now: float = 0.0) -> None:
        packet = Packet(9, session, Opcode.ACK, data, offset=offset, requested=Opcode.BURST_READ_FILE)
        self.reads.receive_reply(packet, (255, 0), now)


def test_no_more_is_kept_than_a_file_can_have() -> None:
    followed = Followed(size_max=1000)
    followed.open(1)
    followed.block(1, 900, b"x" * 200)
    assert len(followed.ended) == 1
    assert not followed.reads.running
    followed.open(1, sequence=5)
    end = Packet(9, 1, Opcode.NAK, b"\x06", offset=2_000, requested=Opcode.BURST_READ_FILE)
    followed.reads.receive_reply(end, STATION, 0.0)  # of no file that is wanted
    [read] = followed.reads.running
    assert read.blocks.end is None


def test_a_single_read_has_the_offset_of_its_request() -> None:
    """Not every server repeats it in the reply."""
    followed = Followed()
    followed.open(1)
    for sequence, offset, data in ((20, 3, b"def"), (22, 0, b"abc"), (24, 6, b"")):
        request = Packet(sequence, 1, Opcode.READ_FILE, size=3, offset=offset)
        followed.reads.receive_request(request, STATION, 0.0)
        opcode = Opcode.ACK if data else Opcode.NAK
        reply = Packet(sequence + 1, 1, opcode, data or b"\x06", requested=Opcode.READ_FILE)
        followed.reads.receive_reply(reply, STATION, 0.0)
    [(read, _)] = followed.ended
    assert (read.blocks.prefix, read.blocks.is_complete) == (b"abcdef", True)


def test_the_number_of_reads_openings_offsets_and_pieces_is_bounded() -> None:
    followed = Followed()
    for session in range(READS_MAX + 3):
        followed.open(session, sequence=session * 2)
    assert len(followed.reads.running) == READS_MAX
    assert [read.session for read, _ in followed.ended] == [0, 1, 2]
    for sequence in range(1000, 1000 + OPENINGS_MAX + 1):
        followed.reads.receive_request(Packet(sequence, 99, Opcode.OPEN_FILE_RO, b"file"), STATION, 0.0)
    oldest = Packet(1001, 99, Opcode.ACK, requested=Opcode.OPEN_FILE_RO)
    followed.reads.receive_reply(oldest, STATION, 0.0)
    assert 99 not in {read.session for read in followed.reads.running}
    last = READS_MAX + 2
    [read] = [each for each in followed.reads.running if each.session == last]
    for sequence in range(OFFSETS_MAX + 5):
        followed.reads.receive_request(Packet(sequence, last, Opcode.READ_FILE, offset=7), STATION, 0.0)
    assert len(read.offsets) == OFFSETS_MAX
    for offset in range(PIECES_MAX + 1):
        followed.block(last, offset, b"x")
    assert followed.ended[-1][0] is read
    assert read.blocks.received == PIECES_MAX


def test_idle_reads_end_by_the_time() -> None:
    followed = Followed()
    followed.open(1)
    assert followed.reads.next_deadline() == IDLE_TIMEOUT
    followed.block(1, 0, b"x", now=4.0)
    followed.reads.tick(4.0 + IDLE_TIMEOUT - 0.1)
    assert followed.reads.running
    followed.reads.tick(4.0 + IDLE_TIMEOUT)
    assert [at for _, at in followed.ended] == [4.0 + IDLE_TIMEOUT]
    followed.open(2, sequence=4)
    followed.reads.forget()
    assert len(followed.ended) == 1
    assert repr(followed.ended[0][0]) == "<ObservedRead file by 255/230, 1 bytes>"
