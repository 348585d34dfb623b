"""A station and a simulated camera in a time that passes as fast as it can."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from paramclient.model.ext_params import ExtParam, ExtValue
from paramclient.protocol.component import ComponentMachine

from paramclient.protocol.events import Change, ExtParamChanged
from paramclient.protocol.fetch import FetchResult
from paramclient.protocol.set_results import SetResult
from paramclient.protocol.station import Station
from paramclient.sim import Air, Camera, Endpoint
from paramclient.wire import frames, messages
from paramclient.wire.messages import Message
from tests.simulation import Simulation

__all__ = ["CameraSession", "lossy", "message_in"]

Result = TypeVar("Result")


class CameraSession(Simulation):
    """A `Simulation` with the camera 1/100, and calls for its extended parameters."""

    def __init__(self, *vehicles: Endpoint, air: Air | None = None, station: Station | None = None) -> None:
        super().__init__(*vehicles, air=air, station=station)
        self.until(lambda: (1, 100) in self.station.components)

    @property
    def camera(self) -> ComponentMachine:
        return self.station.components[1, 100]

    @property
    def params(self) -> dict[str, ExtParam]:
        return self.camera.ext.table.params

    @property
    def values(self) -> dict[str, ExtValue]:
        return {name: param.value for name, param in self.params.items()}

    @property
    def changes(self) -> list[Change]:
        return [event.change for event in self.events if isinstance(event, ExtParamChanged)]

    def lose(self, is_lost: Callable[[Message | None], bool]) -> None:
        """Lose those messages of the camera from now on."""
        deliver = self.air.data_to_send
        self.air.data_to_send = lambda: [  # type: ignore[method-assign]
            each for each in deliver() if not is_lost(message_in(each))
        ]

    def fetch_ext(self, limit: float = 120.0) -> FetchResult:
        fetch = self.camera.begin_ext_fetch(self.now)
        try:
            return self.outcome(fetch, limit)
        finally:
            self.camera.ext.fetches.end(fetch)

    def get_ext(self, key: str | int, limit: float = 120.0) -> ExtParam:
        read = self.camera.read_ext(key, self.now)
        try:
            return self.params[self.outcome(read, limit).param_id]
        finally:
            self.camera.ext.reads.release(read)

    def set_ext(self, name: str, value: ExtValue, limit: float = 120.0) -> SetResult:
        write = self.camera.write_ext(name, value, self.now)
        try:
            return self.outcome(write, limit)
        finally:
            self.camera.ext.writes.cancel(write, self.now)

    @property
    def is_idle(self) -> bool:
        """Whether nothing is in flight or registered."""
        return not self.camera.ext.is_busy


def message_in(data: bytes) -> Message | None:
    """The message in a datagram with one frame."""
    return messages.decode(frames.Framer(messages.DECODED_IDS, stream=False).receive(data)[0])


def lossy(camera: Camera, *, loss: float = 0.2, seed: int = 1, delay: float = 0.02) -> Air:
    return Air.symmetric([camera], loss=loss, delay=delay, seed=seed)
