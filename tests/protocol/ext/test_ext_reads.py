"""Reads and lists of extended parameters in simulated time, on good and bad links."""

from __future__ import annotations

import math
from typing import Any

import pytest
from paramclient.model.ext_params import ExtParamType
from paramclient.protocol.params.sync import SyncSettings
from paramclient.protocol.requests.operation import Operation

from paramclient.errors import LinkError, NoReply, UnknownParameter, UsageError
from paramclient.model.values import ParamType, Trust
from paramclient.protocol.station import Station
from paramclient.sim import Camera, camera_table
from paramclient.wire import messages
from paramclient.wire.messages import Message, ParamExtRequestList, ParamExtRequestRead, ParamExtValue
from tests.protocol.ext.camera import CameraSession, lossy

MANY = {f"PARAM_{number:03}": number for number in range(300)}


def test_a_fetch_brings_every_type() -> None:
    camera = Camera()
    session = CameraSession(camera)
    result = session.fetch_ext()
    assert result.complete
    assert (result.system, result.component, result.source, result.missing) == (1, 100, "stream", ())
    assert result.count == len(camera_table())
    assert dict(result.params) == camera.ext_params
    assert {param.type for param in result.params.values()} == set(ExtParamType)
    assert session.values == camera.ext_values
    assert all(param.trust is Trust.LIVE for param in session.params.values())
    assert len(session.sent_of(ParamExtRequestList)) == 1
    assert not session.sent_of(ParamExtRequestRead)
    assert result.elapsed < 0.5
    assert repr(result).startswith("<ExtFetchResult 1/100 16 extended params from stream in 0.")
    assert session.is_idle
    assert session.camera.ext.fetches.last == result


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("table", [camera_table(), MANY], ids=["camera", "many"])
def test_a_fetch_on_a_link_that_loses_packets(table: dict[str, int], seed: int) -> None:
    camera = Camera(table)
    session = CameraSession(camera, air=lossy(camera, seed=seed))
    result = session.fetch_ext()
    assert result.complete
    assert session.values == camera.ext_values
    assert result.elapsed < 10.0
    assert session.is_idle


def test_a_few_values_missing_from_a_list_are_read_by_index() -> None:
    camera = Camera(MANY)
    session = CameraSession(camera)
    lost: set[int | None] = {3, 150, 299}

    def is_lost(message: Message | None) -> bool:
        index = message.param_index if isinstance(message, ParamExtValue) else None
        if index not in lost:
            return False
        lost.remove(index)
        return True

    session.lose(is_lost)
    assert session.fetch_ext().complete
    assert len(session.sent_of(ParamExtRequestList)) == 1
    assert {message.param_index for message in session.sent_of(ParamExtRequestRead)} == {3, 150, 299}


def test_a_list_that_lacks_much_is_requested_again() -> None:
    camera = Camera(MANY)
    session = CameraSession(camera)
    session.lose(
        lambda message: (
            isinstance(message, ParamExtValue)
            and message.param_index >= 20
            and len(session.sent_of(ParamExtRequestList)) < 2
        )
    )
    result = session.fetch_ext()
    assert result.complete
    assert len(session.sent_of(ParamExtRequestList)) == 2
    assert not session.sent_of(ParamExtRequestRead)
    assert result.elapsed < 3.0


def test_a_component_without_extended_parameters_is_given_up() -> None:
    session = CameraSession(Camera({}))
    with pytest.raises(NoReply, match="extended parameters of 1/100 after 6 tries") as caught:
        session.fetch_ext()
    assert caught.value.waited < 12.0
    assert session.is_idle
    assert not session.camera.ext.is_spoken


def test_a_component_that_sends_only_a_value() -> None:
    station = Station(link="sim:test", is_stream=False)
    message = ParamExtValue("A", b"\7", 1, 1, 0)
    data = messages.encode(message, system=1, component=33, sequence=0)
    station.receive(data, "peer", 0.0)
    machine = station.components[1, 33]
    assert machine.ext.table.params["A"].value == 7
    assert machine.expects_extended
    assert not machine.table.params, "the plain table is apart"


def test_a_component_may_speak_both() -> None:
    camera = Camera({"A": "text", "B": 2}, plain={"A": 0.5, "C": 3}, component=100)
    session = CameraSession(camera)
    machine = session.camera
    fetch = machine.begin_fetch(session.now)
    extended = machine.begin_ext_fetch(session.now)
    plain = session.outcome(fetch)
    machine.end_fetch(fetch, session.now)
    both = session.outcome(extended)
    machine.ext.fetches.end(extended)
    assert {name: param.value for name, param in plain.params.items()} == {"A": 0.5, "C": 3}
    assert {name: param.value for name, param in both.params.items()} == {"A": "text", "B": 2}
    assert session.set_ext("A", "other").actual == "other"
    write = machine.write("A", 1.5, session.now)
    assert session.outcome(write).actual == 1.5
    assert (machine.table.params["A"].value, machine.ext.table.params["A"].value) == (1.5, "other")
    assert machine.table.params["C"].type == ParamType.INT32
    assert not machine.is_busy


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_reads_by_name_and_index(loss: float) -> None:
    camera = Camera()
    session = CameraSession(camera, air=lossy(camera, loss=loss))
    for index, (name, param) in enumerate(camera.ext_params.items()):
        assert session.get_ext(name) == param
        assert session.get_ext(index) == param
    assert session.is_idle


def test_an_unknown_name_is_distinguished_from_a_lost_response() -> None:
    camera = Camera()
    session = CameraSession(camera)
    session.fetch_ext()
    with pytest.raises(UnknownParameter, match="1/100 has no NO_SUCH"):
        session.get_ext("NO_SUCH")
    with pytest.raises(UnknownParameter, match="has no extended parameter 16"):
        session.get_ext(16)
    assert session.is_idle


def test_concurrent_fetches_are_one() -> None:
    session = CameraSession(Camera())
    fetches = [session.camera.begin_ext_fetch(session.now) for _ in range(3)]
    assert len(set(map(id, fetches))) == 1
    session.camera.ext.fetches.end(fetches[0])
    assert session.outcome(fetches[1]).complete
    assert len(session.sent_of(ParamExtRequestList)) == 1
    session.camera.ext.fetches.end(fetches[1])
    session.camera.ext.fetches.end(fetches[2])


def test_the_last_holder_cancels_a_fetch() -> None:
    session = CameraSession(Camera(MANY))
    fetch = session.camera.begin_ext_fetch(session.now)
    session.run(0.05)
    progress = session.camera.ext.fetches.progress(fetch, session.now)
    assert 0 < progress.received < 300
    assert progress.total == 300
    partial = session.camera.ext.fetches.partial(fetch, session.now, "why")
    assert not partial.complete
    assert (len(partial.missing), partial.notes) == (300 - progress.received, ("why",))
    session.camera.ext.fetches.end(fetch)
    assert session.is_idle
    session.run(1.0)
    assert len(session.params) == 300, "what still arrives is taken"


def test_a_complete_list_removes_parameters_that_are_gone() -> None:
    camera = Camera({"A": 1, "B": 2, "C": 3})
    session = CameraSession(camera)
    session.fetch_ext()
    camera.remove_ext_param("B")
    result = session.fetch_ext()
    assert (list(result.params), result.count) == (["A", "C"], 2)
    assert (session.changes[-1].name, session.changes[-1].new) == ("B", None)
    assert {name: param.index for name, param in session.params.items()} == {"A": 0, "C": 1}


def test_a_list_whose_count_changes_begins_again() -> None:
    camera = Camera(MANY)
    session = CameraSession(camera)
    fetch = session.camera.begin_ext_fetch(session.now)
    session.run(0.2)
    camera.remove_ext_param("PARAM_007")
    result = session.outcome(fetch)
    assert result.complete
    assert session.values == camera.ext_values
    session.camera.ext.fetches.end(fetch)


def test_a_lost_component_ends_everything() -> None:
    camera = Camera()
    session = CameraSession(camera)
    session.fetch_ext()
    camera.reboot(session.now, down=math.inf)
    machine = session.camera
    fetch = machine.begin_ext_fetch(session.now)
    read = machine.read_ext("CAM_MODE", session.now)
    write = machine.write_ext("CAM_MODE", 2, session.now)
    session.until(lambda: machine.presence.is_lost)
    begun: list[Operation[Any]] = [fetch, read, write]
    assert all(isinstance(each.error, NoReply) for each in begun)
    assert session.is_idle
    assert all(param.trust is Trust.CACHED for param in session.params.values())
    for call in (
        lambda: machine.begin_ext_fetch(session.now),
        lambda: machine.read_ext("CAM_MODE", session.now),
        lambda: machine.write_ext("CAM_MODE", 2, session.now),
    ):
        assert isinstance(session.error_of(call), NoReply)


def test_the_end_of_the_link_ends_everything() -> None:
    session = CameraSession(Camera())
    machine = session.camera
    begun: list[Operation[Any]] = [
        machine.begin_ext_fetch(session.now),
        machine.read_ext("CAM_MODE", session.now),
        machine.write_ext("CAM_MODE", 2, session.now),
    ]
    session.station.fail_all(LinkError("gone", link="sim:test"), session.now)
    assert all(isinstance(each.error, LinkError) for each in begun)
    assert session.is_idle


def test_a_restart_begins_the_list_again() -> None:
    camera = Camera(MANY)
    session = CameraSession(camera)
    session.run(2.0)
    fetch = session.camera.begin_ext_fetch(session.now)
    session.run(0.2)
    assert "PARAM_000" in session.params
    camera.reboot(session.now, down=1.0)
    camera.set_ext_param("PARAM_000", 77)
    assert session.outcome(fetch).complete
    session.camera.ext.fetches.end(fetch)
    assert session.values == camera.ext_values


def test_a_listener_takes_what_others_request() -> None:
    camera = Camera()
    station = Station(
        link="sim:test",
        is_stream=False,
        sync_settings=SyncSettings.chosen(None, "auto", listen_only=True, is_log=False),
    )
    session = CameraSession(camera, station=station)
    session.other_station(ParamExtRequestList(1, 100))
    session.run(1.0)
    assert session.values == camera.ext_values
    session.other_station(messages.ParamExtSet(1, 100, "CAM_MODE", b"\2", 5))
    session.run(1.0)
    assert session.values["CAM_MODE"] == 2
    assert not session.sent
    with pytest.raises(UsageError, match="only listens"):
        session.camera.begin_ext_fetch(session.now)


def test_names_that_no_file_can_hold_are_left_out() -> None:
    station = Station(link="sim:test", is_stream=False)
    for number, name in enumerate(["", "a b", "#x", "=", "OK"]):
        message = ParamExtValue(name, b"\7", 1, 5, number)
        station.receive(messages.encode(message, system=1, component=33, sequence=0), "peer", 0.0)
    assert list(station.components[1, 33].ext.table.params) == ["OK"]
