"""Identity: AUTOPILOT_VERSION of recorded vehicles, and cache keys."""

from __future__ import annotations

from dataclasses import replace

import pytest

from paramclient.model.identity import PX4_SITL_UID, Identity, hardware_id, is_sitl_uid
from tests.recordings import identity_in


def test_px4_git_hash_is_a_number_and_simulators_share_a_hardware_id() -> None:
    identity = identity_in("px4_full_download", 12)
    assert identity == Identity(
        system=1,
        link="udpin:0.0.0.0:14550",
        uid="4954414c44494e4f",
        autopilot=12,
        vehicle_type=2,
        firmware=0x01110040,
        git_hash="a70a558393000000",
        board=1,
        capabilities=59647,
    )
    assert identity.key == "uid:4954414c44494e4f/1"


def test_ardupilot_git_hash_is_text_and_uid2_is_the_hardware_id() -> None:
    identity = identity_in("ardupilot_full_download", 3)
    assert identity.git_hash == "fbb78585"
    assert identity.uid == "336431323139633763346335343034616100"
    assert identity.key == "uid:336431323139633763346335343034616100"


def test_key_is_the_hardware_id_or_else_system_and_link() -> None:
    with_id = Identity(1, "udpin:a", uid="abcd")
    assert replace(with_id, system=9, link="tcp:b").key == with_id.key
    without = Identity(1, "udpin:a")
    assert len({without.key, replace(without, system=2).key, replace(without, link="udpin:b").key}) == 3


def test_same_hardware_id_is_the_same_vehicle() -> None:
    mine = Identity(1, "udp", uid="0a", autopilot=3, vehicle_type=2)
    assert mine.is_same_vehicle(replace(mine, system=9, link="tcp", vehicle_type=1))
    assert not mine.is_same_vehicle(replace(mine, uid="0b"))
    assert not mine.is_same_vehicle(replace(mine, uid=None))
    assert mine.has_own_uid


@pytest.mark.parametrize("uid", [None, PX4_SITL_UID])
def test_without_a_unique_hardware_id_link_and_types_are_compared(uid: str | None) -> None:
    mine = Identity(1, "udp", uid=uid, autopilot=3, vehicle_type=2)
    assert mine.is_same_vehicle(replace(mine, system=9))
    for other in ({"link": "tcp"}, {"autopilot": 12}, {"vehicle_type": 1}):
        assert not mine.is_same_vehicle(replace(mine, **other))
    # A vehicle without a known hardware id may send it only later.
    assert mine.is_same_vehicle(replace(mine, uid="0a")) is (uid is None)
    assert not mine.has_own_uid


def test_a_hardware_id_of_px4_sitl_follows_the_system_id() -> None:
    """Measured: with system id 7, uid is 0x4954414c44494e4f + 6, and uid2 is 06 and zeros."""

    def sitl(system: int) -> Identity:
        uid2 = bytes([system - 1, *bytes(17)])
        uid = int(PX4_SITL_UID, 16) + system - 1
        return Identity(system, "udp", hardware_id(uid, uid2), autopilot=12, vehicle_type=2)

    first, second = sitl(1), sitl(7)
    assert (first.uid, second.uid) == (PX4_SITL_UID, "06" + "00" * 17)
    assert not first.has_own_uid
    assert not second.has_own_uid
    assert first.is_same_vehicle(second)
    assert second.is_same_vehicle(first)
    assert not second.is_same_vehicle(replace(first, link="tcp"))
    assert not second.is_same_vehicle(replace(first, uid="000200000000333138330001"))
    assert (first.key, second.key) == (f"uid:{PX4_SITL_UID}/1", "uid:06" + "00" * 17)
    assert is_sitl_uid(f"{int(PX4_SITL_UID, 16) + 6:x}")
    for hardware in (None, "0a", "0002000000003331383300012345678901bc"):
        assert not is_sitl_uid(hardware)
