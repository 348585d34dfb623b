"""`apply`, `verify` and `restore` on simulated vehicles: order, verification, failures, reboots."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from unittest import mock

import anyio
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from paramclient import ParamCache, ParamClient
from paramclient.errors import (
    AnotherVehicle,
    InvalidParameters,
    LinkError,
    NoReply,
    UsageError,
    VehicleArmed,
)
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import ParamType, Value
from paramclient.protocol.ftp import Opcode, Packet
from paramclient.provision import (
    MISSING,
    ApplyProgress,
    ApplyStatus,
    apply,
    for_each,
    plan,
    restore,
)
from paramclient.sim import Air, ArduPilotVehicle, FaultyLink, PX4Vehicle, SimParam
from paramclient.wire import frames, messages
from tests.shell import FlakyLink, Tap, a_client, clamped, in_simulated_time, residue

SETTINGS: dict[str, Value | tuple[ParamType, Value]] = {
    f"TUNE_{number:02}": number / 4 if number % 3 else number for number in range(30)
}
"""Parameters that most of these tests set."""
OTHERS: dict[str, Value | tuple[ParamType, Value]] = {
    "STAT_RUNTIME": 5,
    "MAV_SYS_ID": 1,
    "SYSID_THISMAV": (ParamType.INT16, 1),
    "SYSID_ENFORCE": (ParamType.INT8, 0),
    "CAL_ACC0_XOFF": 0.25,
    "COMPASS_OFS_X": 0.25,
    "SYS_AUTOSTART": 4001,
    "SYS_AUTOCONFIG": 0,
    "FRAME_CLASS": (ParamType.INT8, 1),
    "EK2_ENABLE": (ParamType.INT8, 0),
    "SMALL": (ParamType.INT8, 1),
}
GROUP: dict[str, Value | tuple[ParamType, Value]] = {
    "EK2_ALT_M_NSE": 3.0,
    "EK2_GPS_TYPE": (ParamType.INT8, 0),
}


class HidingGroup(ArduPilotVehicle):
    """An ArduPilot that answers no reads by name for the parameters of a hidden group."""

    def respond(self, message: messages.Message, sender: frames.Frame) -> None:
        name = getattr(message, "param_id", "")
        if not name or name in self.params:
            super().respond(message, sender)


class ClampingVehicle(ArduPilotVehicle):
    """An ArduPilot that keeps TUNE_01 within 0 to 10."""

    def respond(self, message: messages.Message, sender: frames.Frame) -> None:
        super().respond(clamped(message, "TUNE_01", 0.0, 10.0), sender)


CLAMPED: dict[str, Value | tuple[ParamType, Value]] = {
    "MPC_TILTMAX_AIR": 45.0,
    "MPC_TILTMAX_LND": 12.0,
    "MPC_XY_VEL_MAX": 12.0,
    "MPC_XY_CRUISE": 5.0,
    "MPC_VEL_MANUAL": 10.0,
}
"""Parameters that PX4's position controller clamps."""


def ardupilot(make: type[ArduPilotVehicle] = ArduPilotVehicle, **options: Any) -> ArduPilotVehicle:
    defaults: dict[str, Any] = {"table": SETTINGS | OTHERS, "groups": {"EK2_ENABLE": GROUP}}
    return make(**defaults | options)


def px4(kind: type[PX4Vehicle] = PX4Vehicle, **options: Any) -> PX4Vehicle:
    rows = [
        SimParam(
            name,
            ParamType.REAL32 if isinstance(value, float) else ParamType.INT32,
            value,
            name == "CAL_ACC0_XOFF",
        )
        for name, entry in (SETTINGS | OTHERS | GROUP).items()
        for value in [entry[1] if isinstance(entry, tuple) else entry]
    ]
    late_use = {"EK2_ENABLE": list(GROUP)}
    defaults: dict[str, Any] = {"table": rows, "not_in_use": list(GROUP), "late_use": late_use}
    return kind(**defaults | options)


EVERY_KIND = pytest.mark.parametrize("make", [ardupilot, px4], ids=["ardupilot", "px4"])


def written(values: Mapping[str, Value], **options: Any) -> ParamSet:
    return ParamSet({name: WrittenParam(name, value) for name, value in values.items()}, **options)


def another(*names: str) -> dict[str, Value]:
    """Return values that differ from those of SETTINGS."""
    wanted: dict[str, Value] = {}
    for name in names or SETTINGS:
        value = SETTINGS[name]
        assert isinstance(value, int | float)
        wanted[name] = value + 1
    return wanted


def statuses(result: Any) -> dict[str, str]:
    return {name: str(row.status) for name, row in result.rows.items()}


def sets(tap: Tap) -> list[str]:
    """Return the names of the written parameters, once each, in order."""
    return list(dict.fromkeys(message.param_id for message in tap.messages(messages.ParamSet)))


@EVERY_KIND
@pytest.mark.parametrize("loss", [0.0, 0.15])
@in_simulated_time
async def test_all_values_are_written_and_verified(make: Callable[[], Any], loss: float) -> None:
    vehicle = make()
    air = Air([vehicle], uplink=FaultyLink(loss=loss, seed=1), downlink=FaultyLink(loss=loss, seed=2))
    wanted = another() | {"STAT_RUNTIME": 6, "CAL_ACC0_XOFF": 1.0, "COMPASS_OFS_X": 1.0, "EK2_GPS_TYPE": 3}
    async with a_client(air) as client:
        component = await client.component()
        result = await apply(component, written(wanted | {"EK2_ENABLE": 1}))
        await anyio.sleep(3.0)  # the client requests the hash after writes
        assert residue(component) == []
    assert result.error is None
    left_out = {name for name, row in result.rows.items() if row.status is ApplyStatus.SKIPPED}
    assert left_out == ({"STAT_RUNTIME", "COMPASS_OFS_X"} if make is ardupilot else {"CAL_ACC0_XOFF"})
    assert result.complete
    for name, value in wanted.items():
        assert (vehicle.param(name).value == value) is (name not in left_out), name
    assert statuses(result)["TUNE_03"] == "accepted"
    assert result.rows["TUNE_03"].before == 3
    assert result.rows["TUNE_03"].actual == 4
    assert "FRAME_CLASS" in result.extra


@in_simulated_time
async def test_a_value_that_is_not_reported_any_more_is_unproven() -> None:
    vehicle = ardupilot(ftp=False)

    def lose(progress: ApplyProgress) -> None:
        if progress.row is not None and progress.row.name == "TUNE_02":
            vehicle.set_param("TUNE_01", 0)
            vehicle.dead = ["TUNE_01"]

    async with a_client(vehicle) as client:
        result = await apply(await client.component(), written(another("TUNE_01", "TUNE_02")), progress=lose)
    assert statuses(result) == {"TUNE_01": "unproven", "TUNE_02": "accepted"}
    assert "no longer reports it" in str(result.rows["TUNE_01"])
    assert not result.complete


def downloads(tap: Tap) -> int:
    """Return the number of times that the table was requested, as a file or as a list."""
    packets = [Packet.unpack(message.payload) for message in tap.messages(messages.FileTransfer)]
    files = {packet.sequence for packet in packets if packet.opcode == Opcode.OPEN_FILE_RO}
    lists = {
        round(at, 1) for at, _, message in tap.received if isinstance(message, messages.ParamRequestList)
    }
    return len(files) or len(lists)  # copies that are sent together count once


@in_simulated_time
async def test_a_name_that_the_vehicle_does_not_have_refuses_all_unless_partial() -> None:
    tap = Tap(ardupilot())
    wanted = {"TUNE_X1": 1, "TUNE_01": 7, "a name too long!!": 1}
    async with a_client(tap) as client:
        component = await client.component()
        with pytest.raises(InvalidParameters, match=r"TUNE_X1: not on this vehicle \(did you mean TUNE_10"):
            await apply(component, wanted)
        assert sets(tap) == []
        result = await apply(component, wanted, partial=True)
    assert result.rows["TUNE_X1"].status is ApplyStatus.SKIPPED
    assert result.rows["TUNE_X1"].nearest == ("TUNE_10", "TUNE_11", "TUNE_12")
    assert str(result.rows["TUNE_X1"]).startswith(
        "TUNE_X1 = 1, skipped: not on this vehicle (did you mean TUNE_"
    )
    assert sets(tap) == ["TUNE_01"]
    assert not result.complete


@in_simulated_time
async def test_a_refused_or_adjusted_value_does_not_stop_the_others() -> None:
    vehicle = ardupilot(ClampingVehicle, read_only=["TUNE_02", "TUNE_04"], param_error=True)
    wanted = written(another() | {"TUNE_01": 99.0})
    async with a_client(vehicle) as client:
        component = await client.component()
        result = await apply(component, wanted)
        again = await apply(component, wanted)
    expected = dict.fromkeys(SETTINGS, "accepted") | {
        "TUNE_01": "adjusted",
        "TUNE_02": "refused",
        "TUNE_04": "refused",
    }
    assert statuses(result) == expected
    assert result.rows["TUNE_01"].actual == 10.0
    assert "read only" in result.rows["TUNE_02"].reason
    assert result.rows["TUNE_02"].actual == SETTINGS["TUNE_02"]
    assert not result.complete
    assert result.error is None
    # the vehicle has the adjusted value already, and gives no reason for not changing it
    assert {name for name, status in statuses(again).items() if status == "refused"} == {
        *("TUNE_01", "TUNE_02", "TUNE_04")
    }
    assert again.counts[ApplyStatus.UNCHANGED] == len(SETTINGS) - 3


@in_simulated_time
async def test_invalid_values_are_raised_before_anything_is_sent() -> None:
    tap = Tap(ardupilot())
    wanted = written({"TUNE_01": 7.0, "SMALL": 300, "TUNE_03": 2**24 + 1})
    async with a_client(tap) as client:
        component = await client.component()
        with pytest.raises(InvalidParameters, match="SMALL: 300 does not fit INT8") as caught:
            await apply(component, wanted)
        assert set(caught.value.problems) == {"SMALL", "TUNE_03"}
        assert tap.messages(messages.ParamSet) == []
        result = await apply(component, wanted, partial=True)
    assert statuses(result) == {"TUNE_01": "accepted", "SMALL": "skipped", "TUNE_03": "skipped"}
    assert "cannot be sent exactly" in result.rows["TUNE_03"].reason
    assert not result.complete


@in_simulated_time
async def test_left_out_parameters_can_be_included() -> None:
    vehicle = ardupilot()
    async with a_client(vehicle) as client:
        component = await client.component()
        wanted = written({"COMPASS_OFS_X": 7.0, "STAT_RUNTIME": 9})
        result = await apply(component, wanted, include="calibration")
        assert statuses(result) == {"COMPASS_OFS_X": "accepted", "STAT_RUNTIME": "skipped"}
        assert result.complete
        assert (await plan(component, wanted, include="calibration")).complete
        assert not (await plan(component, wanted, include=["STAT_*"])).complete


@in_simulated_time
async def test_the_state_is_stored_before_anything_is_sent(tmp_path: Path) -> None:
    cache = ParamCache(tmp_path / "cache.sqlite3")
    vehicle = ardupilot()
    tap = Tap(vehicle)
    seen: list[tuple[str, int]] = []
    store = ParamCache.store_snapshot

    def spy(*args: Any, **kwargs: Any) -> Any:
        seen.append((kwargs["reason"], len(tap.messages(messages.ParamSet))))
        return store(*args, **kwargs)

    with mock.patch.object(ParamCache, "store_snapshot", spy):
        async with ParamClient(tap, cache=cache) as client:
            component = await client.component()
            first = await apply(component, written(another("TUNE_01")))
            await apply(component, written(another("TUNE_01")))  # no steps, no snapshot
            key = component.identity.key
    assert seen == [("before apply", 0)]
    (summary,) = cache.snapshots(key, 1)
    state = cache.state_at(key, 1, summary.id)
    assert {name: param.value for name, param in state.items()} == {
        name: param.value for name, param in ardupilot().params.items()
    }
    assert dict(first.before) == dict(state)


@pytest.mark.parametrize("bring", [apply, restore])
@in_simulated_time
async def test_before_writing_may_end_the_call(bring: Callable[..., Any], tmp_path: Path) -> None:
    cache = ParamCache(tmp_path / "cache.sqlite3")
    tap = Tap(ardupilot())
    seen: list[int] = []

    async def stop() -> None:
        seen.append(len(component.params))
        raise UsageError("not now")

    async with ParamClient(tap, cache=cache) as client:
        component = await client.component()
        with pytest.raises(UsageError, match="not now"):
            await bring(component, written(another()), before_writing=stop)
        assert len(seen) == 1
        assert seen[0] > len(SETTINGS), "it has been read"
        assert not tap.messages(messages.ParamSet)
        key = component.identity.key
        await anyio.sleep(1.0)
    assert cache.snapshots(key) == []


@in_simulated_time
async def test_a_silent_vehicle_ends_the_run_and_the_next_run_continues() -> None:
    vehicle = ardupilot()
    tap = Tap(vehicle)
    async with a_client(tap) as client:
        component = await client.component()

        def fall_silent(progress: ApplyProgress) -> None:
            if progress.phase == "writing" and progress.done == 5:
                tap.is_deaf = tap.is_mute = True

        result = await apply(component, written(another()), progress=fall_silent)
        assert isinstance(result.error, NoReply)
        assert not result.complete
        counts = result.counts
        assert counts[ApplyStatus.UNPROVEN] >= 5
        assert counts[ApplyStatus.UNKNOWN] > 0
        assert sum(counts.values()) == len(SETTINGS)
        (last,) = (row.reason for row in result.of(ApplyStatus.UNKNOWN) if row.name == "TUNE_29")
        assert last.startswith("no reply: the acknowledgement of TUNE_29 by 1/1")  # all 30 were in flight
        assert "ended by no reply" in repr(result)
        tap.is_deaf = tap.is_mute = False
        await anyio.sleep(3)
        again = await apply(component, written(another()))
    assert again.complete
    assert again.counts[ApplyStatus.UNCHANGED] >= 5
    assert all(vehicle.param(name).value == value for name, value in another().items())


@in_simulated_time
async def test_a_failed_link_ends_the_run_with_the_rows_so_far() -> None:
    vehicle = ardupilot()
    link = FlakyLink(vehicle)
    async with a_client(link) as client:
        component = await client.component()
        async with anyio.create_task_group() as tasks:

            def cut(progress: ApplyProgress) -> None:
                if progress.phase == "writing" and progress.done == 5:
                    tasks.start_soon(lambda: link.drop(stays_offline=True))

            result = await apply(component, written(another()), progress=cut)
        assert isinstance(result.error, LinkError)
        assert result.counts[ApplyStatus.NOT_TRIED] > 0
        with pytest.raises(LinkError):  # nothing was sent this time
            await apply(component, written(another()))
        link.is_offline = False
        await anyio.sleep(10)
        assert (await apply(component, written(another()))).complete


@in_simulated_time
async def test_the_timeout_ends_the_run() -> None:
    vehicle = ardupilot()
    async with a_client(Air.symmetric([vehicle], rate=1000.0)) as client:
        component = await client.component()
        with pytest.raises(NoReply, match="the apply to 1/1"):
            await apply(component, written(another()), timeout=0.1)
        await plan(component, written(another()))
        began = anyio.current_time()
        await plan(component, written(another()))  # as the run will begin: the table is proven
        took = anyio.current_time() - began
        result = await apply(component, written(another()), timeout=took + 0.5)
        assert result.elapsed < took + 1
        assert isinstance(result.error, NoReply)
        assert "sent, not acknowledged" in {row.reason[:22] for row in result.of(ApplyStatus.UNKNOWN)}
        assert residue(component) == []


@in_simulated_time
async def test_restore_writes_an_earlier_state_of_the_vehicle() -> None:
    vehicle = ardupilot()
    original = vehicle.values
    async with a_client(vehicle) as client:
        component = await client.component()
        wanted = written(
            another() | {"COMPASS_OFS_X": 9.0, "STAT_RUNTIME": 77, "EK2_ENABLE": 1, "EK2_ALT_M_NSE": 1.0}
        )
        first = await apply(component, wanted, include=["calibration", "counter"])
        assert first.complete
        undone = await restore(component, first.before)
    assert undone.complete
    assert undone.rows["COMPASS_OFS_X"].status is ApplyStatus.ACCEPTED
    assert undone.rows["STAT_RUNTIME"].category == "counter"
    vehicle.set_param("STAT_RUNTIME", 5)
    assert vehicle.values == original
    # it was read by name before it was revealed, so it is part of the state
    assert vehicle.param("EK2_ALT_M_NSE").value == 3.0
    assert undone.extra == ()


@in_simulated_time
async def test_restore_skips_measured_and_read_only_parameters() -> None:
    own: dict[str, Value | tuple[ParamType, Value]]
    own = {"BARO1_GND_PRESS": 94500.0, "BARO1_DEVID": 65540, "INS_GYROFFS_X": 0.25, "LOCKED": 1.0}
    vehicle = ArduPilotVehicle(
        table=SETTINGS | OTHERS | own, read_only=["BARO1_GND_PRESS", "BARO1_DEVID", "LOCKED"], live_period=0.0
    )
    tap = Tap(vehicle)
    async with a_client(tap) as client:
        component = await client.component()
        before = (await apply(component, written(another("TUNE_01")))).before
        for name, value in {
            "BARO1_GND_PRESS": 9.0,
            "BARO1_DEVID": 7,
            "INS_GYROFFS_X": 0.5,
            "LOCKED": 2.0,
        }.items():
            vehicle.set_param(name, value)
        result = await restore(component, before)
        assert result.complete
        assert set(sets(tap)) == {"LOCKED", "TUNE_01"}
        reported = {row.name: (row.category, row.actual) for row in result.shown_rows}
        assert reported == {
            "TUNE_01": ("", 0.25),
            "BARO1_GND_PRESS": ("read-only", 9.0),
            "BARO1_DEVID": ("read-only", 7),
            "INS_GYROFFS_X": ("measured", 0.5),
            "LOCKED": ("read-only", 2.0),
        }
        assert "the vehicle reports that it is read-only" in str(result.rows["LOCKED"])
        # `apply` of this parameter alone reports the refusal
        assert statuses(await apply(component, written({"LOCKED": 1.0}))) == {"LOCKED": "refused"}


@in_simulated_time
async def test_the_state_of_another_vehicle_is_refused() -> None:
    async with a_client(ardupilot(uid2=b"another")) as client:
        component = await client.component()
        await component.fetch_all()
        await component.wait_until_identified(10.0)
        state = ParamSet(component.params, identity=component.identity)
    async with a_client(ardupilot()) as client:
        component = await client.component()
        await component.fetch_all()
        with pytest.raises(
            UsageError, match="the state is that of another vehicle: the ardupilot 616e6f74686572"
        ):
            await restore(component, state)


@in_simulated_time
async def test_several_vehicles_are_set_and_restored_concurrently() -> None:
    vehicles = [ardupilot(), px4(system=2), ardupilot(system=3)]
    own: dict[int, dict[str, Value]] = {1: {}, 2: {"TUNE_02": 42.0}, 3: {"SMALL": 1000}}
    async with a_client(Air(vehicles)) as client:
        await client.fetch_all()
        components = [client.components[vehicle.system, 1] for vehicle in vehicles]
        wanted = {system: another() | more for system, more in own.items()}
        applied = await for_each(components, lambda each: apply(each, wanted[each.system]))
        assert list(applied.results) == [(1, 1), (2, 1)]
        assert isinstance(applied.errors[3, 1], InvalidParameters)
        assert not applied.complete
        assert [vehicle.param("TUNE_02").value for vehicle in vehicles] == [1.5, 42.0, 0.5]
        planned = await for_each(components, lambda each: plan(each, wanted[each.system]))
        assert [made.complete for made in planned.results.values()] == [True, True, False]
        assert (await for_each(components[:1], lambda each: apply(each, wanted[1]))).complete
        before = {system: result.before for (system, _), result in applied.results.items()}
        restored = await for_each(components[:2], lambda each: restore(each, before[each.system]))
        assert restored.complete
        assert [vehicle.param("TUNE_02").value for vehicle in vehicles] == [0.5, 0.5, 0.5]


@EVERY_KIND
@in_simulated_time
async def test_an_armed_vehicle_is_refused_unless_allowed(make: Callable[..., Any]) -> None:
    vehicle = make(armed=True)
    tap = Tap(vehicle)
    async with a_client(tap) as client:
        component = await client.component()
        with pytest.raises(VehicleArmed, match="1/1 is armed"):
            await apply(component, written(another()))
        assert tap.messages(messages.ParamSet) == []
        assert (await plan(component, written(another()))).to_write
        assert (await apply(component, written(another("TUNE_01")), allow_armed=True)).complete
        # an armed vehicle refuses to reboot, which ends the run
        result = await apply(component, written({"FRAME_CLASS": 2}), allow_armed=True, reboot=True)
        if make is ardupilot:
            assert isinstance(result.error, VehicleArmed)
            assert statuses(result) == {"FRAME_CLASS": "accepted"}


@in_simulated_time
async def test_a_vehicle_armed_during_the_run_ends_it() -> None:
    vehicle = ardupilot()

    def arm(progress: ApplyProgress) -> None:
        if progress.row is not None:
            vehicle.armed = True

    async with a_client(vehicle) as client:
        wanted = written({"EK2_ENABLE": 1, "EK2_NO_SUCH": 1})
        component = await client.component()
        result = await apply(component, wanted, progress=arm)
        assert statuses(result)["EK2_ENABLE"] == "accepted"
        await anyio.sleep(2)
        with pytest.raises(VehicleArmed):
            await apply(component, written(another()))


@in_simulated_time
async def test_a_reboot_follows_values_that_take_effect_after_it() -> None:
    vehicle = ardupilot(reboot_groups=["EK2_ENABLE"], make=HidingGroup)
    tap = Tap(vehicle)
    wanted = written(another("TUNE_01") | {"EK2_ALT_M_NSE": 1.5, "EK2_ENABLE": 1, "FRAME_CLASS": 2})
    async with a_client(tap) as client:
        component = await client.component()
        awaiting_reboot = await apply(component, wanted)
        assert awaiting_reboot.reboots == 0
        assert awaiting_reboot.reboot_required == ("FRAME_CLASS", "EK2_ENABLE")
        assert awaiting_reboot.rows["EK2_ALT_M_NSE"].category == MISSING
        made = await plan(component, wanted)
        assert made.awaiting_reboot == ("EK2_ENABLE",)
        tap.received.clear()
        reported: list[str] = []
        result = await apply(component, wanted, reboot=True, progress=lambda how: reported.append(how.phase))
    assert result.complete
    assert (result.reboots, result.reboot_required) == (1, ())
    assert sets(tap) == ["EK2_ALT_M_NSE"], "revealed by the reboot"
    assert list(dict.fromkeys(reported)) == ["reading", "rebooting", "writing"]
    assert vehicle.param("EK2_ALT_M_NSE").value == 1.5


@EVERY_KIND
@in_simulated_time
async def test_a_changed_system_id_is_followed(make: Callable[..., Any]) -> None:
    vehicle = make() if make is ardupilot else make(uid=77)
    name = "SYSID_THISMAV" if make is ardupilot else "MAV_SYS_ID"
    tap = Tap(vehicle)
    async with a_client(tap) as client:
        component = await client.component()
        wanted = written({name: 7} | another("TUNE_01", "TUNE_02"))
        result = await apply(component, wanted, include=[name], reboot=True)
        assert result.complete, result
        assert (result.system, result.component) == (7, 1)
        assert (vehicle.system, vehicle.param(name).value) == (7, 7)
        assert sets(tap)[-1] == name
        assert result.reboots == 1
        assert client.components[7, 1].state == "synced"
        await anyio.sleep(5.0)  # what is measured at a start is read again
        assert residue(component) == []
        # and back to the old id, under which it was present just before
        undone = await restore(client.components[7, 1], result.before, reboot=True)
    assert undone.complete
    assert (undone.system, vehicle.system) == (1, 1)


@pytest.mark.parametrize(
    ("options", "wanted", "status", "reboots", "system"),
    [
        ({"kind": "plane"}, [7], "accepted", False, 7),  # as a rover, within a second
        ({}, [7], "accepted", True, 1),
        ({}, [7, 1], "accepted", None, 1),  # set back before it has taken effect
        ({"read_only": ["SYSID_THISMAV"], "param_error": True}, [7], "refused", True, 1),
    ],
)
@in_simulated_time
async def test_a_system_id_takes_effect_at_once_or_after_a_reboot(
    options: dict[str, Any], wanted: list[int], status: str, reboots: bool | None, system: int
) -> None:
    vehicle = ardupilot(**options)
    async with a_client(vehicle) as client:
        component = await client.component()
        for each in wanted:
            result = await apply(component, {"SYSID_THISMAV": each}, include="identity")
            assert statuses(result) == {"SYSID_THISMAV": status}
    assert (result.system, vehicle.system, result.reboots) == (system, system, 0)
    if status == "refused":
        assert "read only" in result.rows["SYSID_THISMAV"].reason
    elif reboots is not None:
        assert result.plan.reboot_for == result.reboot_required == ("SYSID_THISMAV",) * reboots


@in_simulated_time
async def test_plain_values_are_applied_and_the_actual_value_is_what_the_vehicle_sent_last() -> None:
    vehicle = ardupilot(ClampingVehicle)

    def change(progress: ApplyProgress) -> None:
        if progress.row is not None and progress.row.name == "TUNE_02":
            vehicle.set_param("TUNE_02", 3.0)

    async with a_client(vehicle) as client:
        component = await client.component()
        result = await apply(component, {"TUNE_01": 99.0, "TUNE_02": 4.5}, progress=change)
        assert {name: row.actual for name, row in result.rows.items()} == {
            name: component.params[name].value for name in result.rows
        }
        assert (await plan(component, ParamSet({"TUNE_01": 10}))).complete


@in_simulated_time
async def test_a_system_id_of_another_vehicle_is_not_set() -> None:
    vehicles = [ardupilot(), ardupilot(system=7)]
    async with a_client(Air(vehicles)) as client:
        component = await client.component(1, 1)
        await client.component(7, 1)
        result = await apply(component, written({"SYSID_THISMAV": 7}), include="identity")
    assert statuses(result) == {"SYSID_THISMAV": "skipped"}
    assert result.rows["SYSID_THISMAV"].reason == "another vehicle on this link has system id 7"
    assert not result.complete
    assert [vehicle.system for vehicle in vehicles] == [1, 7]


@pytest.mark.parametrize("sent", [0, len(SETTINGS)])
@in_simulated_time
async def test_another_vehicle_at_the_same_address_ends_the_run(sent: int) -> None:
    """Before the first value, or before the values are read again."""
    vehicle, other = ardupilot(live_period=0.0), ardupilot(uid2=b"another")
    tap = Tap(vehicle)

    async def exchange() -> None:
        while vehicle.requests["PARAM_SET"] < sent:  # noqa: ASYNC110 - in simulated time
            await anyio.sleep(0.1)
        tap.is_deaf = tap.is_mute = True
        tap.endpoint = other
        await anyio.sleep(1.5)
        tap.is_deaf = tap.is_mute = False
        await anyio.sleep(1.0)

    async with a_client(tap) as client:
        component = await client.component()
        await anyio.sleep(30.0)
        if sent:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(exchange)
                result = await apply(component, written(another()))
            assert isinstance(result.error, AnotherVehicle)
            assert not result.complete
        else:
            with pytest.raises(AnotherVehicle):
                await apply(component, written(another()), before_writing=exchange)
    assert (vehicle.requests["PARAM_SET"], other.requests["PARAM_SET"]) == (sent, 0)


class EndpointWithEvent(Tap):
    """An endpoint that calls `happen` after the station has sent a number of frames."""

    def __init__(self, endpoint: Any, frames: int, happen: Callable[[], object]) -> None:
        super().__init__(endpoint)
        self._frames = frames
        self._happen = happen

    def receive(self, data: bytes, now: float) -> None:
        super().receive(data, now)
        if len(self.received) >= self._frames > 0:
            self._frames = 0
            self._happen()


class Scenario:
    """A vehicle, its wanted parameters and the options of `apply`; identical each time it is made.

    Attributes:
        vehicle: the vehicle, with the same hardware id each time.
        wanted: the wanted parameters.
        options: those of `apply`.
    """

    def __init__(self, kind: str) -> None:
        wanted = another() | {"EK2_ALT_M_NSE": 1.5, "EK2_ENABLE": 1, "SMALL": 7}
        self.options: dict[str, Any] = {}
        self.vehicle: ArduPilotVehicle | PX4Vehicle
        if kind == "ardupilot":
            self.vehicle = ardupilot()
        elif kind == "px4":
            self.vehicle = px4(uid=77)
        elif kind == "ardupilot that starts":
            self.vehicle = ardupilot(HidingGroup, reboot_groups=["EK2_ENABLE"])
            wanted |= {"FRAME_CLASS": 2, "SYSID_THISMAV": 7}
        else:
            self.vehicle = px4(uid=77)
            wanted |= {"SYS_AUTOSTART": 4050, "MAV_SYS_ID": 7}
        if kind.endswith("that starts"):
            self.options = {"reboot": True, "include": "identity"}
        self.wanted = written(wanted)

    def truth(self) -> dict[str, Value]:
        """Return all values of the vehicle, hidden ones included."""
        return {entry.name: entry.value for entry in self.vehicle.entries}


async def run_interrupted(
    story: Scenario, cache: ParamCache, *, frames: int, how: str, **faults: Any
) -> None:
    """Run `apply` until the station has sent `frames` frames; then end the session in the way of `how`."""
    scope = anyio.CancelScope()

    def end() -> None:
        if how == "silence":
            tap.is_deaf = tap.is_mute = True
        else:
            scope.cancel()
        if how == "kill":  # nothing more is written to the disk
            client.core.cache_writer.cache = None

    tap = EndpointWithEvent(Air.symmetric([story.vehicle], **faults), frames, end)
    with scope:
        async with ParamClient(tap, cache=cache) as client:
            with contextlib.suppress(NoReply):
                result = await apply(await client.component(), story.wanted, **story.options)
                assert result.complete or isinstance(result.error, NoReply)


@pytest.mark.parametrize("kind", ["ardupilot", "px4", "ardupilot that starts", "px4 that starts"])
@settings(max_examples=15, deadline=None, derandomize=True)
@given(
    frames=st.integers(1, 160),
    how=st.sampled_from(["cancel", "kill", "silence"]),
    loss=st.sampled_from([0.0, 0.0, 0.1]),
    seed=st.integers(0, 1000),
)
def test_the_next_run_completes_after_an_interruption_anywhere(
    kind: str, frames: int, how: str, loss: float, seed: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("cache") / "cache.sqlite3"

    @in_simulated_time
    async def reported() -> None:
        story = Scenario(kind)
        before = story.truth()
        wanted = {name: param.value for name, param in story.wanted.items()}
        with ParamCache(path) as cache:
            await run_interrupted(story, cache, frames=frames, how=how, loss=loss, seed=seed)
            air = Air.symmetric([story.vehicle], loss=loss, seed=seed + 1)
            async with ParamClient(air, cache=cache) as client:
                result = await apply(await client.component(), story.wanted, **story.options)
            assert result.complete, result.rows
            assert story.truth() == before | wanted
            assert story.vehicle.system == result.system == (7 if kind.endswith("that starts") else 1)
            (key,) = [known.key for known in cache.vehicles() if known.identity.uid is not None]
            history = cache.history(key)
            first = cache.state_at(key, 1, cache.snapshots(key)[0].id)
            # the cache has the state before the first write, and every change from it to the present state
            assert {name: param.value for name, param in first.items()} == {
                name: value for name, value in before.items() if name in first
            }
            assert first.keys() >= before.keys() - GROUP.keys()
            for name in before.keys() - GROUP.keys():  # these appear and disappear with their switch
                lines = [line for line in history if line.name == name]
                steps = [(line.old.value, line.new and line.new.value) for line in lines]
                assert all(earlier[1] == later[0] for earlier, later in itertools.pairwise(steps)), steps
                ends = (steps[0][0], steps[-1][1]) if steps else (before[name], before[name])
                assert ends == (before[name], wanted.get(name, before[name])), steps
                assert all(old != new for old, new in steps)

    reported()


# Values that the vehicle changes after its acknowledgement


@pytest.mark.parametrize("delay", [0.02, 0.8, 1.1])
@in_simulated_time
async def test_a_value_clamped_within_a_second_is_adjusted(delay: float) -> None:
    vehicle = PX4Vehicle(table=SETTINGS | CLAMPED, clamp_delay=delay)
    wanted = {"MPC_TILTMAX_LND": 80.0, "TUNE_01": 9.5, "MPC_XY_CRUISE": 6.0}
    async with a_client(vehicle) as client:
        result = await apply(await client.component(), written(wanted))
    assert statuses(result) == {
        "MPC_TILTMAX_LND": "adjusted",
        "TUNE_01": "accepted",
        "MPC_XY_CRUISE": "accepted",
    }
    row = result.rows["MPC_TILTMAX_LND"]
    assert (row.before, row.actual) == (12.0, 45.0)
    assert "changed it afterwards" in row.reason
    assert not result.complete
    assert vehicle.requests["PARAM_SET"] == 4  # once more: a later write may have changed it


@in_simulated_time
async def test_a_value_clamped_by_another_wanted_value_is_set_with_the_second_attempt() -> None:
    vehicle = PX4Vehicle(table=SETTINGS | CLAMPED, clamp_delay=0.0)
    async with a_client(vehicle) as client:
        wanted = {"MPC_XY_CRUISE": 18.0, "MPC_XY_VEL_MAX": 19.0}
        assert (await apply(await client.component(), written(wanted))).complete


# On a radio


def on_a_radio(vehicle: ArduPilotVehicle | PX4Vehicle) -> Tap:
    """A vehicle on a serial port of 57600 baud."""
    return Tap(Air.symmetric([vehicle], rate=5760.0, delay=0.02))


def ardupilot_on_a_serial_port(**options: Any) -> ArduPilotVehicle:
    return ArduPilotVehicle(live=(), burst=1, period=0.025, ftp_rate=5760.0, **options)


def tuned(vehicle: ArduPilotVehicle, count: int) -> ParamSet:
    """Return changed values, one higher, of `count` floats of the vehicle."""
    values = {
        name: param.value
        for name, param in vehicle.params.items()
        if name.startswith(("ATC_", "LOIT_", "PSC_", "WPNAV_")) and isinstance(param.value, float)
    }
    return written({name: values[name] + 1.0 for name in [*values][:count]})


def reads_after_the_last_set(tap: Tap) -> list[str]:
    """Return the names that were read by name after the last write."""
    received = [message for _, _, message in tap.received]
    last = max(place for place, message in enumerate(received) if isinstance(message, messages.ParamSet))
    return [each.param_id for each in received[last + 1 :] if isinstance(each, messages.ParamRequestRead)]


@in_simulated_time
async def test_twenty_values_over_a_radio_take_one_download_and_are_verified_by_name() -> None:
    tap = on_a_radio(vehicle := ardupilot_on_a_serial_port())
    wanted = tuned(vehicle, 21)
    first, *changed = wanted
    assert len(changed) == 20
    as_it_is = vehicle.params[first].value
    wanted = written({first: as_it_is, **{name: wanted[name].value for name in changed}})
    async with a_client(tap) as client:
        component = await client.component()
        result = await apply(component, wanted)
    assert result.complete
    assert statuses(result) == {**dict.fromkeys(changed, "accepted"), first: "unchanged"}
    assert result.elapsed <= 6.5
    assert downloads(tap) == 1
    assert sorted(reads_after_the_last_set(tap)) == sorted(wanted)
