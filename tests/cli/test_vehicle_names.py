"""Names of vehicles in the cache: which vehicle each name finds, in every subcommand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from paramclient import AmbiguousVehicle, ParamCache, UnknownVehicle
from paramclient.cache import CachedVehicle, TableState
from paramclient.cache.lookup import find_vehicle, is_vehicle_name
from paramclient.model.identity import Identity
from paramclient.sim import PX4Vehicle
from tests.caches import NOW, PX4, stored, update
from tests.commands import Command, Put

FOUR = "4a00000000000011"
"""The hardware id of system 3: it begins with the number of another system."""
DIGITS = "0000000000000004"
"""A hardware id of which every digit is decimal, and whose number could be a system id."""
LONG = f"{FOUR}00112233445566778899"
SHARED = "4954414c44494e4f"
"""The hardware id that every simulated PX4 has."""


def known(system: int, uid: str | None, components: tuple[int, ...] = (1,)) -> CachedVehicle:
    identity = Identity(system, "udpin:0.0.0.0:14550", uid, 12, 2)
    return CachedVehicle(identity.key, identity, NOW, NOW, components)


KEPT = [
    known(3, FOUR, (1, 154)),
    known(200, DIGITS),
    known(7, LONG),
    known(1, SHARED),
    known(12, SHARED),
    known(5, None),
    known(1, "beef000000000001"),
]


FOUND = {
    0: ["3", "003", FOUR, FOUR.upper(), f"uid:{FOUR}", f"UID:{FOUR.upper()}"],
    1: ["200", DIGITS, f"uid:{DIGITS}", "uid:000000"],
    2: [LONG, f"uid:{LONG[:20]}"],
    3: [f"{SHARED}/1"],
    4: [f"uid:{SHARED}/12", "uid:495441/12"],
    5: ["5", "system:5@udpin:0.0.0.0:14550"],
    6: ["uid:beef00"],
}
"""Names of each vehicle of KEPT."""
UNKNOWN = {
    "no vehicle has system id 4": ["4"],
    "system ids are 1 to 255": ["000", "256"],
    "neither a system id nor a hardware id in full": ["0000", "0000000003", "4a0000", FOUR[:-1]],
    "a hardware id has hexadecimal digits": ["uid:", "uid:quad"],
    "at least 6 digits": ["uid:4", "uid:4a000"],
    "is not in the cache here. The cache holds": [
        *("uid:4a0001", f"uid:{FOUR}/3", f"uid:{SHARED}/2", f"{FOUR} ", "\u0663", ""),
        *("system:5", "SYSTEM:5@udpin:0.0.0.0:14550"),
    ],
}
AMBIGUOUS = {"1": [3, 6], f"uid:{SHARED}": [3, 4], SHARED: [3, 4], "uid:4a0000": [0, 2]}


@pytest.mark.parametrize(("place", "name"), [(at, name) for at, names in FOUND.items() for name in names])
def test_a_name_finds_one_vehicle(place: int, name: str) -> None:
    assert find_vehicle(KEPT, name, place="here") is KEPT[place]
    assert is_vehicle_name(name)


@pytest.mark.parametrize(
    ("name", "reason", "listed"),
    [
        *((name, why, range(len(KEPT))) for why, names in UNKNOWN.items() for name in names),
        *(
            (name, f"vehicle {name} fits 2 vehicles in the cache here:", fits)
            for name, fits in AMBIGUOUS.items()
        ),
    ],
)
def test_unknown_and_ambiguous_names_list_the_vehicles(name: str, reason: str, listed: Sequence[int]) -> None:
    with pytest.raises((UnknownVehicle, AmbiguousVehicle)) as caught:
        find_vehicle(KEPT, name, place="here")
    assert isinstance(caught.value, AmbiguousVehicle if name in AMBIGUOUS else UnknownVehicle)
    assert reason in str(caught.value)
    assert caught.value.vehicles == tuple(str(KEPT[each]) for each in listed)
    assert all(f"\n  {KEPT[each]}" in str(caught.value) for each in listed)


def test_a_system_id_means_the_vehicle_with_the_autopilot_and_not_its_camera() -> None:
    identity = replace(known(3, "ca3e0003").identity, autopilot=8)
    camera = CachedVehicle("uid:ca3e0003", identity, NOW, NOW, (100,))
    kept = [camera, *KEPT]
    assert find_vehicle(kept, "3", place="here") is KEPT[0]
    assert find_vehicle(kept, "3", place="here", component=100) is camera
    assert find_vehicle(kept, "3/100", place="here") is camera
    assert find_vehicle([camera], "3", place="here") is camera
    with pytest.raises(AmbiguousVehicle, match="fits 2 vehicles"):
        find_vehicle([camera, replace(camera, key="uid:ca3e0004")], "3", place="here")


# All subcommands that take a vehicle in the cache


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    """A cache in which the hardware id of system 3 begins with 4, and two vehicles have system id 9."""
    path = tmp_path / "cache.sqlite3"
    whole = TableState(count=1, complete=True)
    with ParamCache(path) as kept:
        for system, uid in ((3, FOUR), (9, "c100000000000000"), (9, "c200000000000000")):
            identity = replace(PX4, system=system, uid=uid)
            kept.save(update(stored("MC_ROLL_P", 7, index=0), identity=identity, table=whole))
    return path


URL = "udpin:127.0.0.1:1"
COMMANDS = [
    ["show", "NAME"],
    ["history", "NAME"],
    ["history", "NAME", "--snapshots"],
    ["cache", "remove", "NAME"],
    ["save", "NAME", "FILE"],
    ["save", "NAME", "FILE", "--vehicle", "all"],
    ["diff", "3", "3", "--base", "NAME"],
    ["diff", URL, "NAME"],
    ["apply", URL, "NAME", "--yes"],
    ["apply", URL, "NAME", "--vehicle", "all", "--yes"],
]
"""With NAME for the vehicle, and FILE for a file that is not there."""


@pytest.mark.parametrize("name", ["4", "4a000000", "cache:9", "uid:c0ffee"])
@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_no_subcommand_guesses_a_vehicle(
    command: Command, put: Put, cache: Path, tmp_path: Path, words: list[str], name: str
) -> None:
    put(vehicle := PX4Vehicle(table={"MC_ROLL_P": 4.0}))
    file = tmp_path / "quad.param"
    done = command(*({"NAME": name, "FILE": str(file)}.get(word, word) for word in words))
    assert (done.code, done.out) == (2, "")
    several = name.endswith("9")
    wanted = f"vehicle {name.removeprefix('cache:')}"
    assert f"paramclient: {wanted} {'fits 2 vehicles' if several else 'is not'} in the cache" in done.err
    for each in ParamCache(cache).vehicles():
        assert (f"\n  {each}\n" in done.err) == (not several or each.identity.system == 9)
    assert not file.exists()
    assert len(ParamCache(cache).components()) == 3, "nothing is removed"
    assert not vehicle.requests, "nothing is sent"


@pytest.mark.parametrize("name", ["3", "uid:4a0000", f"cache:{FOUR}"])
@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_every_subcommand_accepts_each_kind_of_name(
    command: Command, put: Put, cache: Path, tmp_path: Path, words: list[str], name: str
) -> None:
    put(PX4Vehicle(table={"MC_ROLL_P": 4.0}))
    done = command(*({"NAME": name, "FILE": str(tmp_path / "quad.param")}.get(word, word) for word in words))
    assert done.code in (0, 1), done.err
    assert (words[:2] == ["cache", "remove"]) == (len(ParamCache(cache).components()) == 2)
