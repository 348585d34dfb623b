"""Extended parameters: a camera's values of every type, by the conversations of plain ones."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import anyio
import pytest

from paramclient import errors
from paramclient.model.values import Value
from paramclient.protocol.fetch import fetch_all
from paramclient.protocol.reads import read
from paramclient.protocol.session import Session
from paramclient.protocol.set_results import SetStatus
from paramclient.protocol.writes import write, write_many
from paramclient.sim import Air, Camera, Endpoint, PX4Vehicle
from paramclient.wire import messages
from tests.conversations import virtual
from tests.shell import Tap

CAMERA = (1, 100)


@asynccontextmanager
async def filming(endpoint: Endpoint) -> AsyncIterator[tuple[virtual.Conversation, Session]]:
    """Open a station on a camera, and wait for it: gives its extended parameters too."""
    async with virtual.converse(endpoint) as conversation:
        yield conversation, (await conversation.node(*CAMERA)).extended


@virtual.virtual_on_both
@pytest.mark.parametrize("loss", [0.0, 0.3])
async def test_values_of_every_type_are_fetched_read_and_set(loss: float) -> None:
    camera = Camera()
    async with filming(Air.symmetric([camera], loss=loss, delay=0.02, seed=3)) as (_, session):
        result = await fetch_all(session)
        assert (result.source, result.missing) == ("stream", ())
        assert dict(result.params) == dict(camera.ext_params.items())
        new: dict[str, Value] = {
            "CAM_MODE": 2**32 - 1,
            "CAM_TILT": -128,
            "CAM_STORAGE": 2**64 - 1,
            "CAM_CLOCK": -(2**63),
            "CAM_FOCAL_LEN": 0.1,
            "CAM_SHUTTERSPD": 0.1,
            "CAM_NAME": "Rear camera, the long name of a camera",
            "CAM_LICENSE": bytes(range(128, 256)),
        }
        for name, value in new.items():
            outcome = await write(session, name, value)
            assert (outcome.status, outcome.actual) == ("accepted", value)
        assert {name: camera.ext_values[name] for name in new} == new
        for name in new:
            await read(session, name)
            assert session.table.params[name] == camera.ext_params[name]
        assert (await read(session, 3)).param_id == "CAM_ISO"


async def test_a_set_sends_nothing_that_does_not_fit_and_reports_every_refusal() -> None:
    camera = Camera(supported={"CAM_ISO": [100, 200]}, failing=["CAM_EV"], limits={"CAM_TILT": (-9, 9)})
    async with filming(camera) as (conversation, session):
        for name, value, error in (
            ("CAM_TILT", 128, errors.UsageError),
            ("CAM_MODE", "text", errors.UsageError),
            ("CAM_ISSO", 1, errors.UnknownParameter),
            ("CAM_ISO", 150, errors.ValueUnsupported),
            ("CAM_EV", 1.0, errors.SetFailed),
        ):
            with pytest.raises(error, match=None if error is errors.UsageError else name):
                await write(session, name, value)
        assert {each.param_id for each in conversation.sent_of(messages.ParamExtSet)} == {"CAM_ISO", "CAM_EV"}
        assert camera.ext_values["CAM_ISO"] == session.table.params["CAM_ISO"].value == 100
        result = await write(session, "CAM_TILT", 90)
        assert (result.status, result.requested, result.actual) == ("adjusted", 90, 9)


@pytest.mark.parametrize("seconds", [0.5, 30.0])
async def test_progress_extends_the_wait_and_a_lost_result_is_requested_again(seconds: float) -> None:
    def is_result(message: messages.Message) -> bool:
        return isinstance(message, messages.ParamExtAck) and message.param_result == 0

    endpoint = Tap(Camera(slow={"CAM_MODE": seconds}))
    async with filming(endpoint) as (_, session):
        result = await write(session, "CAM_MODE", 2)
        assert (result.actual, result.attempts) == (2, 1)
        endpoint.down = virtual.losing(1, is_result)
        result = await write(session, "CAM_WBMODE", 2)
        assert (result.actual, result.attempts) == (2, 2)
        endpoint.down = virtual.losing(1, is_result)
        with anyio.fail_after(seconds + 2.5):
            result = await write(session, "CAM_MODE", 1)
        assert (result.actual, result.attempts) == (1, 1)  # a read has shown the value


async def test_a_set_is_sent_once_at_a_time_however_late() -> None:
    endpoint = Tap(Camera(), up=virtual.losing(3, lambda message: isinstance(message, messages.ParamExtSet)))
    async with filming(Air.symmetric([endpoint], delay=0.6)) as (_, session):
        assert (await write(session, "CAM_MODE", 2)).actual == 2
        assert len(endpoint.messages(messages.ParamExtSet)) == 1


@virtual.virtual_on_both
@pytest.mark.parametrize("after", [0.5, 1.9, 2.1])
async def test_a_camera_that_is_lost_while_it_reports_progress_ends_the_set(after: float) -> None:
    endpoint = Tap(Camera(slow={"CAM_MODE": 10.0}))
    async with filming(endpoint) as (_, session):
        await fetch_all(session)
        endpoint.silent_at = anyio.current_time() + after
        result = await write_many(session, [("CAM_MODE", 2), ("CAM_ISO", 200)])
        assert anyio.current_time() - endpoint.silent_at < 6.0
        assert [each.status for each in result.outcomes] == [SetStatus.UNKNOWN, SetStatus.ACCEPTED]
        assert isinstance(result.error, errors.NoReply)


async def test_what_other_stations_request_and_set_is_taken() -> None:
    async with filming(Camera()) as (conversation, session):
        conversation.hear(messages.ParamExtValue("CAM_ISO", b"d".ljust(128, b"\0"), 5, 16, 3), component=100)
        assert session.table.params["CAM_ISO"].value == 100
        await fetch_all(session)
        conversation.hear(messages.ParamExtSet(*CAMERA, "CAM_ISO", b"\x90\x01", 5), system=254, component=190)
        conversation.hear(messages.ParamExtAck("CAM_ISO", b"\x90\x01".ljust(128, b"\0"), 5, 0), component=100)
        assert session.table.params["CAM_ISO"].value == 400
        assert conversation.changes[-1].by == "station 254/190"


@virtual.virtual_on_both
async def test_the_refusal_of_another_stations_set_is_not_taken_for_ours() -> None:
    async with filming(Air.symmetric([Camera()], delay=0.05)) as (conversation, session):
        await fetch_all(session)
        async with virtual.meanwhile(write(session, "CAM_MODE", 2)) as results:
            await anyio.sleep(0.02)
            refusal = messages.ParamExtAck("CAM_MODE", bytes(128), 5, errors.ExtAckResult.VALUE_UNSUPPORTED)
            conversation.hear(refusal, component=100)
        assert (results[0].status, results[0].actual) == ("accepted", 2)
        assert session.table.params["CAM_MODE"].value == 2


async def test_a_component_may_have_both_kinds_or_none() -> None:
    async with virtual.converse(Air([Camera({"A": "text"}, plain={"A": 5}), PX4Vehicle()])) as conversation:
        node = await conversation.node(*CAMERA)
        await fetch_all(node.plain)
        await fetch_all(node.extended)
        assert (node.plain.table.params["A"].value, node.extended.table.params["A"].value) == (5, "text")
        assert {session.dialect.has_ack for session in node.sessions} == {False, True}
        px4 = await conversation.node(1, 1)
        with pytest.raises(errors.NoReply, match="list of 1/1"), anyio.fail_after(25.0):
            await fetch_all(px4.extended)
        assert not px4.extended.table.params
        assert len(conversation.sent_of(messages.ParamExtRequestList)) < 15
        assert len(conversation.sent_of(messages.ParamRequestList)) == 1
