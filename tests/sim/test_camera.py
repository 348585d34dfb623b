"""The simulated camera: its answers, and the arguments that it rejects."""

from __future__ import annotations

from typing import Any

import pytest

from paramclient.errors import ExtAckResult, UsageError
from paramclient.model.values import ParamType
from paramclient.sim import Camera
from paramclient.wire import messages
from paramclient.wire.messages import ParamExtSet
from tests.ground_station import Station

UINT32 = ParamType.UINT32


def set_mode(value: int, number: int = UINT32, name: str = "CAM_MODE") -> ParamExtSet:
    return ParamExtSet(1, 100, name, bytes([value]), number)


def result(station: Station, request: ParamExtSet) -> list[tuple[int, int]]:
    """The value and the result of each acknowledgement."""
    answers = station.send(request).receive(messages.ParamExtAck)
    return [(answer.raw[0], answer.param_result) for answer in answers]


def test_results_of_sets() -> None:
    options: dict[str, Any] = {"supported": {"CAM_MODE": [0, 1]}, "limits": {"CAM_EXPMODE": (0, 3)}}
    station = Station(Camera(failing=["CAM_ISO"], **options))
    assert result(station, set_mode(0)) == [(0, ExtAckResult.ACCEPTED)]
    assert result(station, set_mode(2)) == [(0, ExtAckResult.VALUE_UNSUPPORTED)]
    assert result(station, set_mode(1, ParamType.UINT8)) == [(0, ExtAckResult.FAILED)]
    assert result(station, set_mode(1, name="CAM_ISO")) == [(100, ExtAckResult.FAILED)]
    assert result(station, set_mode(9, ParamType.UINT8, "CAM_EXPMODE")) == [(3, ExtAckResult.ACCEPTED)]
    assert result(station, set_mode(1, name="NO_SUCH")) == []


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
