"""ParamMap: what users see of a table."""

from __future__ import annotations

import pytest

from paramclient.params import ParamMap
from paramclient.values import Param, ParamType


def test_it_shows_the_table_as_it_is_now_and_cannot_be_written_to() -> None:
    table = {"B": Param("B", 1, ParamType.INT32, 0, 1)}
    params = ParamMap(table)
    assert repr(params) == "<ParamMap 1 param>"
    table["A"] = Param("A", 2, ParamType.INT32, 1, 2)
    assert list(params) == ["B", "A"]
    assert params == table
    assert params["A"] is table["A"]
    assert "A" in params
    assert "C" not in params
    assert params.get("C") is None
    assert len(params) == 2
    assert repr(params) == "<ParamMap 2 params>"
    with pytest.raises(KeyError):
        params["C"]
    with pytest.raises(TypeError):
        params["C"] = table["A"]  # type: ignore[index]  # that it is refused is the point
    with pytest.raises(AttributeError):
        params.anything = 1  # type: ignore[attr-defined]  # as above
