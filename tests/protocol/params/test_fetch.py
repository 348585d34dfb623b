"""Fetches: the vehicle's hash where it has one, the list where it must be, and what becomes of the table."""

from __future__ import annotations

import math
from collections.abc import Iterable

import pytest

from paramclient.errors import LinkError, NoReply
from paramclient.model.values import TYPES_BY_NAME, ParamType, Trust, WireValue
from paramclient.protocol.events import Change, Fetched, ParamChanged
from paramclient.protocol.fetch import FetchResult
from paramclient.sim import Air, ArduPilotVehicle, GenericVehicle, PX4Vehicle, SimParam
from paramclient.wire import messages
from paramclient.wire.messages import HASH_CHECK, ParamRequestList, ParamRequestRead, ParamSet
from tests.simulation import Memory, Simulation, is_so, known, listing_ardupilot

VOLATILE = ("CAL_MAG0_XOFF", "COM_FLIGHT_UUID")
SMALL: list[SimParam] = [
    *(SimParam(f"P{number:02d}", ParamType.INT32, number) for number in range(40)),
    *(SimParam(name, ParamType.INT32, 7, volatile=True) for name in VOLATILE),
]
STRANGE = [SimParam(row.name, row.type, row.value, row.name in ("P03", "P04", "P05")) for row in SMALL]
"""A firmware that leaves out of its hash what no other does."""


def go_on(world: Simulation, *, seconds: float = 2.0) -> None:
    """End the session, and begin the next one with what it has learnt."""
    world.run(seconds)
    memory = world.memory()
    world.next_session()
    world.meet().use_cached(now=world.now, **memory)
    world.sent.clear()


class Headless(PX4Vehicle):
    """One whose hash at the head of the list is lost."""

    def _on_list(self) -> None:
        super()._on_list()
        self._hash_next = False


def deaf_to(vehicle: PX4Vehicle | GenericVehicle, names: Iterable[str]) -> None:
    """Suppress the PARAM_VALUEs of some parameters for all stations."""
    hidden = frozenset(names)
    send_value = vehicle._send_value

    def send(entry: object, **kwargs: object) -> None:
        if entry.name not in hidden:  # type: ignore[attr-defined]  # an Entry of the simulator
            send_value(entry, **kwargs)  # type: ignore[arg-type]  # the same

    vehicle._send_value = send  # type: ignore[method-assign]  # a fault that the simulator has no switch for


def names_read(world: Simulation) -> list[str]:
    return [read.param_id or str(read.param_index) for read in world.sent_of(ParamRequestRead)]


def values_of(result: FetchResult) -> dict[str, WireValue]:
    return {name: param.value for name, param in result.params.items() if param.index is not None}


# the first time


def test_a_first_fetch_from_px4() -> None:
    vehicle = PX4Vehicle()
    world = Simulation(vehicle)
    result = world.fetch()
    assert (result.system, result.component, result.source) == (1, 1, "stream")
    assert (result.count, result.received, result.missing, result.complete) == (903, 903, (), True)
    assert result.hash == vehicle.announced_hash()
    assert result.notes == ()
    assert values_of(result) == vehicle.values
    assert repr(result).startswith("<FetchResult 1/1 903 params from stream in 0.9")
    machine = world.machine
    assert machine.sync.synced
    assert machine.state == "synced"
    assert machine.table.complete
    assert machine.table.volatile_known
    assert len(machine.table.volatile) == 58
    assert machine.fetches.last is result
    assert [event.result for event in world.events if isinstance(event, Fetched)] == [result]
    assert {param.trust for param in result.params.values()} == {Trust.LIVE}


def test_a_first_fetch_from_ardupilot_requests_no_hash() -> None:
    vehicle = listing_ardupilot()
    world = Simulation(vehicle)
    result = world.fetch()
    assert result.hash is None
    assert result.notes == ()
    assert values_of(result) == vehicle.values
    assert names_read(world) == []


def test_a_first_fetch_of_something_generic() -> None:
    kinds: dict[str, WireValue | tuple[ParamType | int, WireValue]] = {
        kind.name: (kind, b"\x01\x02\x03\x04" if kind.size > 4 else 1) for kind in TYPES_BY_NAME.values()
    }
    vehicle = GenericVehicle(kinds)
    result = Simulation(vehicle).fetch()
    assert result.hash is None
    assert list(result.params) == list(vehicle.params)
    for name, param in vehicle.params.items():
        if param.type.size <= 4:
            assert result.params[name].value == param.value


def test_the_hash_that_is_lost_at_the_head_is_requested_meanwhile() -> None:
    vehicle = Headless(table=SMALL)
    world = Simulation(vehicle)
    result = world.fetch()
    assert result.hash == vehicle.announced_hash()
    assert names_read(world) == [HASH_CHECK]
    assert result.notes == ()
    requested = {
        type(message): at for at, message in world.sent if not isinstance(message, messages.Heartbeat)
    }
    assert requested[ParamRequestRead] - requested[ParamRequestList] < 0.02 < result.elapsed


def test_a_vehicle_whose_hash_is_switched_off() -> None:
    vehicle = PX4Vehicle(table=SMALL, hash_check=False)
    world = Simulation(vehicle)
    result = world.fetch()
    assert result.complete
    assert result.hash is None
    assert result.elapsed < 3.0
    assert values_of(result) == vehicle.values
    go_on(world)
    result = world.fetch()
    assert result.source == "stream"
    assert result.complete


# the next time


def test_a_hit_costs_one_request_and_the_volatile_values() -> None:
    vehicle = PX4Vehicle()
    world = Simulation(vehicle)
    world.fetch()
    go_on(world)
    volatile = world.machine.table.volatile
    result = world.fetch()
    assert result.source == "cache"
    assert (result.count, result.received, result.missing) == (903, 903, ())
    assert result.hash == vehicle.announced_hash()
    assert result.elapsed < 0.01
    assert {result.params[name].trust for name in volatile} == {Trust.CACHED}
    assert {param.trust for name, param in result.params.items() if name not in volatile} == {Trust.VERIFIED}
    assert names_read(world)[0] == HASH_CHECK
    refresh = world.machine.refresh
    assert refresh is not None
    world.until(lambda: refresh.done)
    assert sorted(names_read(world)) == sorted([HASH_CHECK, *volatile])
    assert world.sent_of(ParamRequestList) == []
    assert world.sent_of(ParamSet) == []
    assert {world.machine.table.params[name].trust for name in volatile} == {Trust.LIVE}
    assert world.machine.refresh is None


def test_volatile_values_are_read_afresh_after_a_hit() -> None:
    vehicle = PX4Vehicle(table=SMALL)
    world = Simulation(vehicle)
    world.fetch()
    go_on(world)
    vehicle.set_param("CAL_MAG0_XOFF", 99)
    world.run(0.0)
    assert world.fetch().source == "cache"
    world.run(1.0)
    param = world.machine.table.params["CAL_MAG0_XOFF"]
    assert (param.value, param.trust) == (99, Trust.LIVE)
    assert world.machine.sync.synced


def test_a_change_since_leads_to_the_list() -> None:
    vehicle = PX4Vehicle(table=SMALL)
    world = Simulation(vehicle)
    world.fetch()
    go_on(world)
    world.next_session()  # no station receives it
    vehicle.set_param("P05", 500)
    world.run(2.0)
    memory = memory_of_cache(SMALL)
    world.next_session()
    world.meet().use_cached(now=world.now, **memory)
    result = world.fetch()
    assert result.source == "stream"
    assert values_of(result) == vehicle.values
    assert result.hash == vehicle.announced_hash()
    assert names_read(world) == [HASH_CHECK]


def memory_of_cache(rows: list[SimParam]) -> Memory:
    world = Simulation(PX4Vehicle(table=rows))
    world.fetch()
    return world.memory()


def test_a_change_that_is_received_before_the_fetch_leads_to_no_list() -> None:
    vehicle = PX4Vehicle(table=SMALL)
    world = Simulation(vehicle)
    world.fetch()
    go_on(world)
    vehicle.set_param("P05", 500)
    world.run(0.5)
    assert world.machine.table.hash == vehicle.announced_hash()
    result = world.fetch()
    assert result.source == "cache"
    assert values_of(result) == vehicle.values


def test_a_parameter_that_the_vehicle_no_longer_lists_leaves_the_table() -> None:
    memory = memory_of_cache([*SMALL, SimParam("GONE", ParamType.INT32, 1)])
    memory["params"] = {**memory["params"], "UNLISTED": known("UNLISTED", 1, index=None)}
    world = Simulation(PX4Vehicle(table=SMALL))
    world.meet().use_cached(now=world.now, **memory)
    result = world.fetch()
    assert "GONE" not in result.params
    assert "UNLISTED" in result.params
    changes = [event.change for event in world.events if isinstance(event, ParamChanged)]
    assert [change.old.name for change in changes if change.new is None and change.old] == ["GONE"]


def test_a_refresh_downloads_in_spite_of_the_hash() -> None:
    world = Simulation(PX4Vehicle(table=SMALL))
    world.fetch()
    go_on(world)
    assert world.fetch(refresh=True).source == "stream"
    assert len(world.sent_of(ParamRequestList)) == 1


# changes while it runs


def test_parameters_that_come_into_use_during_the_download() -> None:
    late = [f"LATE_{number}" for number in range(5)]
    rows = [SimParam(f"A{number:03d}", ParamType.INT32, number) for number in range(300)]
    rows += [SimParam(name, ParamType.INT32, 1) for name in late]
    rows += [SimParam(f"Z{number:03d}", ParamType.INT32, number) for number in range(300)]
    vehicle = PX4Vehicle(table=rows, not_in_use=late)
    world = Simulation(vehicle)
    fetch = world.meet().begin_fetch(world.now)
    world.run(0.4)
    vehicle.use(*late)
    result = world.outcome(fetch)
    assert result.count == 605
    assert result.complete
    assert values_of(result) == vehicle.values
    assert {name: result.params[name].index for name in late} == {
        name: vehicle.param(name).index for name in late
    }
    assert result.hash == vehicle.announced_hash()


def test_a_group_that_appears_during_the_download() -> None:
    vehicle = listing_ardupilot()
    world = Simulation(vehicle)
    fetch = world.meet().begin_fetch(world.now)
    world.run(0.3)
    vehicle.set_param("EK2_ENABLE", 1)
    world.run(0.1)
    world.other_station(messages.ParamRequestRead(1, 1, "", 3))  # its answer shows the new count
    result = world.outcome(fetch)
    assert result.count in (1382, 1434)  # the count of the last received values
    result = world.fetch()
    assert result.count == 1434
    assert result.complete
    assert values_of(result) == vehicle.values


def test_a_fetch_completes_when_another_station_requests_the_list() -> None:
    vehicle = PX4Vehicle()
    world = Simulation(vehicle)
    fetch = world.meet().begin_fetch(world.now)
    world.run(0.4)
    world.other_station(ParamRequestList(1, 1))
    result = world.outcome(fetch)
    assert result.complete
    assert result.hash == vehicle.announced_hash()
    assert result.elapsed < 2.5


# hashes that cannot be computed


def test_an_unproven_hash_is_confirmed_by_being_the_same_before_and_after() -> None:
    vehicle = PX4Vehicle(table=STRANGE)
    world = Simulation(vehicle)
    result = world.fetch()
    assert result.hash == vehicle.announced_hash()
    assert "are not verified" in result.notes[0]
    assert not world.machine.table.volatile_known
    go_on(world)
    result = world.fetch()
    assert result.source == "cache"
    assert "are not verified" in result.notes[0]


def test_after_a_hit_with_an_unproven_hash_everything_is_read_afresh() -> None:
    vehicle = PX4Vehicle(table=STRANGE)
    world = Simulation(vehicle)
    world.fetch()
    go_on(world)
    vehicle._entry("P03").store(77)  # no hash reports it
    result = world.fetch()
    assert {param.trust for param in result.params.values()} == {Trust.CACHED}
    refresh = world.machine.refresh
    assert refresh is not None
    world.until(lambda: refresh.done)
    params = world.machine.table.params
    assert {param.trust for param in params.values()} == {Trust.LIVE}
    assert params["P03"].value == 77
    world.run(0.1)
    assert world.machine.table.hash == vehicle.announced_hash()
    assert "P03" in world.machine.table.volatile
    go_on(world)
    assert world.fetch().source == "cache"


def test_after_our_own_write_the_next_session_hits() -> None:
    vehicle = PX4Vehicle(table=SMALL)
    world = Simulation(vehicle)
    world.fetch()
    world.set("P05", 500)
    assert world.machine.table.hash == vehicle.announced_hash()
    world.run(0.5)
    assert world.machine.sync.synced
    go_on(world)
    result = world.fetch()
    assert result.source == "cache"
    assert result.params["P05"].value == 500


def test_a_write_that_brings_parameters_into_use() -> None:
    rows = [*SMALL, SimParam("A_SWITCH", ParamType.INT32, 0), SimParam("A_LATE", ParamType.INT32, 3)]
    vehicle = PX4Vehicle(table=rows, late_use={"A_SWITCH": ["A_LATE"]})
    world = Simulation(vehicle)
    assert world.fetch().count == 43
    world.set("A_SWITCH", 1)
    world.run(1.0)
    assert not world.machine.sync.synced
    assert world.machine.state == "partial"
    result = world.fetch()
    assert result.count == 44
    assert values_of(result) == vehicle.values
    assert result.hash == vehicle.announced_hash()


# what does not arrive


def test_indices_that_are_never_received_are_missing() -> None:
    vehicle = PX4Vehicle(table=SMALL)
    deaf_to(vehicle, ["P03", "P17"])
    world = Simulation(vehicle)
    result = world.fetch()
    assert not result.complete
    missing = tuple(index for index, name in enumerate(vehicle.params) if name in ("P03", "P17"))
    assert result.missing == missing
    assert (result.count, result.received, result.hash) == (42, 40, None)
    assert "2 missing" in repr(result)
    assert not world.machine.table.complete
    assert not world.machine.sync.synced
    assert world.machine.state == "partial"


def test_a_value_that_is_not_received_keeps_its_cached_value() -> None:
    vehicle = PX4Vehicle(table=SMALL)
    deaf_to(vehicle, ["P03"])
    vehicle.set_param("P20", 1234)
    world = Simulation(vehicle)
    world.meet().use_cached(now=world.now, **memory_of_cache(SMALL))
    result = world.fetch(refresh=True)
    assert len(result.missing) == 1
    assert result.params["P03"].trust is Trust.CACHED
    assert result.params["P20"].value == 1234
    assert world.machine.table.complete
    assert world.machine.table.hash == vehicle.announced_hash()


def test_an_incomplete_download_of_another_count_leaves_no_complete_table() -> None:
    vehicle = PX4Vehicle(table=[*SMALL, SimParam("NEW", ParamType.INT32, 1)])
    deaf_to(vehicle, ["NEW"])
    world = Simulation(vehicle)
    world.meet().use_cached(now=world.now, **memory_of_cache(SMALL))
    result = world.fetch()
    assert len(result.missing) == 1
    assert not world.machine.table.complete
    assert not world.machine.can_hit


def test_a_component_without_parameters_gives_no_reply() -> None:
    world = Simulation(GenericVehicle({}))
    error = world.error_of(lambda: world.fetch())
    assert isinstance(error, NoReply)
    assert world.machine.fetch is None
    assert world.machine.fetches.last is None


@pytest.mark.parametrize("is_cached", [False, True])
def test_a_vehicle_that_is_gone_gives_no_reply_in_bounded_time(is_cached: bool) -> None:
    vehicle = PX4Vehicle(table=SMALL)
    world = Simulation(vehicle)
    world.meet()
    if is_cached:
        world.machine.use_cached(now=world.now, **memory_of_cache(SMALL))
    vehicle.reboot(world.now, down=math.inf)
    fetch = world.machine.begin_fetch(world.now)
    assert is_so(not fetch.is_silent)
    world.run(3.0)
    assert fetch.is_silent
    assert isinstance(world.error_of(lambda: world.outcome(fetch, 90.0)), NoReply)
    assert len(world.machine.reads) == 0


# those who wait


def test_two_callers_share_one_fetch() -> None:
    world = Simulation(PX4Vehicle(table=SMALL))
    machine = world.meet()
    first = machine.begin_fetch(world.now)
    second = machine.begin_fetch(world.now)
    assert first is second
    assert machine.state == "fetching"
    machine.end_fetch(first, world.now)
    assert machine.fetch is first
    world.outcome(second)
    assert len(world.sent_of(ParamRequestList)) == 1


def test_the_last_one_who_waits_ends_it() -> None:
    world = Simulation(air=Air.symmetric([PX4Vehicle()], loss=0.2, seed=1))
    machine = world.meet()
    fetch = machine.begin_fetch(world.now)
    world.run(0.5)
    machine.end_fetch(fetch, world.now)
    assert machine.fetch is None
    assert not fetch.done
    assert len(machine.reads) == 0
    assert machine.table.params
    world.run(5.0)  # the stream goes on
    assert not fetch.done
    assert world.fetch().complete


def test_a_refresh_joins_a_download_and_turns_a_question_for_the_hash_into_one() -> None:
    world = Simulation(air=Air.symmetric([PX4Vehicle(table=SMALL)], delay=0.1))
    world.fetch()
    go_on(world)
    fetch = world.machine.begin_fetch(world.now)
    assert is_so(fetch.download is None)
    assert world.machine.begin_fetch(world.now, refresh=True) is fetch
    download = fetch.download
    assert download is not None
    assert world.machine.begin_fetch(world.now, refresh=True) is fetch
    assert fetch.download is download
    assert world.outcome(fetch).source == "stream"


def test_progress_and_partial_result_of_a_list_download() -> None:
    world = Simulation(PX4Vehicle())
    fetch = world.meet().begin_fetch(world.now)
    assert fetch.progress(world.now).received == 0
    with pytest.raises(NoReply, match="parameters of 1/1"):
        fetch.partial(world.now, "")
    world.run(0.5)
    progress = fetch.progress(world.now)
    assert 300 < progress.received < 600
    assert progress.total == 903
    assert progress.rate == pytest.approx(1000, rel=0.3)
    assert progress.seconds_left == pytest.approx(0.5, rel=0.5)
    partial = fetch.partial(world.now, "Time is up.")
    assert partial.notes == ("Time is up.",)
    assert not partial.complete
    assert partial.received == progress.received
    assert partial.received + len(partial.missing) == 903
    world.outcome(fetch)
    assert fetch.progress(world.now).seconds_left == 0.0


# the link


@pytest.mark.parametrize("seconds", [0.0, 0.05, 0.15, 0.5])
def test_the_link_goes_for_good_at_any_moment(seconds: float) -> None:
    world = Simulation(air=Air.symmetric([PX4Vehicle(table=SMALL)], delay=0.05))
    world.fetch()
    go_on(world)
    error = LinkError("gone", link="x")
    fetch = world.machine.begin_fetch(world.now)
    world.run(seconds)
    refresh = world.machine.refresh
    world.station.fail_all(error, world.now)
    assert fetch.error is error or fetch.result is not None
    assert refresh is None or refresh.error is error or refresh.done
    assert world.machine.fetch is None
    assert len(world.machine.reads) == len(world.machine.writes) == 0
    assert world.fetch().complete  # a later one is not spoilt by it


def test_changes_are_reported_in_order() -> None:
    world = Simulation(PX4Vehicle(table={"A": 1, "B": 2}))
    world.fetch()
    changes = [event.change for event in world.events if isinstance(event, ParamChanged)]
    assert [change.name for change in changes] == ["A", "B"]
    assert all(isinstance(change, Change) and change.old is None for change in changes)


# the file or the list


def test_an_ardupilot_may_first_say_whether_it_serves_the_file() -> None:
    world = Simulation(air=Air.symmetric([ArduPilotVehicle(live=())], delay=0.05))
    world.until(lambda: (1, 1) in world.station.components)
    assert not world.machine.identification.settled
    result = world.outcome(world.machine.begin_fetch(world.now))
    assert result.source == "ftp"
    assert not world.sent_of(ParamRequestList)
