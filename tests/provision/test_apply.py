"""`apply` and `restore` on simulated vehicles: order, verification, failures, reboots."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import anyio
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from paramclient import ParamCache, ParamClient
from paramclient.errors import AnotherVehicle, CacheError, LinkError, NoReply, UsageError, VehicleArmed
from paramclient.model.paramset import ParamSet
from paramclient.model.values import ParamType
from paramclient.protocol.ftp import Opcode, Packet
from paramclient.provision import MISSING, ApplyProgress, ApplyResult, ApplyStatus, apply, plan, restore
from paramclient.provision.apply_restore import for_each, load_restore_point, restore_categories
from paramclient.sim import Air, ArduPilotVehicle, FaultyLink, PX4Vehicle, SimParam
from paramclient.wire import frames, messages
from tests.caches import PX4
from tests.shell import FlakyLink, Tap, a_client, clamped, in_simulated_time, residue

Table: TypeAlias = dict[str, Any]
"""Values by name, or their types and values."""
Vehicle: TypeAlias = ArduPilotVehicle | PX4Vehicle

SETTINGS: Table = {f"TUNE_{number:02}": number if number % 3 == 0 else number / 4 for number in range(30)}
"""Parameters that most of these tests set."""
WANTED: Table = {name: value + 1 for name, value in SETTINGS.items()}
"""Values that differ from those of SETTINGS."""
OTHERS: Table = {
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
GROUP: Table = {"EK2_ALT_M_NSE": 3.0, "EK2_GPS_TYPE": (ParamType.INT8, 0)}
CLAMPED: Table = {
    "MPC_TILTMAX_AIR": 45.0,
    "MPC_TILTMAX_LND": 12.0,
    "MPC_XY_VEL_MAX": 12.0,
    "MPC_XY_CRUISE": 5.0,
    "MPC_VEL_MANUAL": 10.0,
}
"""Parameters that PX4's position controller clamps."""


class HidingGroup(ArduPilotVehicle):
    """An ArduPilot that answers no reads by name for the parameters of a hidden group."""

    def respond(self, message: messages.Message, sender: frames.Frame) -> None:
        if not (name := getattr(message, "param_id", "")) or name in self.params:
            super().respond(message, sender)


class ClampingVehicle(ArduPilotVehicle):
    """An ArduPilot that keeps TUNE_01 within 0 to 10."""

    def respond(self, message: messages.Message, sender: frames.Frame) -> None:
        super().respond(clamped(message, "TUNE_01", 0.0, 10.0), sender)


def ardupilot(make: type[ArduPilotVehicle] = ArduPilotVehicle, **options: Any) -> ArduPilotVehicle:
    more: dict[str, Any] = {"table": SETTINGS | OTHERS, "groups": {"EK2_ENABLE": GROUP}}
    return make(**more | options)


def px4(**options: Any) -> PX4Vehicle:
    values = {
        name: entry[1] if isinstance(entry, tuple) else entry
        for name, entry in (SETTINGS | OTHERS | GROUP).items()
    }
    rows = [
        SimParam(name, 9 if isinstance(value, float) else 6, value, name == "CAL_ACC0_XOFF")
        for name, value in values.items()
    ]
    group = list(GROUP)
    more: dict[str, Any] = {"table": rows, "not_in_use": group, "late_use": {"EK2_ENABLE": group}}
    return PX4Vehicle(**more | options)


EVERY_KIND = pytest.mark.parametrize("make", [ardupilot, px4], ids=["ardupilot", "px4"])


def some(*names: str) -> Table:
    return {name: WANTED[name] for name in names}


async def applied(far_end: Any, wanted: Table, **options: Any) -> ApplyResult:
    """Apply values in a session of its own."""
    async with a_client(far_end) as client:
        return await apply(await client.component(), wanted, **options)


def statuses(result: ApplyResult) -> dict[str, str]:
    return {name: str(row.status) for name, row in result.rows.items()}


def sets(tap: Tap) -> list[str]:
    """Return the names of the written parameters, once each, in order."""
    return list(dict.fromkeys(message.param_id for message in tap.messages(messages.ParamSet)))


@EVERY_KIND
@pytest.mark.parametrize("loss", [0.0, 0.15])
async def test_all_values_are_written_and_verified(make: Callable[[], Vehicle], loss: float) -> None:
    vehicle = make()
    air = Air([vehicle], uplink=FaultyLink(loss=loss, seed=1), downlink=FaultyLink(loss=loss, seed=2))
    wanted = {**WANTED, "STAT_RUNTIME": 6, "CAL_ACC0_XOFF": 1.0, "COMPASS_OFS_X": 1.0, "EK2_GPS_TYPE": 3}
    async with a_client(air) as client:
        component = await client.component()
        result = await apply(component, wanted | {"EK2_ENABLE": 1})
        await anyio.sleep(3.0)  # the client requests the hash after writes
        assert residue(component) == []
    assert (result.complete, result.error) == (True, None)
    left_out = {row.name for row in result.of(ApplyStatus.SKIPPED)}
    assert left_out == ({"STAT_RUNTIME", "COMPASS_OFS_X"} if make is ardupilot else {"CAL_ACC0_XOFF"})
    for name, value in wanted.items():
        assert (vehicle.param(name).value == value) is (name not in left_out), name
    row = result.rows["TUNE_03"]
    assert (row.status, row.before, row.actual) == ("accepted", 3, 4)
    assert "FRAME_CLASS" in result.extra


async def test_a_value_that_is_not_reported_any_more_is_unproven() -> None:
    vehicle = ardupilot(ftp=False)

    def lose(progress: ApplyProgress) -> None:
        if progress.row is not None and progress.row.name == "TUNE_02":
            assert progress.row.status is ApplyStatus.UNPROVEN, "not read back yet"
            vehicle.set_param("TUNE_01", 0)
            vehicle.dead = ["TUNE_01"]

    result = await applied(vehicle, some("TUNE_01", "TUNE_02"), progress=lose)
    assert statuses(result) == {"TUNE_01": "unproven", "TUNE_02": "accepted"}
    assert "no longer reports it" in str(result.rows["TUNE_01"])
    assert not result.complete


async def test_a_refused_or_adjusted_value_does_not_stop_the_others() -> None:
    vehicle = ardupilot(ClampingVehicle, read_only=["TUNE_02", "TUNE_04"], param_error=True)
    async with a_client(vehicle) as client:
        component = await client.component()
        result = await apply(component, WANTED | {"TUNE_01": 99.0})
        again = await apply(component, WANTED | {"TUNE_01": 99.0})
    refused = {"TUNE_02": "refused", "TUNE_04": "refused"}
    assert statuses(result) == dict.fromkeys(SETTINGS, "accepted") | refused | {"TUNE_01": "adjusted"}
    assert result.rows["TUNE_01"].actual == 10.0
    assert "read only" in result.rows["TUNE_02"].reason
    assert result.rows["TUNE_02"].actual == SETTINGS["TUNE_02"]
    assert (result.complete, result.error) == (False, None)
    # the vehicle has the adjusted value already, and gives no reason for not changing it
    assert statuses(again) == dict.fromkeys(SETTINGS, "unchanged") | refused | {"TUNE_01": "refused"}


async def test_the_state_is_stored_before_a_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache, tap = ParamCache(tmp_path / "cache.sqlite3"), Tap(ardupilot())

    def fail(*_: object, **__: object) -> None:
        raise CacheError("the disk is full")

    def failing(_: ApplyProgress) -> None:
        raise RuntimeError("raised in progress")

    async with ParamClient(tap, cache=cache) as client:
        component = await client.component()
        with monkeypatch.context() as broken:
            broken.setattr(ParamCache, "store_snapshot", fail)
            with pytest.raises(CacheError, match=r"nothing was sent, .*--no-cache"):
                await apply(component, some("TUNE_01"))
        with pytest.raises(TypeError, match="no option 'dry_run'"):
            await apply(component, some("TUNE_01"), dry_run=True)  # type: ignore[call-arg]
        with pytest.raises(TypeError, match="no option 'inclde'; see PlanOptions"):
            await plan(component, some("TUNE_01"), inclde="identity")  # type: ignore[call-arg]
        with pytest.raises(UsageError, match="a timeout is a number of seconds"):
            await apply(component, some("TUNE_01"), timeout=-1)
        with pytest.raises(RuntimeError, match="raised in progress"):  # and no coroutine is left unawaited
            await apply(component, some("TUNE_01"), progress=failing)
        with pytest.raises(UsageError, match=r"a\.json: nothing was sent: cannot be written: "):
            await apply(component, some("TUNE_01"), backup=tmp_path / "no folder" / "a.json")
        assert sets(tap) == []
        first = await apply(component, some("TUNE_01"))
        await apply(component, some("TUNE_01"), backup=tmp_path / "a.json")  # nothing to write, no snapshot
        with pytest.raises(UsageError, match=r"nothing was sent: the backup file .*a\.json exists already"):
            await apply(component, some("TUNE_02"), backup=tmp_path / "a.json")
        key = component.identity.key
    (summary,) = cache.snapshots(key, 1)
    assert summary.reason == "before apply"
    assert dict(first.before) == dict(cache.state_at(key, 1, summary.id))
    assert first.before["TUNE_01"].value == SETTINGS["TUNE_01"]


async def test_a_failed_link_ends_the_run_with_the_rows_so_far() -> None:
    link = FlakyLink(ardupilot())
    async with a_client(link) as client:
        component = await client.component()
        async with anyio.create_task_group() as tasks:

            def cut(progress: ApplyProgress) -> None:
                if progress.phase == "writing" and progress.done == 5:
                    tasks.start_soon(lambda: link.drop(stays_offline=True))

            result = await apply(component, WANTED, progress=cut)
        assert isinstance(result.error, LinkError)
        assert result.counts[ApplyStatus.NOT_TRIED] > 0
        with pytest.raises(LinkError):  # nothing was sent this time
            await apply(component, WANTED)
        link.is_offline = False
        await anyio.sleep(10)
        assert (await apply(component, WANTED)).complete


async def test_the_timeout_ends_the_run() -> None:
    async with a_client(Air.symmetric([ardupilot()], rate=1000.0)) as client:
        component = await client.component()
        with pytest.raises(NoReply, match="the apply to 1/1"):
            await apply(component, WANTED, timeout=0.1)
        await plan(component, WANTED)
        began = anyio.current_time()
        await plan(component, WANTED)  # as the run will begin: the table is proven
        limit = anyio.current_time() - began + 0.5
        result = await apply(component, WANTED, timeout=limit)
        assert result.elapsed < limit + 0.5
        assert "no reply: the apply to 1/1" in str(result.error)
        assert "sent, not acknowledged" in {row.reason[:22] for row in result.of(ApplyStatus.UNKNOWN)}
        assert result.of(ApplyStatus.NOT_TRIED)
        assert residue(component) == []


async def test_restore_skips_measured_and_read_only_parameters() -> None:
    own = {"BARO1_GND_PRESS": 94500.0, "BARO1_DEVID": 65540, "INS_GYROFFS_X": 0.25, "LOCKED": 1.0}
    read_only = ["BARO1_GND_PRESS", "BARO1_DEVID", "LOCKED"]
    tap = Tap(vehicle := ardupilot(table=SETTINGS | OTHERS | own, read_only=read_only, live_period=0.0))
    async with a_client(tap) as client:
        component = await client.component()
        before = (await apply(component, some("TUNE_01"))).before
        for name in own:
            vehicle.set_param(name, 9)
        result = await restore(component, before)
        assert result.complete
        assert set(sets(tap)) == {"LOCKED", "TUNE_01"}
        assert {row.name: (row.category, row.actual) for row in result.shown_rows} == {
            "TUNE_01": ("", 0.25),
            **dict.fromkeys(read_only, ("read-only", 9)),
            "INS_GYROFFS_X": ("measured", 9),
        }
        assert "the vehicle reports that it is read-only" in str(result.rows["LOCKED"])
        # `apply` of this parameter alone reports the refusal
        assert statuses(await apply(component, {"LOCKED": 1.0})) == {"LOCKED": "refused"}


async def test_the_state_of_another_vehicle_is_refused() -> None:
    async with a_client(ardupilot()) as client:
        component = await client.component()
        with pytest.raises(UsageError, match="is that of another vehicle: the ardupilot 616e6f74686572"):
            await restore(component, (await applied(ardupilot(uid2=b"another"), {})).before)
        unknown = SETTINGS | {f"X_{number}": 1.0 for number in range(50)}
        with pytest.raises(UsageError, match="most parameters of the state are not on this vehicle"):
            await restore(component, unknown)
        with pytest.raises(UsageError, match=r"X_19: not on this vehicle\nand 30 more$"):
            await apply(component, unknown)


async def test_a_simulator_has_the_hardware_id_of_its_state_on_another_link() -> None:
    async with a_client(px4()) as client:
        component = await client.component()
        await apply(component, {})  # identifies it
        state = ParamSet({}, identity=replace(component.identity, link="udpin:0.0.0.0:14559"))
        assert "calibration" in await restore_categories(component, state)


def test_an_apply_continues_only_a_recent_one(tmp_path: Path) -> None:
    with ParamCache(tmp_path / "cache") as cache:
        for at in (1e9, 1.1e9, 1.1e9 + 100):
            cache.store_snapshot(PX4, 1, ParamSet({}), reason="before apply", at=at, is_of_operation=True)
        assert load_restore_point(cache, PX4.key, 1).snapshot == 2


async def test_a_vehicle_armed_during_the_run_ends_it() -> None:
    vehicle = ardupilot()

    def arm(progress: ApplyProgress) -> None:
        vehicle.armed = vehicle.armed or progress.row is not None

    async with a_client(vehicle) as client:
        component = await client.component()
        result = await apply(component, {"EK2_ENABLE": 1, "EK2_NO_SUCH": 1}, progress=arm)
        assert statuses(result)["EK2_ENABLE"] == "accepted"
        await anyio.sleep(2)
        with pytest.raises(VehicleArmed):
            await apply(component, WANTED)


async def test_a_reboot_follows_values_that_take_effect_after_it() -> None:
    tap = Tap(vehicle := ardupilot(HidingGroup, reboot_groups=["EK2_ENABLE"]))
    wanted = some("TUNE_01") | {"EK2_ALT_M_NSE": 1.5, "EK2_ENABLE": 1, "FRAME_CLASS": 2}
    phases: list[str] = []
    async with a_client(tap) as client:
        component = await client.component()
        awaiting = await apply(component, wanted)
        assert (awaiting.reboots, awaiting.reboot_required) == (0, ("FRAME_CLASS", "EK2_ENABLE"))
        assert awaiting.rows["EK2_ALT_M_NSE"].category == MISSING
        assert (await plan(component, wanted)).awaiting_reboot == ("EK2_ENABLE",)
        tap.received.clear()
        result = await apply(component, wanted, reboot=True, progress=lambda now: phases.append(now.phase))
    assert result.complete
    assert (result.reboots, result.reboot_required) == (1, ())
    assert sets(tap) == ["EK2_ALT_M_NSE"], "revealed by the reboot"
    assert list(dict.fromkeys(phases)) == ["reading", "rebooting", "writing"]
    assert vehicle.param("EK2_ALT_M_NSE").value == 1.5


# The system id


@EVERY_KIND
async def test_a_changed_system_id_is_followed(make: Callable[..., Vehicle]) -> None:
    vehicle, name = (ardupilot(), "SYSID_THISMAV") if make is ardupilot else (px4(uid=77), "MAV_SYS_ID")
    tap = Tap(vehicle)
    async with a_client(tap) as client:
        wanted = {name: 7} | some("TUNE_01", "TUNE_02")
        result = await apply(await client.component(), wanted, include=[name], reboot=True)
        assert result.complete, result
        assert (result.system, result.component, result.reboots) == (7, 1, 1)
        assert (vehicle.system, vehicle.param(name).value, sets(tap)[-1]) == (7, 7, name)
        assert client.components[7, 1].state == "synced"
        await anyio.sleep(5.0)  # what is measured at a start is read again
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
async def test_a_system_id_takes_effect_at_once_or_after_a_reboot(
    options: dict[str, Any], wanted: list[int], status: str, reboots: bool | None, system: int
) -> None:
    vehicle = ardupilot(**options)
    async with a_client(vehicle) as client:
        component = await client.component()
        for each in wanted:
            result = await apply(component, {"SYSID_THISMAV": each}, include="identity")
            assert statuses(result) == {"SYSID_THISMAV": status}
        if reboots:
            again = await plan(component, {"SYSID_THISMAV": 7}, include="identity")
            assert again.awaiting_reboot == ("SYSID_THISMAV",) * (status == "accepted")
    assert (result.system, vehicle.system, result.reboots) == (system, system, 0)
    if status == "accepted" and reboots is not None:
        assert result.plan.reboot_for == result.reboot_required == ("SYSID_THISMAV",) * reboots


async def test_a_system_id_of_another_vehicle_is_not_set() -> None:
    """Nor one that another vehicle gets at its next start, or by another call at the same time."""
    vehicles = [ardupilot(), ardupilot(system=7)]
    async with a_client(tap := Tap(Air(vehicles))) as client:
        one, two = await client.component(1, 1), await client.component(7, 1)
        wanted: Table = {"SYSID_THISMAV": 7} | some("TUNE_01")
        assert [*(await plan(one, wanted, include="identity")).problems] == ["SYSID_THISMAV"]
        with pytest.raises(UsageError, match="SYSID_THISMAV: another vehicle on this link"):
            await apply(one, wanted, include="identity")
        assert not sets(tap)
        result = await apply(one, wanted, include="identity", partial=True)
        assert statuses(result) == {"SYSID_THISMAV": "refused", "TUNE_01": "accepted"}
        wanted["SYSID_THISMAV"] = 9
        for _ in range(2):
            both = await for_each([one, two], lambda each: apply(each, wanted, include="identity"))
            assert len(both.results) == len(both.errors) == 1
    assert [vehicle.values["SYSID_THISMAV"] for vehicle in vehicles] in ([9, 7], [1, 9])


@pytest.mark.parametrize("sent", [0, len(SETTINGS)])
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
                result = await apply(component, WANTED)
            assert isinstance(result.error, AnotherVehicle)
        else:
            with pytest.raises(AnotherVehicle):
                await apply(component, WANTED, before_writing=exchange)
    assert (vehicle.requests["PARAM_SET"], other.requests["PARAM_SET"]) == (sent, 0)


# Interruptions


def scenario(kind: str) -> tuple[Vehicle, Table, dict[str, Any]]:
    """A vehicle, its wanted parameters and the options of `apply`; identical each time."""
    wanted = {**WANTED, "EK2_ALT_M_NSE": 1.5, "EK2_ENABLE": 1, "SMALL": 7}
    if kind == "ardupilot":
        return ardupilot(), wanted, {}
    if kind == "px4":
        return px4(uid=77), wanted, {}
    options: dict[str, Any] = {"reboot": True, "include": "identity"}
    if kind == "ardupilot that starts":
        vehicle = ardupilot(HidingGroup, reboot_groups=["EK2_ENABLE"])
        return vehicle, wanted | {"FRAME_CLASS": 2, "SYSID_THISMAV": 7}, options
    return px4(uid=77), wanted | {"SYS_AUTOSTART": 4050, "MAV_SYS_ID": 7}, options


async def interrupted(
    air: Air, wanted: Table, cache: ParamCache, *, frames: int, how: str, **options: Any
) -> None:
    """Run `apply` until the station has sent `frames` frames; then end the session in the way of `how`."""
    scope = anyio.CancelScope()

    class Ending(Tap):
        def receive(self, data: bytes, now: float) -> None:
            super().receive(data, now)
            if len(self.received) < frames or self.is_deaf:
                return
            if how == "kill":  # nothing more is written to the disk
                client.core.cache_writer.cache = None
            if how == "silence":
                self.is_deaf = self.is_mute = True
            else:
                scope.cancel()

    with scope, suppress(NoReply):
        async with ParamClient(Ending(air), cache=cache) as client:
            result = await apply(await client.component(), wanted, **options)
            assert result.complete or isinstance(result.error, NoReply)


@pytest.mark.parametrize("kind", ["ardupilot", "px4", "ardupilot that starts", "px4 that starts"])
@settings(max_examples=15, deadline=None, derandomize=True)
@example(frames=31, how="cancel", loss=0.1, seed=189)  # the acknowledgement of the reboot is lost
@given(
    frames=st.integers(1, 160),
    how=st.sampled_from(["cancel", "kill", "silence"]),
    loss=st.sampled_from([0.0, 0.0, 0.1]),
    seed=st.integers(0, 1000),
)
def test_the_next_run_completes_after_an_interruption_anywhere(
    kind: str, frames: int, how: str, loss: float, seed: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    vehicle, wanted, options = scenario(kind)

    def truth() -> Table:
        return {entry.name: entry.value for entry in vehicle.entries}  # hidden ones included

    @in_simulated_time
    async def run() -> None:
        before = truth()
        with ParamCache(tmp_path_factory.mktemp("cache") / "cache.sqlite3") as cache:
            air = Air.symmetric([vehicle], loss=loss, seed=seed)
            await interrupted(air, wanted, cache, frames=frames, how=how, **options)
            async with ParamClient(Air.symmetric([vehicle], loss=loss, seed=seed + 1), cache=cache) as client:
                result = await apply(await client.component(), wanted, **options)
            assert result.complete, result.rows
            assert truth() == before | wanted
            assert vehicle.system == result.system == (7 if kind.endswith("that starts") else 1)
            (key,) = [known.key for known in cache.vehicles() if known.identity.uid is not None]
            history = cache.history(key)
            first = cache.state_at(key, 1, cache.snapshots(key)[0].id)
        # the cache has the state before the first write, and every change from it to the present state
        assert {name: param.value for name, param in first.items()} == {name: before[name] for name in first}
        for name in before.keys() - GROUP.keys():  # these appear and disappear with their switch
            assert name in first
            lines = [line for line in history if line.name == name]
            steps = [(line.old.value, line.new and line.new.value) for line in lines]
            assert all(earlier[1] == later[0] for earlier, later in itertools.pairwise(steps)), steps
            ends = (steps[0][0], steps[-1][1]) if steps else (before[name], before[name])
            assert ends == (before[name], wanted.get(name, before[name])), steps
            assert all(old != new for old, new in steps)

    run()


# Values that the vehicle changes after its acknowledgement


async def test_the_actual_value_is_what_the_vehicle_sent_last() -> None:
    vehicle = ardupilot(ClampingVehicle)

    def change(progress: ApplyProgress) -> None:
        if progress.row is not None and progress.row.name == "TUNE_02":
            vehicle.set_param("TUNE_02", 3.0)

    async with a_client(vehicle) as client:
        component = await client.component()
        result = await apply(component, {"TUNE_01": 99.0, "TUNE_02": 4.5}, progress=change)
        actual = {name: row.actual for name, row in result.rows.items()}
        assert actual == {name: component.params[name].value for name in result.rows}
        assert (await plan(component, ParamSet({"TUNE_01": 10}))).complete


@pytest.mark.parametrize("delay", [0.02, 0.8, 1.1])
async def test_a_value_clamped_within_a_second_is_adjusted(delay: float) -> None:
    vehicle = PX4Vehicle(table=SETTINGS | CLAMPED, clamp_delay=delay)
    result = await applied(vehicle, {"MPC_TILTMAX_LND": 80.0, "TUNE_01": 9.5, "MPC_XY_CRUISE": 6.0})
    assert [*statuses(result).values()] == ["adjusted", "accepted", "accepted"]
    row = result.rows["MPC_TILTMAX_LND"]
    assert (row.before, row.actual, result.complete) == (12.0, 45.0, False)
    assert "changed it afterwards" in row.reason
    assert vehicle.requests["PARAM_SET"] == 4  # once more: a later write may have changed it


async def test_a_value_clamped_by_another_wanted_value_is_set_with_the_second_attempt() -> None:
    vehicle = PX4Vehicle(table=SETTINGS | CLAMPED, clamp_delay=0.0)
    assert (await applied(vehicle, {"MPC_XY_CRUISE": 18.0, "MPC_XY_VEL_MAX": 19.0})).complete


async def test_twenty_values_over_a_radio_take_one_download_and_are_verified_by_name() -> None:
    vehicle = ArduPilotVehicle(live=(), burst=1, period=0.025, ftp_rate=5760.0)
    tap = Tap(Air.symmetric([vehicle], rate=5760.0, delay=0.02))  # a serial port of 57600 baud
    floats = {
        name: param.value
        for name, param in vehicle.params.items()
        if name.startswith(("ATC_", "LOIT_", "PSC_", "WPNAV_")) and isinstance(param.value, float)
    }
    wanted = {name: value + bool(place) for place, (name, value) in enumerate([*floats.items()][:21])}
    result = await applied(tap, wanted)
    assert result.complete
    assert [*statuses(result).values()] == ["unchanged", *["accepted"] * 20]
    assert result.elapsed <= 6.5
    packets = [Packet.unpack(message.payload) for message in tap.messages(messages.FileTransfer)]
    assert len({each.sequence for each in packets if each.opcode == Opcode.OPEN_FILE_RO}) == 1
    received = [message for _, _, message in tap.received]
    last = max(place for place, message in enumerate(received) if isinstance(message, messages.ParamSet))
    reads = [each for each in received[last + 1 :] if isinstance(each, messages.ParamRequestRead)]
    assert sorted(vehicle.listed[each.param_index].name for each in reads) == sorted(wanted)
