"""Extended parameters on links drawn by hypothesis: whatever happens, what is reported is what the camera
holds."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from paramclient.model.ext_params import ExtParamType, ExtValue
from paramclient.protocol.ext.fetch import ExtFetch
from paramclient.protocol.ext.write_batch import ExtWriteBatch
from paramclient.protocol.ext.writes import ExtWrite
from paramclient.protocol.params.reads import ValueRead
from paramclient.protocol.requests.operation import Operation

from paramclient.errors import NoReply, SetFailed, ValueNotApplied, ValueUnsupported
from paramclient.protocol.set_results import SetStatus
from paramclient.sim import Air, Camera, FaultyLink
from tests.protocol.ext.camera import CameraSession

LIMIT = 400.0
"""Simulated seconds within which everything must have ended."""
SETTLING = 30.0
"""Simulated seconds after which nothing of an earlier exchange is under way."""

KINDS = ExtParamType
TABLE: dict[str, tuple[ExtParamType, ExtValue]] = {
    "PLAIN": (KINDS.INT32, 1),
    "SLOW": (KINDS.UINT8, 1),
    "PICKY": (KINDS.UINT16, 1),
    "CLAMPED": (KINDS.INT16, 1),
    "BROKEN": (KINDS.REAL64, 1.0),
    "TEXT": (KINDS.CUSTOM, "one"),
    "WIDE": (KINDS.UINT64, 2**60),
    **{f"MORE_{number:02d}": (KINDS.REAL32, float(number)) for number in range(40)},
}
NAMES = st.sampled_from([*list(TABLE)[:7], "MORE_07"])
PICKS = (1, 2, 5)
LIMITS = (-10, 10)


def value_for(name: str, number: int) -> ExtValue:
    """A value of the type of a name."""
    kind = TABLE[name][0]
    if kind is KINDS.CUSTOM:
        return f"text {number}" if number % 2 else bytes([255, number + 1])
    return float(number) if kind in (KINDS.REAL32, KINDS.REAL64) else number


class Extended(RuleBasedStateMachine):
    """One camera, one link, our writes and reads, and changes by others."""

    @initialize(
        loss=st.sampled_from([0.0, 0.05, 0.2, 0.4]),
        delay=st.sampled_from([0.0, 0.02, 0.3]),
        jitter=st.sampled_from([0.0, 0.05, 0.2]),
        duplicate=st.sampled_from([0.0, 0.3]),
        reorder=st.sampled_from([0.0, 0.2]),
        slow=st.sampled_from([0.2, 3.0, 12.0]),
        seed=st.integers(0, 999),
    )
    def begin(self, slow: float, seed: int, **faults: float) -> None:
        self.camera = Camera(
            TABLE,
            slow={"SLOW": slow},
            supported={"PICKY": PICKS},
            limits={"CLAMPED": LIMITS},
            failing=["BROKEN"],
        )
        links = [FaultyLink(seed=2 * seed + way, **faults) for way in range(2)]  # type: ignore[arg-type]
        air = Air([self.camera], uplink=links[0], downlink=links[1])
        self.session = CameraSession(self.camera, air=air)
        self.open: list[Operation[Any]] = []
        self.changed_at = -math.inf  # by another hand than ours
        self.was_cancelled: set[str] = set()
        self.requested: dict[int, list[tuple[str, ExtValue]]] = {}  # the values of a batch

    @rule(name=NAMES, number=st.integers(0, 20))
    def write(self, name: str, number: int) -> None:
        session = self.session
        self.open.append(session.camera.write_ext(name, value_for(name, number), session.now))

    @rule(pairs=st.lists(st.tuples(NAMES, st.integers(0, 20)), max_size=8))
    def write_many(self, pairs: list[tuple[str, int]]) -> None:
        session = self.session
        values = [(name, value_for(name, number)) for name, number in pairs]
        with suppress(NoReply):  # it is lost
            self.open.append(session.camera.write_many_ext(values, session.now))
            self.requested[id(self.open[-1])] = values

    @rule(key=NAMES | st.integers(0, len(TABLE) - 1))
    def read(self, key: str | int) -> None:
        self.open.append(self.session.camera.read_ext(key, self.session.now))

    @rule()
    def fetch(self) -> None:
        self.open.append(self.session.camera.begin_ext_fetch(self.session.now))

    @precondition(lambda self: self.open)
    @rule(data=st.data())
    def cancel(self, data: st.DataObject) -> None:
        operation = data.draw(st.sampled_from(self.open))
        self.open.remove(operation)
        if isinstance(operation, ExtWrite):
            self.was_cancelled.add(operation.name)
        if isinstance(operation, ExtWriteBatch):
            self.was_cancelled.update(name for name, _ in self.requested[id(operation)])
        self.give_back(operation)

    @rule(name=NAMES, number=st.integers(21, 40))
    def change_on_board(self, name: str, number: int) -> None:
        self.camera.set_ext_param(name, value_for(name, number))
        self.changed_at = self.session.now

    @rule()
    def reboot(self) -> None:
        self.camera.reboot(self.session.now, down=0.5)
        self.changed_at = self.session.now

    @rule(seconds=st.sampled_from([0.0, 0.05, 0.5, 4.0]))
    def time_passes(self, seconds: float) -> None:
        self.session.run(seconds)

    @rule()
    def everything_ends(self) -> None:
        """A complete list after that is what the camera holds, and so are the last writes."""
        session = self.session
        session.until(lambda: all(each.done for each in self.open), LIMIT)
        self.what_ended_is_right()
        session.until(lambda: session.is_idle, LIMIT)
        session.run(SETTLING)
        self.was_cancelled.clear()
        if session.camera.presence.is_lost:
            return
        result = session.fetch_ext(LIMIT)
        assert result.complete
        assert session.values == self.camera.ext_values
        assert list(result.params) == list(session.params)

    @invariant()
    def what_ended_is_right(self) -> None:
        for operation in [each for each in getattr(self, "open", []) if each.done]:
            self.open.remove(operation)
            if isinstance(operation, ExtWrite):
                self.check(operation)
            elif isinstance(operation, ExtWriteBatch):
                self.check_batch(operation)
            elif operation.error is not None:
                assert isinstance(operation.error, NoReply)
            self.give_back(operation)

    @invariant()
    def a_table_is_consistent(self) -> None:
        if not hasattr(self, "session"):
            return
        params = self.session.params
        indices = [param.index for param in params.values() if param.index is not None]
        assert len(indices) == len(set(indices))
        assert all(name == param.name for name, param in params.items())
        assert not self.session.camera.table.params, "no value gets into the plain table"

    def check(self, write: ExtWrite) -> None:
        name, error = write.name, write.error
        if error is None:
            assert write.result is not None
            if write.result.adjusted:
                is_disturbed = self.changed_at >= write.begun_at - SETTLING or name in self.was_cancelled
                assert name == "CLAMPED" or is_disturbed
            else:
                assert write.result.actual == write.value
        elif isinstance(error, ValueUnsupported):
            assert name == "PICKY"
            assert write.value not in PICKS or name in self.was_cancelled
        elif isinstance(error, SetFailed):
            assert name == "BROKEN"
        elif isinstance(error, ValueNotApplied):
            is_disturbed = name in self.was_cancelled or self.changed_at >= write.begun_at - SETTLING
            assert is_disturbed, (error, write.begun_at, self.session.now)
        else:
            assert isinstance(error, NoReply), error

    def check_batch(self, batch: ExtWriteBatch) -> None:
        """One outcome for each value, in the order of the request, whatever the batch met."""
        assert batch.result is not None
        outcomes = batch.result
        assert [(each.name, each.requested) for each in outcomes] == self.requested.pop(id(batch))
        assert len(batch.ended) == len(outcomes)
        for each in outcomes:
            name = each.name
            is_disturbed = self.changed_at >= batch.begun_at - SETTLING or name in self.was_cancelled
            if each.status is SetStatus.ACCEPTED:
                assert each.result is not None
                assert each.result.actual == each.requested
            elif each.status is SetStatus.ADJUSTED:
                assert name == "CLAMPED" or is_disturbed
            elif each.status is SetStatus.REFUSED:
                assert name in ("PICKY", "BROKEN") or is_disturbed, each
            else:
                assert isinstance(each.error, NoReply), each
        if any(each.status is SetStatus.NOT_TRIED for each in outcomes):
            assert batch.failure is not None

    def give_back(self, operation: Operation[Any]) -> None:
        machine, now = self.session.camera, self.session.now
        if isinstance(operation, ExtWrite):
            machine.ext.writes.cancel(operation, now)
        elif isinstance(operation, ExtWriteBatch):
            machine.ext.batches.end(operation, now)
            self.requested.pop(id(operation), None)
        elif isinstance(operation, ValueRead):
            machine.ext.reads.release(operation)
        else:
            assert isinstance(operation, ExtFetch)
            machine.ext.fetches.end(operation)

    def teardown(self) -> None:
        if hasattr(self, "session"):
            self.everything_ends()
            assert self.session.is_idle


Extended.TestCase.settings = settings(
    max_examples=15,
    stateful_step_count=20,
    derandomize=True,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
TestExtended = Extended.TestCase
