"""Set-ups that the service has not brought to their end: noted when they begin, and reported at the next
start."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
from pathlib import Path
from typing import Any

import anyio
import pytest

from paramclient.cache import InterruptedSetup, SetupNotes
from paramclient.cache.interrupted_setups import INTERRUPTED_MAX, NOTE_BYTES_MAX, RunningSetup
from paramclient.errors import CacheError
from paramclient.links import create_link, serve_endpoint
from paramclient.protocol import wire
from tests.commands import in_process
from tests.service.test_process import C, ended, served
from tests.service.test_setup import HERE, TUNE, Checked, Quiet, px4, serving
from tests.shell import TIMEOUT, Clock, Tap, in_simulated_time, small_px4

# Notes


@pytest.fixture
def clock() -> Clock:
    return Clock(1_000.0)


@pytest.fixture
def notes(tmp_path: Path, clock: Clock) -> SetupNotes:
    return SetupNotes(tmp_path / "cache.interrupted_setups", clock=clock)


def begun(notes: SetupNotes, name: str = "a1") -> RunningSetup:
    return notes.begin(name, "apply", link="sim:", system=1, component=1, requested_by="anna", key=None)


def died(running: RunningSetup) -> None:
    """What the system does for a process that was killed."""
    os.close(running._descriptor)


def test_a_running_or_ended_set_up_is_not_cut_off(notes: SetupNotes) -> None:
    assert notes.cut_off() == []
    running = begun(notes)
    assert notes.cut_off(mark_reported=True) == []
    running.end()
    assert notes.cut_off() == []
    assert list(notes.folder.iterdir()) == []


def test_one_whose_process_has_died_is_reported_once(notes: SetupNotes, clock: Clock) -> None:
    running = begun(notes)
    clock.now += 5
    running.note(done=3, total=20, key="uid:1")
    clock.now += 0.5
    running.note(done=4, total=20, key="uid:1")
    died(running)
    expected = InterruptedSetup("a1", "apply", "uid:1", "sim:", 1, 1, "anna", 1_000.0, 1_005.0, 3, 20)
    assert notes.cut_off() == [expected]
    assert notes.cut_off(mark_reported=True) == [expected]
    assert [note.is_reported for note in notes.cut_off(mark_reported=True)] == [True]


def test_a_set_up_cut_off_by_the_end_of_the_service_has_its_progress(notes: SetupNotes, clock: Clock) -> None:
    running = begun(notes)
    running.note(done=3, total=20, key=None)
    running.note(done=9, total=20, key=None)
    running.cut_off()
    [note] = notes.cut_off()
    assert (note.done, note.total) == (9, 20)


def test_a_note_is_its_owners_alone_and_bounded(notes: SetupNotes, clock: Clock) -> None:
    running = begun(notes)
    path = notes.folder / "a1.json"
    assert path.stat().st_mode & 0o777 == 0o600
    assert notes.folder.stat().st_mode & 0o777 == 0o700
    for _ in range(5_000):
        clock.now += 1
        running.note(done=1, total=20, key="uid:1")
    assert path.stat().st_size <= NOTE_BYTES_MAX
    died(running)
    assert len(notes.cut_off()) == 1


def test_those_cut_off_last_are_kept(notes: SetupNotes, clock: Clock) -> None:
    for number in range(INTERRUPTED_MAX + 5):
        clock.now += 1
        died(begun(notes, f"job{number}"))
    kept = notes.cut_off(mark_reported=True)
    assert [kept[0].id, kept[-1].id, len(kept)] == ["job5", f"job{INTERRUPTED_MAX + 4}", INTERRUPTED_MAX]
    assert len(list(notes.folder.iterdir())) == INTERRUPTED_MAX


@pytest.mark.parametrize(
    "content",
    [
        *(b"", b"{", b"[]\n", b"{}\n", b"\xff\n", b"[" * 60_000 + b"\n", b'{"id": "a1"}\n', b"null\n"),
        json.dumps({"id": "b2", "kind": "apply"}).encode() + b"\n",
        b'{"id":"a1","kind":"apply","key":null,"link":"","system":1e999,"component":1,"requested_by":"","began":1,"at":1}\n',
    ],
)
def test_a_file_that_is_no_note_is_ignored(notes: SetupNotes, content: bytes) -> None:
    notes.folder.mkdir()
    (notes.folder / "a1.json").write_bytes(content)
    (notes.folder / "c3.json").symlink_to("/dev/zero")
    os.mkfifo(notes.folder / "d4.json")
    assert notes.cut_off(mark_reported=True) == []


def test_a_set_up_that_cannot_be_noted_does_not_begin(tmp_path: Path) -> None:
    (tmp_path / "cache.interrupted_setups").write_text("a file in its place")
    with pytest.raises(CacheError, match="the note of the set-up cannot be written to"):
        begun(SetupNotes(tmp_path / "cache.interrupted_setups"))


# The service


async def set_ups(service: Checked) -> list[dict[str, Any]]:
    jobs = (await service.get("/api/v1/jobs"))["jobs"]
    return [job for job in jobs if job["kind"] != "fetch"]


BODY = {"wanted": {"values": dict.fromkeys(TUNE, 7.5)}, "wait": False}


@in_simulated_time
async def test_an_apply_that_the_end_of_the_service_cuts_off_is_reported_at_the_next_start(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    async with serving(Quiet(px4()), place=tmp_path) as service:
        job = (await service.client.post(f"{HERE}/apply", json=BODY)).json()["id"]
        reported = await service.job(
            job, lambda reported: reported["progress"] and reported["progress"]["done"] >= 5
        )
        assert reported["state"] == "running"
    caplog.clear()
    async with serving(px4(), place=tmp_path) as service:
        [line] = [message for message in caplog.messages if "cut off" in message]
        assert line.startswith("an apply of 1/1 on sim:0, started by local at 20")
        assert line.endswith("of 20 values by the end of the service")
        [listed] = await set_ups(service)
        assert (listed["id"], listed["state"], listed["requested_by"]) == (job, "cut-off", "local")
        assert listed["progress"]["done"] >= 5
        assert listed["problem"]["type"] == "urn:paramclient:cut-off"
        assert await service.get(f"/api/v1/jobs/{job}") == listed
        history = await service.get(f"{HERE}/history", limit=1_000)
        [cut] = history["cut_off"]
        assert (cut["kind"], cut["by"], cut["total"]) == ("apply", "local", 20)
        assert 5 <= cut["done"] <= 13, "what failed at the end was not written"
        assert "cut_off" not in await service.get(f"{HERE}/history", name="TUNE_01")
        assert "cut_off" not in await service.get(f"{HERE}/history", before=1_000.0)
        whole = (await service.client.post(f"{HERE}/apply", json={**BODY, "wait": True})).json()
        assert whole["complete"]
        assert len(await set_ups(service)) == 2
    caplog.clear()
    async with serving(px4(), place=tmp_path) as service:
        assert not [message for message in caplog.messages if "cut off" in message], "it was reported"
        [listed] = await set_ups(service)
        assert listed["id"] == job
    outcome = in_process(capsys, "--cache", str(tmp_path / "cache.sqlite3"))("history", "1")
    [line] = [line for line in outcome.out.splitlines() if "cut off" in line]
    assert "(apply cut off)" in line
    assert "of 20 values" in line
    assert line.endswith("local")


@in_simulated_time
async def test_a_cancelled_set_up_is_not_cut_off(tmp_path: Path) -> None:
    async with serving(Quiet(px4()), place=tmp_path) as service:
        job = (await service.client.post(f"{HERE}/apply", json=BODY)).json()["id"]
        await service.job(job, lambda reported: reported["progress"] and reported["progress"]["done"])
        await service.client.delete(f"/api/v1/jobs/{job}")
        await service.job(job, lambda reported: reported["state"] == "cancelled")
    async with serving(px4(), place=tmp_path) as service:
        assert await set_ups(service) == []


class Mute(Tap):
    """Says nothing any more after some writes."""

    def receive(self, data: bytes, now: float) -> None:
        super().receive(data, now)
        self.is_mute = len(self.messages(wire.ParamSetMessage)) > 12


@pytest.mark.asyncio
async def test_an_apply_whose_process_is_killed_is_reported_at_the_next_start(tmp_path: Path) -> None:
    await reported_after_a_kill(str(tmp_path / "cache.sqlite3"))


async def reported_after_a_kill(cache: str) -> None:
    """A service with this cache is killed while it applies values; the next one mark_reported that."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    async with anyio.create_task_group() as tasks:
        await tasks.start(serve_endpoint, Mute(small_px4()), create_link(f"tcpin:127.0.0.1:{port}"))
        async with served(f"tcp:127.0.0.1:{port}", "--cache", cache) as (process, browser):
            await browser.post("/api/v1/find", json={})
            await browser.post(f"{C}/fetch", json={})
            body = {"wanted": {"values": {f"PARAM_{number:02}": 77 for number in range(20)}}, "wait": False}
            job = (await browser.post(f"{C}/apply", json=body)).json()["id"]
            with anyio.fail_after(TIMEOUT):
                reported: dict[str, Any] = {}
                while not (reported.get("progress") or {}).get("done"):
                    await asyncio.sleep(0.02)
                    reported = (await browser.get(f"/api/v1/jobs/{job}")).json()
            assert reported["state"] == "running"
            process.kill()
            await process.wait()
        tasks.cancel_scope.cancel()
    async with served(f"tcp:127.0.0.1:{port}", "--cache", cache) as (process, browser):
        [listed] = (await browser.get("/api/v1/jobs")).json()["jobs"]
        assert (listed["id"], listed["state"]) == (job, "cut-off")
        process.send_signal(signal.SIGTERM)
        code, err = await ended(process)
    assert code == 0
    assert "started by local at" in err
    assert "was cut off" in err
