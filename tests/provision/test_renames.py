"""Files whose names the firmware of the vehicle has changed: plans, `apply`, versions."""

from __future__ import annotations

from collections.abc import Mapping

import pytest

from paramclient import ParamSet, ParamType, UsageError, WrittenParam
from paramclient.model.identity import Identity
from paramclient.model.renames import Rename, Renames
from paramclient.model.values import Encoding, Param, WireValue, bits_of
from paramclient.provision import (
    MISSING,
    WRONG,
    ApplyStatus,
    apply,
    plan,
    plan_from,
)
from paramclient.sim import ArduPilotVehicle, PX4Vehicle, SimParam
from tests.shell import a_client, in_simulated_time

RENAMES = Renames(
    [
        Rename("WPNAV_SPEED", "WP_SPD", 0.01),
        Rename("RTL_ALT", "RTL_ALT_M", 0.01),
        Rename("EK1_TYPE", "EK2_GPS_TYPE"),
        Rename("EK1_ENABLE", "EK2_ENABLE"),
        Rename("INS_OLD", "INS_ACCOFFS_X"),
        Rename("SYSID_THISMAV", "MAV_SYSID"),
    ],
    "names.json",
)
TABLE: dict[str, WireValue | tuple[ParamType, WireValue]] = {
    "WP_SPD": 10.0,
    "RTL_ALT_M": (ParamType.INT16, 15),
    "INS_ACCOFFS_X": 0.5,
    "EK2_ENABLE": (ParamType.INT8, 0),
    "OTHER": 1.0,
}
GROUP: dict[str, WireValue | tuple[ParamType, WireValue]] = {"EK2_GPS_TYPE": (ParamType.INT8, 0)}
NOT_HERE = "in names.json, which this vehicle does not have either"


def written(values: Mapping[str, WireValue], identity: Identity | None = None) -> ParamSet:
    params = {name: WrittenParam(name, value) for name, value in values.items()}
    return ParamSet(params, identity=identity, source="a file")


def held(**values: WireValue | tuple[ParamType, WireValue]) -> dict[str, Param]:
    """Return a vehicle's table; an entry without a type is a REAL32."""
    table: dict[str, Param] = {}
    for name, entry in values.items():
        kind, value = entry if isinstance(entry, tuple) else (ParamType.REAL32, entry)
        table[name] = Param(name, value, kind, len(table), bits_of(value, kind))
    return table


def copter() -> ArduPilotVehicle:
    return ArduPilotVehicle(table=TABLE, groups={"EK2_ENABLE": GROUP}, live=())


# Plans


def test_a_renamed_parameter_is_planned_under_the_name_of_the_vehicle() -> None:
    made = plan_from(held(**TABLE), written({"WPNAV_SPEED": 750, "RTL_ALT": 1500}), renames=RENAMES)
    (row,) = made.to_write
    assert (row.target.name, row.target.value, row.before, row.name) == ("WP_SPD", 7.5, 10.0, "WPNAV_SPEED")
    row = made.rows["WPNAV_SPEED"]
    assert (row.status, row.wanted.value, row.target.value) == (ApplyStatus.SET, 750, 7.5)
    assert str(row) == "WPNAV_SPEED (here WP_SPD) 10.0 -> 7.5, set"
    assert made.rows["RTL_ALT"].status is ApplyStatus.UNCHANGED
    assert str(made.rows["RTL_ALT"]) == "RTL_ALT (here RTL_ALT_M) = 15, unchanged"
    assert made.extra == ("INS_ACCOFFS_X", "EK2_ENABLE", "OTHER")
    assert not row.is_as_wanted
    assert made.rows["RTL_ALT"].is_as_wanted


def test_a_name_that_the_vehicle_has_is_not_touched() -> None:
    made = plan_from(held(WPNAV_SPEED=5.0, WP_SPD=10.0), written({"WPNAV_SPEED": 750}), renames=RENAMES)
    assert [(row.target.name, row.target.value) for row in made.to_write] == [("WPNAV_SPEED", 750)]
    assert made.rows["WPNAV_SPEED"].renamed is None


def test_two_wanted_names_of_one_parameter_are_an_error() -> None:
    with pytest.raises(UsageError, match="WP_SPD and WPNAV_SPEED of a file are both WP_SPD by names"):
        plan_from(held(**TABLE), written({"WPNAV_SPEED": 750, "WP_SPD": 7.5}), renames=RENAMES)


def test_a_converted_value_that_is_not_whole_is_invalid_for_an_integer() -> None:
    made = plan_from(held(**TABLE), written({"RTL_ALT": 1550}), renames=RENAMES, encoding=Encoding.C_CAST)
    row = made.rows["RTL_ALT"]
    assert (row.status, row.category) == (ApplyStatus.INVALID, WRONG)
    assert row.reason == "as RTL_ALT_M, 15.5 is not a whole number, and the parameter is INT16"


def test_a_missing_parameter_names_its_other_name() -> None:
    made = plan_from(held(OTHER=1.0), written({"WPNAV_SPEED": 750, "WP_X": 1}), renames=RENAMES)
    row = made.rows["WPNAV_SPEED"]
    assert (row.status, row.category) == (ApplyStatus.SKIPPED, MISSING)
    assert row.reason == f"not on this vehicle; renamed to WP_SPD {NOT_HERE}"
    assert made.rows["WP_X"].reason == "not on this vehicle"
    made = plan_from(held(OTHER=1.0), written({"WP_SPD": 7.5}), renames=RENAMES)
    assert made.rows["WP_SPD"].reason == f"not on this vehicle; renamed from WPNAV_SPEED {NOT_HERE}"


def test_a_parameter_is_left_out_by_either_of_its_names() -> None:
    wanted = written({"INS_OLD": 0.25})
    made = plan_from(held(**TABLE), wanted, renames=RENAMES, autopilot="ardupilot")
    assert (made.rows["INS_OLD"].status, made.rows["INS_OLD"].category) == (
        ApplyStatus.SKIPPED,
        "calibration",
    )
    for include in ("INS_OLD", "INS_ACCOFFS_X", "calibration"):
        made = plan_from(held(**TABLE), wanted, renames=RENAMES, autopilot="ardupilot", include=include)
        assert [row.target.name for row in made.to_write] == ["INS_ACCOFFS_X"]
    back = plan_from(
        held(INS_OLD=0.5), written({"INS_ACCOFFS_X": 0.25}), renames=RENAMES, autopilot="ardupilot"
    )
    assert back.rows["INS_ACCOFFS_X"].category == "calibration"


# Firmware versions


def at(firmware: int, autopilot: int = 3) -> Identity:
    return Identity(1, "udp", "aa00", autopilot, firmware=firmware)


@pytest.mark.parametrize(
    ("file", "vehicle", "note"),
    [
        (at(0x040507FF), at(0x040600FF), "the file is of ArduPilot 4.5.7, the vehicle has 4.6.0"),
        (at(0x040600FF), at(0x04060000), "the file is of ArduPilot 4.6.0, the vehicle has 4.6.0-dev"),
        (at(0x01100080, 12), at(0x011000FF, 12), "the file is of PX4 1.16.0-beta, the vehicle has 1.16.0"),
        (at(0x01000000, 0), at(0x02000000, 0), "the file is of version 1.0.0-dev, the vehicle has 2.0.0-dev"),
        (at(0x040600FF), at(0x040600FF), ""),
        (at(0), at(0x040600FF), ""),
        (at(0x040600FF), at(0), ""),
        (None, at(0x040600FF), ""),
    ],
)
def test_a_plan_names_firmware_versions_that_differ(
    file: Identity | None, vehicle: Identity, note: str
) -> None:
    assert plan_from(written({"A": 1}, vehicle), written({"A": 1}, file)).firmware_note == note


# Vehicles


@in_simulated_time
async def test_apply_writes_and_verifies_under_the_name_of_the_vehicle() -> None:
    vehicle = copter()
    wanted = written({"WPNAV_SPEED": 750, "RTL_ALT": 2500, "OTHER": 2, "NO_SUCH": 1})
    async with a_client(vehicle) as client:
        component = await client.component()
        assert not (await plan(component, wanted, renames=RENAMES)).complete
        result = await apply(component, wanted, renames=RENAMES, partial=True)
        assert {name: (row.status, row.before, row.actual) for name, row in result.rows.items()} == {
            "WPNAV_SPEED": (ApplyStatus.ACCEPTED, 10.0, 7.5),
            "RTL_ALT": (ApplyStatus.ACCEPTED, 15, 25),
            "OTHER": (ApplyStatus.ACCEPTED, 1.0, 2.0),
            "NO_SUCH": (ApplyStatus.SKIPPED, None, None),
        }
        assert str(result.rows["RTL_ALT"]) == "RTL_ALT (here RTL_ALT_M) 15 -> 25, accepted"
        assert "WP_SPD" not in result.extra
        again = await apply(component, wanted.only(["WPNAV_SPEED", "RTL_ALT"]), renames=RENAMES)
        assert again.complete
        assert {row.status for row in again.rows.values()} == {ApplyStatus.UNCHANGED}
        without = await plan(component, wanted)
        assert without.rows["WPNAV_SPEED"].reason == "not on this vehicle"
    assert vehicle.values["WP_SPD"] == 7.5
    assert vehicle.values["RTL_ALT_M"] == 25


@in_simulated_time
async def test_names_are_looked_up_again_after_a_stage_that_reveals_parameters() -> None:
    vehicle = copter()
    wanted = written({"EK1_ENABLE": 1, "EK1_TYPE": 3})
    async with a_client(vehicle) as client:
        component = await client.component()
        made = await plan(component, wanted, renames=RENAMES)
        result = await apply(component, wanted, renames=RENAMES)
        assert result.complete
        assert {row.status for row in result.rows.values()} == {ApplyStatus.ACCEPTED}
        row = result.rows["EK1_TYPE"]
        assert row.renamed is not None
        assert (row.renamed.name, row.actual) == ("EK2_GPS_TYPE", 3)
        assert made.rows["EK1_ENABLE"].target.name == "EK2_ENABLE"
    assert vehicle.values["EK2_GPS_TYPE"] == 3


@in_simulated_time
async def test_the_other_name_is_read_although_the_vehicle_does_not_list_it() -> None:
    """PX4 lists no parameters that it does not use yet, and takes them by name."""
    rows = [SimParam(name, ParamType.INT32, 1) for name in ("LISTED", "NEW_NAME")]
    vehicle = PX4Vehicle(table=rows, not_in_use=["NEW_NAME"])
    renames = Renames([Rename("OLD_NAME", "NEW_NAME")])
    async with a_client(vehicle) as client:
        component = await client.component()
        made = await plan(component, written({"OLD_NAME": 2}), renames=renames)
        assert [(row.target.name, row.target.value) for row in made.to_write] == [("NEW_NAME", 2)]
