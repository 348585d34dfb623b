"""Runs each asynchronous test of the service in simulated time, unless it is marked for a real event loop."""

from __future__ import annotations

from inspect import iscoroutinefunction
from pathlib import Path

import pytest

from tests.shell import in_simulated_time


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    functions = [each for each in items if isinstance(each, pytest.Function)]
    for each in functions:
        is_here = each.path.parent == Path(__file__).parent
        if is_here and iscoroutinefunction(each.obj) and each.get_closest_marker("asyncio") is None:
            each.obj = in_simulated_time(each.obj)
