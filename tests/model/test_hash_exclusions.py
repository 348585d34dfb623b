"""Which parameters a PX4 vehicle leaves out of its hash."""

from __future__ import annotations

from collections.abc import Iterable

import pytest

from paramclient.model import hash_exclusions
from paramclient.model.hash_exclusions import find_volatile
from paramclient.model.values import Param, px4_hash
from paramclient.sim import px4_table
from tests.simulation import known

REAL = tuple(Param(row.name, row.value, row.type, at, row.bits) for at, row in enumerate(px4_table()))
VOLATILE = frozenset(row.name for row in px4_table() if row.volatile)


def announced(params: Iterable[Param], volatile: Iterable[str]) -> int:
    return px4_hash(params, leave_out=volatile)


def found(
    params: Iterable[Param], announced: int, *, believed: Iterable[str] = ()
) -> tuple[frozenset[str], bool]:
    return find_volatile({param.name: param.bits for param in params}, announced, believed=believed)


def names_of(group: str) -> set[str]:
    return {param.name for param in REAL if param.name.startswith(group)}


def test_a_real_vehicle() -> None:
    assert len(VOLATILE) == 58
    assert found(REAL, announced(REAL, VOLATILE)) == (VOLATILE, True)


def test_a_firmware_that_leaves_nothing_out() -> None:
    assert found(REAL, announced(REAL, ())) == (frozenset(), True)


@pytest.mark.parametrize("groups", [["CAL_ACC"], ["LND_FLIGHT_T_"], ["EKF2_MAG_DECL", "SENS_DPRES_OFF"]])
def test_a_firmware_that_counts_in_one_or_two_of_the_usual_groups(groups: list[str]) -> None:
    counted = set().union(*map(names_of, groups))
    assert counted & VOLATILE
    assert found(REAL, announced(REAL, VOLATILE - counted)) == (VOLATILE - counted, True)


@pytest.mark.parametrize("name", ["SYS_AUTOSTART", "CAL_GYRO0_XOFF"])
def test_a_firmware_with_one_more_or_one_less(name: str) -> None:
    expected = VOLATILE ^ {name}
    assert found(REAL, announced(REAL, expected)) == (expected, True)


def test_what_an_earlier_session_proved_is_tried_first() -> None:
    strange = frozenset({"SYS_AUTOSTART", "MPC_XY_P", "BAT1_N_CELLS"})
    right = announced(REAL, strange)
    assert found(REAL, right)[1] is False
    assert found(REAL, right, believed=[*strange, "NO_LONGER_THERE"]) == (strange, True)


def test_what_is_believed_may_be_on_top_of_the_usual() -> None:
    expected = VOLATILE | {"SYS_AUTOSTART", "MPC_XY_P"}
    assert found(REAL, announced(REAL, expected), believed=["SYS_AUTOSTART", "MPC_XY_P"]) == (
        expected,
        True,
    )


def test_without_agreement_the_best_guess() -> None:
    assert found(REAL, 0x12345678) == (VOLATILE, False)
    assert found(REAL, 0x12345678, believed=["MPC_XY_P"]) == (VOLATILE | {"MPC_XY_P"}, False)


def test_an_empty_table() -> None:
    assert found((), 0) == (frozenset(), True)
    assert found((), 5) == (frozenset(), False)


def test_the_search_does_not_grow_with_the_square_of_the_table(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hash_exclusions, "HASHED_PARAMETERS_MAX", 100)
    table = [known(f"N{number:02d}", number, index=number) for number in range(20)]
    assert found(table, announced(table, ["N04"])) == (frozenset({"N04"}), True)
    assert found(table, announced(table, ["N05"])) == (frozenset(), False)
