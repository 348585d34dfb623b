"""What was begun ends once."""

from __future__ import annotations

import math

from paramclient.errors import NoReply
from paramclient.protocol.requests.operation import Operation


def test_an_operation_ends_with_a_result() -> None:
    operation = Operation[int](1.0)
    reported: list[str] = []
    operation.on_done += [lambda: reported.append("first"), lambda: reported.append("second")]
    assert (operation.begun_at, operation.ended_at, operation.done) == (1.0, math.inf, False)
    operation.finish(5, 2.0)
    assert (operation.done, operation.result, operation.error, operation.ended_at) == (True, 5, None, 2.0)
    assert reported == ["first", "second"]


def test_the_first_end_counts() -> None:
    error = NoReply("x", attempts=1, waited=1.0)
    operation = Operation[int](1.0)
    reported: list[bool] = []
    operation.on_done.append(lambda: reported.append(operation.done))
    operation.on_done.append(lambda: operation.finish(7, 3.0))
    operation.fail(error, 2.0)
    operation.fail(NoReply("y", attempts=1, waited=1.0), 4.0)
    operation.finish(5, 4.0)
    assert (operation.result, operation.error, operation.ended_at) == (None, error, 2.0)
    assert reported == [True]
