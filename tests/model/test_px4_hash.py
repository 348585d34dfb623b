"""PX4's hash, and which parameters a vehicle excludes from it."""

from __future__ import annotations

from collections.abc import Iterable

import pytest

from paramclient.model.px4_hash import crc32_px4, find_volatile, hash_bits
from paramclient.model.values import Param
from paramclient.sim import px4_table

REAL = tuple(Param(row.name, row.value, row.type, at, row.bits) for at, row in enumerate(px4_table()))
VOLATILE = frozenset(row.name for row in px4_table() if row.volatile)


def announced(params: Iterable[Param], volatile: Iterable[str]) -> int:
    return hash_bits({each.name: each.bits for each in params}, leave_out=volatile)


def found(
    params: Iterable[Param], announced: int, *, believed: Iterable[str] = ()
) -> tuple[frozenset[str], bool]:
    return find_volatile({param.name: param.bits for param in params}, announced, believed=believed)


def test_a_real_vehicle() -> None:
    assert len(VOLATILE) == 58
    assert found(REAL, announced(REAL, VOLATILE)) == (VOLATILE, True)


@pytest.mark.parametrize("groups", [["CAL_ACC"], ["LND_FLIGHT_T_"], ["EKF2_MAG_DECL", "SENS_DPRES_OFF"]])
def test_a_firmware_that_counts_in_one_or_two_of_the_usual_groups(groups: list[str]) -> None:
    counted = {param.name for param in REAL if param.name.startswith(tuple(groups))}
    assert counted & VOLATILE
    assert found(REAL, announced(REAL, VOLATILE - counted)) == (VOLATILE - counted, True)


def test_names_proved_by_an_earlier_session_are_tried_first() -> None:
    strange = frozenset({"SYS_AUTOSTART", "MPC_XY_P", "BAT1_N_CELLS"})
    right = announced(REAL, strange)
    assert found(REAL, right)[1] is False
    assert found(REAL, right, believed=[*strange, "NO_LONGER_THERE"]) == (strange, True)


def test_without_agreement_the_best_guess() -> None:
    assert found(REAL, 0x12345678) == (VOLATILE, False)
    assert found(REAL, 0x12345678, believed=["MPC_XY_P"]) == (VOLATILE | {"MPC_XY_P"}, False)


@pytest.mark.parametrize(
    ("data", "crc"),
    [
        (b"", 0),
        (b"A", 0x01DB7106),
        (b"123456789", 0x2DFD2D88),
        (b"SYS_AUTOSTART" + (4001).to_bytes(4, "little"), 0x8B5000C6),
    ],
)
def test_crc_vectors(data: bytes, crc: int) -> None:
    assert crc32_px4(data) == crc
