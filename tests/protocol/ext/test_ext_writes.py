"""Writes of extended parameters: acknowledgements of every kind, late ones, and lost ones."""

from __future__ import annotations

import pytest
from paramclient.model.ext_params import ExtParam, ExtValue
from paramclient.protocol.ext.writes import LATE_ACK_TIME
from paramclient.protocol.requests.retry import EXT_PROGRESS_TIMEOUT

from paramclient.errors import (
    ExtAckResult,
    NoReply,
    Refused,
    SetFailed,
    UnknownParameter,
    UsageError,
    ValueNotApplied,
    ValueUnsupported,
)
from paramclient.sim import Camera
from paramclient.wire import frames, messages
from paramclient.wire.messages import ParamExtAck, ParamExtRequestRead, ParamExtSet
from tests.protocol.ext.camera import CameraSession, lossy


def acknowledge(session: CameraSession, name: str, value: bytes, number: int, result: int) -> None:
    """Receive an acknowledgement from any sender."""
    message = ParamExtAck(name, value, number, result)
    data = messages.encode(message, system=1, component=100, sequence=0)
    session.station.receive(data, "the only peer", session.now)


@pytest.mark.parametrize("loss", [0.0, 0.2])
@pytest.mark.parametrize("seed", range(4))
def test_values_of_every_type_are_set(loss: float, seed: int) -> None:
    camera = Camera()
    session = CameraSession(camera, air=lossy(camera, loss=loss, seed=seed))
    wanted: dict[str, ExtValue] = {
        "CAM_MODE": 0,
        "CAM_TILT": -30,
        "CAM_STORAGE": 2**64 - 1,
        "CAM_CLOCK": -(2**63),
        "CAM_SHUTTERSPD": 0.25,
        "CAM_FOCAL_LEN": 1 / 3,
        "CAM_NAME": "x" * 128,
        "CAM_STREAM_URI": "",
        "CAM_LICENSE": b"\xff\0\xfe",
    }
    for name, value in wanted.items():
        done = session.set_ext(name, value)
        assert (done.name, done.status, done.requested, done.actual) == (name, "accepted", value, value)
        assert not done.adjusted
        assert done.param == session.params[name] == camera.ext_param(name).with_index(done.param.index)
    assert {name: camera.ext_values[name] for name in wanted} == wanted
    assert session.is_idle


def test_the_type_is_read_first_and_then_known() -> None:
    session = CameraSession(Camera())
    session.set_ext("CAM_MODE", 2)
    session.set_ext("CAM_MODE", 3)
    assert len(session.sent_of(ParamExtRequestRead)) == 1
    first, second = session.sent_of(ParamExtSet)
    assert first == ParamExtSet(1, 100, "CAM_MODE", b"\2".ljust(128, b"\0"), 5)
    assert second.raw[0] == 3
    assert [(change.old and change.old.value, change.by) for change in session.changes] == [
        (None, "vehicle"),
        (1, "us"),
        (2, "us"),
    ]


def test_a_value_that_does_not_fit_is_not_sent() -> None:
    session = CameraSession(Camera())
    for _ in range(2):
        with pytest.raises(UsageError, match="'auto' is not a number, and the parameter is UINT32"):
            session.set_ext("CAM_MODE", "auto")
    session.fetch_ext()
    with pytest.raises(UsageError, match="does not fit INT8"):
        session.camera.write_ext("CAM_TILT", 200, session.now)
    assert not session.sent_of(ParamExtSet)
    assert session.is_idle


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_refusals_are_typed(loss: float) -> None:
    camera = Camera(supported={"CAM_MODE": [0, 1]}, failing=["CAM_ISO"])
    session = CameraSession(camera, air=lossy(camera, loss=loss))
    with pytest.raises(ValueUnsupported, match="did not set CAM_MODE to 7: value unsupported") as unsupported:
        session.set_ext("CAM_MODE", 7)
    assert (unsupported.value.code, unsupported.value.reason) == (1, "value unsupported")
    assert (unsupported.value.system, unsupported.value.component) == (1, 100)
    assert unsupported.value.name == "CAM_MODE"
    with pytest.raises(SetFailed, match="did not set CAM_ISO to 200: failed") as failed:
        session.set_ext("CAM_ISO", 200)
    assert failed.value.code == ExtAckResult.FAILED
    assert isinstance(failed.value, Refused)
    assert (camera.ext_values["CAM_MODE"], camera.ext_values["CAM_ISO"]) == (1, 100)
    assert session.is_idle


def test_a_value_that_the_camera_changes_is_adjusted() -> None:
    camera = Camera(limits={"CAM_ISO": (100, 3200)})
    session = CameraSession(camera)
    done = session.set_ext("CAM_ISO", 9000)
    assert (done.status, done.actual, done.adjusted) == ("adjusted", 3200, True)
    assert str(done) == "CAM_ISO = 3200 (adjusted from 9000)"
    assert session.params["CAM_ISO"].value == 3200


@pytest.mark.parametrize("pause", [0.0, 5.0])
def test_a_value_that_is_changed_to_the_old_one_is_adjusted(pause: float) -> None:
    camera = Camera(limits={"CAM_ISO": (100, 3200)})
    session = CameraSession(camera)
    session.set_ext("CAM_ISO", 9000)
    session.run(pause)
    began = session.now
    done = session.set_ext("CAM_ISO", 8000)
    assert (done.status, done.actual) == ("adjusted", 3200)
    assert session.now - began < 1.0


def test_unknown_names() -> None:
    session = CameraSession(Camera())
    session.fetch_ext()
    with pytest.raises(UnknownParameter):
        session.set_ext("NO_SUCH", 1)
    assert not session.sent_of(ParamExtSet)


@pytest.mark.parametrize("seconds", [0.5, 8.0, 60.0])
def test_progress_extends_the_wait(seconds: float) -> None:
    camera = Camera(slow={"CAM_MODE": seconds})
    session = CameraSession(camera)
    began = session.now
    done = session.set_ext("CAM_MODE", 0)
    assert (done.status, done.actual) == ("accepted", 0)
    assert session.now - began == pytest.approx(seconds, abs=0.2)
    sets = len(session.sent_of(ParamExtSet))
    assert sets == 1 + int(seconds // EXT_PROGRESS_TIMEOUT) - (seconds == 60.0)


def test_a_lost_result_is_requested_again() -> None:
    camera = Camera(slow={"CAM_MODE": 3.0})
    session = CameraSession(camera)
    session.fetch_ext()
    write = session.camera.write_ext("CAM_MODE", 0, session.now)
    session.run(1.0)
    assert write.is_in_progress
    began = session.now
    session.lose(lambda message: isinstance(message, ParamExtAck) and session.now < began + 3.0)
    assert session.outcome(write).actual == 0
    assert session.now - began == pytest.approx(EXT_PROGRESS_TIMEOUT - 1.0, abs=0.2)
    assert len(session.sent_of(ParamExtSet)) == 2


def test_a_set_that_nothing_answers() -> None:
    session = CameraSession(Camera())
    session.fetch_ext()
    camera = session.air.vehicles[0]
    take = camera.receive

    def deaf(data: bytes, now: float) -> None:
        if not isinstance(messages.decode(frames.Framer(stream=False).receive(data)[0]), ParamExtSet):
            take(data, now)

    camera.receive = deaf  # type: ignore[method-assign]
    with pytest.raises(ValueNotApplied, match=r"keeps CAM_MODE at 1; 2 was sent \d+ times") as caught:
        session.set_ext("CAM_MODE", 2)
    assert (caught.value.requested, caught.value.actual) == (2, 1)
    camera.receive = lambda data, now: None  # type: ignore[method-assign]
    with pytest.raises(NoReply, match="PARAM_EXT_SET CAM_MODE to 1/100"):
        session.set_ext("CAM_MODE", 2)
    assert session.is_idle


def test_writes_to_one_name_follow_each_other() -> None:
    camera = Camera()
    session = CameraSession(camera, air=lossy(camera, loss=0.0, delay=0.1))
    session.fetch_ext()
    writes = [session.camera.write_ext("CAM_MODE", value, session.now) for value in (2, 3, 4)]
    session.run(0.05)
    assert len(session.sent_of(ParamExtSet)) == 1
    assert [session.outcome(write).actual for write in writes] == [2, 3, 4]
    assert camera.ext_values["CAM_MODE"] == 4


def test_a_late_copy_of_a_refusal_refuses_nothing() -> None:
    camera = Camera(supported={"CAM_MODE": [1, 2]})
    session = CameraSession(camera, air=lossy(camera, loss=0.0, delay=0.1))
    session.fetch_ext()
    with pytest.raises(ValueUnsupported):
        session.set_ext("CAM_MODE", 3)
    write = session.camera.write_ext("CAM_MODE", 2, session.now)
    for _ in range(2):
        acknowledge(session, "CAM_MODE", b"\1", 5, ExtAckResult.VALUE_UNSUPPORTED)
    assert not write.done
    assert session.outcome(write).actual == 2
    began = session.now
    with pytest.raises(ValueUnsupported):
        session.set_ext("CAM_MODE", 3)
    assert session.now - began < 1.0, "a second refusal is enough"
    session.run(LATE_ACK_TIME + 0.1)
    sets = len(session.sent_of(ParamExtSet))
    with pytest.raises(ValueUnsupported):
        session.set_ext("CAM_MODE", 3)
    assert len(session.sent_of(ParamExtSet)) == sets + 1, "no other write can be the cause"


def test_a_change_by_another_station_is_seen_and_read() -> None:
    session = CameraSession(Camera())
    session.fetch_ext()
    foreign = ParamExtSet(1, 100, "CAM_MODE", b"\6", 5)
    data = messages.encode(foreign, system=254, component=190, sequence=0)
    session.station.receive(data, "another", session.now)
    session.other_station(foreign)
    session.run(1.0)
    assert session.values["CAM_MODE"] == 6
    assert session.changes[-1].by == "station 254/190"
    assert [message.param_id for message in session.sent_of(ParamExtRequestRead)] == ["CAM_MODE"]


def test_a_value_from_before_a_write_does_not_undo_it() -> None:
    camera = Camera({"A": 1})
    session = CameraSession(camera, air=lossy(camera, loss=0.0, delay=0.1))
    session.fetch_ext()
    read = session.camera.read_ext("A", session.now)
    session.run(0.01)
    camera_reply = messages.ParamExtValue("A", b"\1", 6, 1, 0)
    session.set_ext("A", 2)
    late = session.camera.read_ext("A", session.now)
    session.station.receive(
        messages.encode(camera_reply, system=1, component=100, sequence=0), "the only peer", session.now
    )
    assert session.values["A"] == 2
    message = session.outcome(late)
    assert ExtParam.of("A", message.raw, message.param_type).value == 2
    assert session.values["A"] == 2
    for each in (read, late):
        session.camera.ext.reads.release(each)


def test_nothing_is_written_while_another_vehicle_may_have_the_address() -> None:
    session = CameraSession(Camera())
    session.until(lambda: session.camera.identification.identity.uid is not None)
    session.fetch_ext()
    session.camera.identification.doubt(session.now)
    write = session.camera.write_ext("CAM_MODE", 2, session.now)
    assert session.camera.ext.writes.is_awaiting_permission
    session.station.tick(session.now)
    assert not session.sent_of(ParamExtSet)
    assert session.outcome(write).actual == 2
    assert not session.camera.ext.writes.is_awaiting_permission
