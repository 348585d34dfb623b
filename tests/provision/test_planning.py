"""Plans: values to write, their order, left-out and invalid parameters, similar names."""

from __future__ import annotations

import math
from functools import partial

import pytest

from paramclient.errors import UsageError
from paramclient.metadata import ParamInfo
from paramclient.model.identity import Identity
from paramclient.model.paramset import ParamSet
from paramclient.model.values import Encoding, Param, ParamType, Value, bits_of, from_bits
from paramclient.provision import CATEGORIES, MISSING, WRONG, ApplyStatus, Plan, plan_from
from paramclient.provision.apply_rules import OUT_OF_RANGE, READ_ONLY
from paramclient.sim.param_table import SimParam, ardupilot_table, px4_table

Info = partial(ParamInfo, "NAME")


def held(**values: Value | tuple[ParamType | int, Value]) -> dict[str, Param]:
    """Return a vehicle's table: an int is an INT32, a float a REAL32, other types are given."""
    table: dict[str, Param] = {}
    for name, entry in values.items():
        default = ParamType.REAL32 if isinstance(entry, float) else ParamType.INT32
        kind, value = entry if isinstance(entry, tuple) else (default, entry)
        bits = bits_of(value, kind)
        table[name] = Param(name, from_bits(bits, kind), kind, len(table), bits)
    return table


def written(**values: Value) -> ParamSet:
    return ParamSet(values, source="a file")


def copy_of(table: tuple[SimParam, ...]) -> dict[str, Param]:
    return {
        row.name: Param(row.name, from_bits(row.bits, row.type), row.type, index, row.bits)
        for index, row in enumerate(table)
    }


def order(made: Plan) -> list[list[str]]:
    return [[row.name for row in stage.rows] for stage in made.stages]


def only_row(made: Plan) -> tuple[ApplyStatus, str, str]:
    (row,) = made.rows.values()
    return row.status, row.category, row.reason


def test_every_wanted_parameter_gets_a_status() -> None:
    made = plan_from(
        held(ROLL_P=4.0, PITCH_P=4.0, STAT_RUNTIME=5, COUNT=(ParamType.INT8, 1), OTHER=1),
        written(ROLL_P=4, PITCH_P=6.5, STAT_RUNTIME=6, COUNT=300, PICTH_P=1),
        autopilot="ardupilot",
    )
    assert [str(row) for row in made.rows.values()] == [
        "ROLL_P = 4, unchanged",
        "PITCH_P 4.0 -> 6.5, set",
        "STAT_RUNTIME 5 -> 6, skipped: left out: it is counted by the vehicle itself",
        "COUNT 1 -> 300, refused: 300 does not fit INT8, which holds -128 to 127",
        "PICTH_P = 1, refused: not on this vehicle",
    ]
    (row,) = made.to_write
    assert (row.name, row.wanted.settable, row.type, row.before) == ("PITCH_P", 6.5, ParamType.REAL32, 4.0)
    assert (made.extra, made.complete, set(made.problems)) == (("OTHER",), False, {"COUNT", "PICTH_P"})
    assert repr(made) == "<Plan 1 set, 2 refused, 1 unchanged, 1 skipped in 1 stages>"


def test_a_mistyped_name_gets_the_nearest_names() -> None:
    wanted = written(ATC_RAT_RRL_P=0.1, wpnav_speed=500, NO_SUCH_THING=1)
    made = plan_from(copy_of(ardupilot_table()), wanted, autopilot="ardupilot")
    assert {name: row.nearest[:1] for name, row in made.rows.items()} == {
        "ATC_RAT_RRL_P": ("ATC_RAT_RLL_P",),
        "wpnav_speed": ("WPNAV_SPEED",),
        "NO_SUCH_THING": (),
    }


LEFT_OUT = {
    "ardupilot": {
        "identity": ["SYSID_THISMAV", "MAV_SYSID", "ADSB_ICAO_ID", "NET_MACADDR0"],
        "hardware": ["COMPASS_DEV_ID2", "COMPASS_PRIO1_ID", "INS_ACC2_ID", "INS_GYR_ID", "INS5_GYR_ID"],
        "read-only": ["BARO1_DEVID", "BARO2_GND_PRESS"],
        "calibration": [
            *("COMPASS_OFS2_X", "INS_ACC2OFFS_Y", "AHRS_TRIM_X", "INS4_ACCOFFS_X", "INS_TCAL1_TMAX"),
            "COMPASS_MOTCT",  # says by what the vehicle's COMPASS_MOT_? are multiplied
        ],
        "measured": ["INS_GYROFFS_Z", "INS4_GYR_CALTEMP", "ARSPD_OFFSET", "COMPASS_DEC"],
        "counter": ["STAT_RESET", "MIS_TOTAL"],
    },
    "px4": {
        "identity": ["UXRCE_DDS_KEY", "MAV_SYS_ID"],
        "hardware": ["CAL_MAG0_ID"],
        "calibration": ["ASPD_SCALE_1", "CAL_MAG0_XOFF", "SENS_BOARD_X_OFF"],
        "measured": ["CAL_BARO0_OFF"],
        "counter": ["LND_FLIGHT_T_LO", "_HASH_CHECK"],
    },
}


@pytest.mark.parametrize(
    ("autopilot", "category"), [(each, category) for each, found in LEFT_OUT.items() for category in found]
)
def test_parameters_that_are_no_settings_are_left_out_unless_included(autopilot: str, category: str) -> None:
    for name in LEFT_OUT[autopilot][category]:
        table, wanted = held(**{name: 1}), written(**{name: 2})
        left_out = plan_from(table, wanted, autopilot=autopilot)
        status, kind, reason = only_row(left_out)
        assert (status, kind) == (ApplyStatus.SKIPPED, category)
        assert reason.startswith("left out: it ")
        assert left_out.rows[name].differs
        assert not left_out.stages
        for include in (category, name, name[:5] + "*", (category,)):
            assert order(plan_from(table, wanted, autopilot=autopilot, include=include)) == [[name]]


@pytest.mark.parametrize(
    ("autopilot", "name", "switch", "value"),
    [
        ("ardupilot", "INS_GYR2OFFS_X", "INS_GYR_CAL", 0),
        ("ardupilot", "ARSPD2_OFFSET", "ARSPD2_SKIP_CAL", 2),
        ("ardupilot", "COMPASS_DEC", "COMPASS_AUTODEC", 0),
        ("px4", "CAL_BARO0_OFF", "SENS_BAR_AUTOCAL", 0),
    ],
)
def test_a_measured_value_is_a_calibration_if_the_vehicle_does_not_measure_it(
    autopilot: str, name: str, switch: str, value: int
) -> None:
    def category(held_value: int, **wanted: Value) -> str:
        table = held(**{name: 1, switch: held_value})
        return plan_from(table, written(**{name: 2}, **wanted), autopilot=autopilot).rows[name].category

    assert category(1) == category(value, **{switch: 1}) == "measured"
    assert category(value) == category(1, **{switch: value}) == "calibration"


@pytest.mark.parametrize(
    ("autopilot", "name"),
    [
        *(("ardupilot", "ESC_CALIBRATION"), ("ardupilot", "FORMAT_VERSION")),
        *(("px4", "SYS_BL_UPDATE"), ("px4", "SYS_CAL_GYRO"), ("px4", "SYS_AUTOCONFIG")),
    ],
)
def test_a_parameter_that_makes_the_vehicle_do_something_is_never_written(autopilot: str, name: str) -> None:
    made = plan_from(held(**{name: 1}), written(**{name: 2}), autopilot=autopilot, include=[name, "*"])
    assert only_row(made)[:2] == (ApplyStatus.SKIPPED, "action")
    assert not made.problems
    with pytest.raises(UsageError, match="'action' cannot be included"):
        plan_from(held(A=1), written(A=2), include="action")


@pytest.mark.parametrize("include", ["compass", "Calibration", "", ["calibration", "ofs*"]])
def test_include_takes_categories_and_globs(include: str | list[str]) -> None:
    with pytest.raises(UsageError, match=r"neither a glob of parameter names.*identity, hardware"):
        plan_from(held(A=1), written(A=2), include=include)


RAW = b"\x01\x02\x03\x04"
BYTEWISE, C_CAST = Encoding.BYTEWISE, Encoding.C_CAST


@pytest.mark.parametrize(
    ("name", "kind", "value", "encoding", "says"),
    [
        ("P", ParamType.INT8, 128, BYTEWISE, "128 does not fit INT8, which holds -128 to 127"),
        ("P", ParamType.INT8, 1.5, BYTEWISE, "1.5 is not a whole number, and the parameter is INT8"),
        ("P", ParamType.INT8, 1.5, C_CAST, "1.5 is not a whole number, and the parameter is INT8"),
        ("P", ParamType.REAL32, 1e39, BYTEWISE, "beyond the range of a float32"),
        ("P", ParamType.INT32, 16777217, C_CAST, "the nearest is 16777216"),
        ("P", ParamType.REAL32, math.nan, C_CAST, "ArduPilot ignores NaN"),
        ("P", ParamType.INT32, RAW, BYTEWISE, "0x04030201 are raw bytes, and the vehicle has a number"),
        *(
            ("MAV_SYS_ID", ParamType.INT32, value, BYTEWISE, "a system id is a number from 1 to 255")
            for value in (0, 256, b"abcd")
        ),
    ],
)
def test_a_value_that_the_parameter_cannot_take_is_invalid(
    name: str, kind: ParamType, value: Value, encoding: Encoding, says: str
) -> None:
    table = held(**{name: (kind, 1)})
    made = plan_from(table, written(**{name: value}), encoding=encoding, include=CATEGORIES)
    status, category, reason = only_row(made)
    assert (status, category) == (ApplyStatus.REFUSED, WRONG)
    assert says in reason
    assert not made.stages


def test_plain_values_are_a_table_and_an_unknown_option_is_an_error() -> None:
    assert plan_from({"A": 1}, {"A": 2}).rows["A"].before == 1
    with pytest.raises(TypeError, match="no option 'inclde'; see PlanOptions"):
        plan_from({"A": 1}, {"A": 2}, inclde="identity")  # type: ignore[call-arg]


def test_a_value_outside_of_the_metadata_range_is_invalid() -> None:
    table = held(P=1.0, Q=7.0)
    info = {"P": Info(minimum=0.1, maximum=2.0), "Q": Info(maximum=2.0)}
    for value, says in ((0.05, "0.05 is below the minimum of 0.1"), (2.5, "2.5 is above the maximum of 2")):
        status, category, reason = only_row(plan_from(table, written(P=value), info=info))
        assert (status, category, says in reason) == (ApplyStatus.REFUSED, OUT_OF_RANGE, True)
        assert plan_from(table, written(P=value), info=info, include=OUT_OF_RANGE).to_write
        assert plan_from(table, written(P=value), info=info, force=True).to_write
        assert plan_from(table, written(P=value)).to_write
    for value in (0.1, 2, 0.10000000149011612):
        assert plan_from(table, written(P=value), info=info).to_write
    # what the vehicle has already is no mistake of the file
    assert only_row(plan_from(table, written(Q=7), info=info))[0] is ApplyStatus.UNCHANGED


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(("autopilot", "says"), [("px4", "may stop"), ("ardupilot", "does not answer")])
def test_a_value_that_autopilots_cannot_store_must_be_forced(value: float, autopilot: str, says: str) -> None:
    table, wanted = held(P=1.0), written(P=value)
    status, category, reason = only_row(plan_from(table, wanted, autopilot=autopilot, include=OUT_OF_RANGE))
    assert (status, category) == (ApplyStatus.REFUSED, WRONG)
    assert says in reason
    assert order(plan_from(table, wanted, autopilot=autopilot, force=True)) == [["P"]]
    assert plan_from(held(P=math.nan), written(P=math.nan), autopilot="px4").complete


def test_metadata_marks_read_only_and_reboot_parameters() -> None:
    info = {"A": Info(is_read_only=True), "B": Info(reboot_required=True)}
    made = plan_from(held(A=1, B=1, C=1), written(A=2, B=2, C=2), info=info)
    assert (made.rows["A"].status, made.rows["A"].category) == (ApplyStatus.SKIPPED, READ_ONLY)
    assert made.reboot_for == ("B",)
    assert order(plan_from(held(A=1), written(A=2), info=info, include=READ_ONLY)) == [["A"]]


def test_values_are_compared_in_the_type_of_the_vehicle() -> None:
    table = held(A=0.1, B=(ParamType.UINT8, 3), C=-0.0, D=16777217, ODD=(77, RAW))
    assert plan_from(table, written(A=0.1, B=3.0, C=0, D=16777217, ODD=RAW), autopilot="px4").complete
    made = plan_from(table, written(A=0.1, D=16777216, ODD=RAW[::-1]), autopilot="px4")
    assert order(made) == [["D", "ODD"]]
    assert plan_from(table, {"ODD": 5}).rows["ODD"].status is ApplyStatus.REFUSED


def test_the_order_of_stages_works_on_ardupilot() -> None:
    table = held(WPNAV_SPEED=500.0, EK2_ENABLE=0, FRAME_CLASS=1, GPS1_TYPE=1, FENCE_ENABLE=1)
    ids = held(SYSID_ENFORCE=0, SYSID_THISMAV=1)
    first = written(SYSID_THISMAV=7, FENCE_ENABLE=0, WPNAV_SPEED=600, SYSID_ENFORCE=1)
    wanted = ParamSet({**first, **written(GPS1_TYPE=2, EK2_ENABLE=1, FRAME_CLASS=2)})
    made = plan_from(table | ids, wanted, autopilot="ardupilot", include="identity")
    assert order(made) == [
        ["FRAME_CLASS"],
        ["GPS1_TYPE", "EK2_ENABLE"],
        ["WPNAV_SPEED"],
        ["FENCE_ENABLE"],
        ["SYSID_ENFORCE", "SYSID_THISMAV"],
    ]
    assert [stage.reveals for stage in made.stages] == [True, True, False, False, False]
    assert not any(stage.reboot_first for stage in made.stages)
    assert set(made.reboot_for) == {"FRAME_CLASS", "EK2_ENABLE", "GPS1_TYPE"}


def test_a_parameter_that_a_step_may_reveal_is_set_later() -> None:
    table = held(EK2_ENABLE=0, WPNAV_SPEED=500.0)
    wanted = written(EK2_ALT_M_NSE=3.0, EK2_ENABLE=1, WPNAV_SPEED=600)
    made = plan_from(table, wanted, autopilot="ardupilot")
    row = made.rows["EK2_ALT_M_NSE"]
    assert (row.status, row.category, row.before) == (ApplyStatus.LATER, MISSING, None)
    assert order(made) == [["EK2_ENABLE"], ["WPNAV_SPEED"]]
    assert made.stages[0].reboot_first
    shown = plan_from(table | held(EK2_ENABLE=1, EK2_ALT_M_NSE=2.0), wanted, autopilot="ardupilot")
    assert order(shown) == [["EK2_ALT_M_NSE", "WPNAV_SPEED"]]
    hidden = plan_from(table | held(EK2_ENABLE=1), wanted, autopilot="ardupilot")
    assert hidden.rows["EK2_ALT_M_NSE"].status is ApplyStatus.REFUSED
    assert not made.problems
    assert not hidden.problems, "a reboot may reveal it"


def test_px4_reboots_between_the_frame_and_the_parameters_it_resets() -> None:
    table = held(SYS_AUTOSTART=4001, MC_ROLL_P=6.5, SYS_AUTOCONFIG=0, MAV_SYS_ID=1)
    wanted = written(MC_ROLL_P=7, MAV_SYS_ID=3, SYS_AUTOSTART=4050)
    made = plan_from(table, wanted, autopilot="px4", include="identity")
    assert order(made) == [["SYS_AUTOSTART"], ["MC_ROLL_P"], ["MAV_SYS_ID"]]
    assert made.stages[0].reboot_first
    assert made.reboot_for == ("SYS_AUTOSTART", "MAV_SYS_ID")


def test_a_plan_for_the_saved_table_of_a_vehicle_has_no_steps() -> None:
    """The table saved from a vehicle needs no write."""
    for table, autopilot in ((px4_table(), "px4"), (ardupilot_table(), "ardupilot")):
        current = copy_of(table)
        wanted = ParamSet(current)
        made = plan_from(current, wanted, autopilot=autopilot)
        assert made.complete
        assert 30 < len(made.of(ApplyStatus.SKIPPED)) < 170
        everything = plan_from(current, wanted, autopilot=autopilot, include=CATEGORIES)
        assert everything.complete
        assert {row.category for row in everything.of(ApplyStatus.SKIPPED)} <= {"action"}
        assert everything.counts[ApplyStatus.UNCHANGED] >= len(current) - 4


def test_a_file_of_another_autopilot_is_refused() -> None:
    for own, other, number in (("px4", "ardupilot", 3), ("ardupilot", "px4", 12)):
        wanted = ParamSet({"A": 2}, identity=Identity(1, "sim:", autopilot=number), source="f")
        with pytest.raises(UsageError, match=f"of f are those of a vehicle with {other}, not with {own}"):
            plan_from(held(A=1), wanted, autopilot=own)
        for fitting in (other, "generic", None):
            assert plan_from(held(A=1), wanted, autopilot=fitting).to_write
