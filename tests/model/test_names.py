"""Suggestions for names that nothing has."""

from __future__ import annotations

import pytest

from paramclient.model.names import nearest_names

NAMES = ["MC_YAWRATE_P", "MC_YAW_P", "MC_ROLL_P", "MC_ROLLRATE_P", "MPC_XY_P", "ringBuffer"]


@pytest.mark.parametrize(
    ("name", "nearest"),
    [
        ("mc_yaw_p", "MC_YAW_P"),
        ("MC_ROLLP", "MC_ROLL_P"),
        ("Mc_Rol_P", "MC_ROLL_P"),
        ("RINGBUFFER", "ringBuffer"),
    ],
)
def test_the_nearest_name_is_the_first_one(name: str, nearest: str) -> None:
    assert nearest_names(name, NAMES)[0] == nearest
    assert nearest_names(name, reversed(NAMES))[0] == nearest


def test_a_name_is_not_suggested_for_itself_and_nothing_for_an_unlike_one() -> None:
    assert "MC_YAW_P" not in nearest_names("MC_YAW_P", NAMES)
    assert nearest_names("BATTERY", NAMES) == ()
    assert nearest_names("BATTERY", []) == ()
    assert nearest_names("", ["", "A"]) == nearest_names("A", [""]) == ()
