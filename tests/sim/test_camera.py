"""The simulated camera: its answers, and the arguments that it rejects."""

from __future__ import annotations

from typing import Any

import pytest

from paramclient.errors import ExtAckResult, UsageError
from paramclient.model.values import ParamType
from paramclient.sim import Camera
from paramclient.wire import frames, messages
from paramclient.wire.messages import Message, ParamExtAck, ParamExtSet

UINT32 = ParamType.UINT32


def ask(camera: Camera, message: Message, now: float = 1.0, *, until: float | None = None) -> list[Message]:
    """What the camera sends in answer."""
    camera.tick(0.0)
    camera.data_to_send()
    camera.receive(messages.encode(message, system=255, component=190, sequence=0), now)
    camera.tick(now if until is None else until)
    framer = frames.Framer({322, 324}, stream=False)
    found = [messages.decode(frame) for data in camera.data_to_send() for frame in framer.receive(data)]
    return [message for message in found if message is not None]


def set_mode(value: int, number: int = UINT32, name: str = "CAM_MODE") -> ParamExtSet:
    return ParamExtSet(1, 100, name, bytes([value]), number)


def result(camera: Camera, request: ParamExtSet) -> tuple[int, int]:
    """The value and the result of its acknowledgement."""
    (answer,) = ask(camera, request)
    assert isinstance(answer, ParamExtAck)
    return answer.raw[0], answer.param_result


def test_results_of_sets() -> None:
    camera = Camera(supported={"CAM_MODE": [0, 1]}, failing=["CAM_ISO"], limits={"CAM_EXPMODE": (0, 3)})
    assert result(camera, set_mode(0)) == (0, ExtAckResult.ACCEPTED)
    assert result(camera, set_mode(2)) == (0, ExtAckResult.VALUE_UNSUPPORTED)
    assert result(camera, set_mode(1, ParamType.UINT8)) == (0, ExtAckResult.FAILED)
    assert result(camera, set_mode(1, name="CAM_ISO")) == (100, ExtAckResult.FAILED)
    assert result(camera, set_mode(9, ParamType.UINT8, "CAM_EXPMODE")) == (3, ExtAckResult.ACCEPTED)
    assert ask(camera, set_mode(1, name="NO_SUCH")) == []


def test_a_slow_change() -> None:
    camera = Camera(slow={"CAM_MODE": 2.0})
    assert result(camera, set_mode(0)) == (1, ExtAckResult.IN_PROGRESS)
    assert result(camera, set_mode(5)) == (1, ExtAckResult.IN_PROGRESS)
    assert camera.next_deadline() is not None
    camera.tick(3.1)
    assert camera.ext_values["CAM_MODE"] == 0
    assert result(camera, set_mode(0)) == (0, ExtAckResult.ACCEPTED)


@pytest.mark.parametrize(
    "arguments",
    [
        {"table": {"": 1}},
        {"table": {"A": "x" * 129}},
        {"table": {"A": (ParamType.UINT8, 300)}},
        {"supported": {"CAM_MODE": ["text"]}},
        {"component": 256},
    ],
)
def test_arguments_that_it_rejects(arguments: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        Camera(**arguments)
    camera = Camera({"A": 1})
    with pytest.raises(UsageError):
        camera.set_ext_param("A", "text")
    with pytest.raises(UsageError):
        camera.remove_ext_param("B")
