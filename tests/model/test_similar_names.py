"""Suggestions for names that nothing has: in mappings, selections and sentences."""

from __future__ import annotations

import difflib

import pytest

from paramclient.model.params import ParamMap
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.patterns import NameChoice
from paramclient.model.similar_names import COMPARED_NAMES_MAX, did_you_mean, nearest_names
from tests.simulation import known

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


@pytest.mark.parametrize(
    "name", ["MISSION_0123_YP", "MISSION_0123X_P", "MISSIO_0123_P", "mission_0123_p", "MISSIONX"]
)
def test_of_many_alike_names_few_are_compared(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    compared = 0

    class Counted(difflib.SequenceMatcher[str]):
        def real_quick_ratio(self) -> float:
            nonlocal compared
            compared += 1
            return super().real_quick_ratio()

    monkeypatch.setattr(difflib, "SequenceMatcher", Counted)
    names = [f"MISSION_{number:04}_P" for number in range(10_000)]
    found = nearest_names(name, names)
    assert 0 < compared <= COMPARED_NAMES_MAX
    assert found[:1] == (("MISSION_0123_P",) if "0123" in name else ())


def test_suggestions_are_a_sentence() -> None:
    assert did_you_mean(()) == ""
    assert did_you_mean(["A"]) == " Did you mean A?"
    assert did_you_mean(["A", "B", "C"]) == " Did you mean A, B or C?"


def test_a_mapping_suggests_names() -> None:
    table = ParamMap({name: known(name, 1.0) for name in NAMES})
    file = ParamSet({name: WrittenParam(name, 1.0) for name in NAMES})
    for each in (table, file):
        with pytest.raises(KeyError, match=r"no parameter MC_ROLLP\. Did you mean MC_ROLL_P\?"):
            each["MC_ROLLP"]
        among = f" among the {len(NAMES)} known ones" if each is table else ""
        with pytest.raises(KeyError, match=f"no parameter BATTERY{among}'"):
            each["BATTERY"]
        assert each.get("MC_ROLLP") is None
        assert each.get("MC_ROLLP", 3) == 3
        assert each["MC_ROLL_P"] is each.get("MC_ROLL_P")
        assert "MC_ROLLP" not in each


def test_upper_and_lower_case_do_not_matter_in_a_selection() -> None:
    choice = NameChoice(["mc_yaw*", "Mpc_xy_p", "ringbuffer"])
    assert choice.choose(NAMES) == ({"MC_YAWRATE_P", "MC_YAW_P", "MPC_XY_P", "ringBuffer"}, "")
    assert choice.has("mc_yaw_p")
    assert choice.has("MPC_XY_P")
    assert not choice.has("MC_ROLL_P")


def test_unmatched_names_are_listed_with_suggestions() -> None:
    chosen, unmatched = NameChoice(["MC_ROLLP", "BAT*", "MC_YAW_P"]).choose(NAMES)
    assert chosen == {"MC_YAW_P"}
    assert unmatched == "MC_ROLLP (did you mean MC_ROLL_P?) or BAT*"
