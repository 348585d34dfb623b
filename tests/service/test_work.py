"""What one request may cost the others: limits before anything is parsed, work in threads, quotas."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import threading
import tracemalloc
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import anyio
import httpx
import pytest
from fastapi import FastAPI
from fastapi.dependencies import utils as dependency_utils

from paramclient.documents.component import ComponentsDoc
from paramclient.documents.diff import DiffDoc, DifferenceDoc
from paramclient.documents.document import Document
from paramclient.documents.job import JobsDoc
from paramclient.documents.param import InfoDoc
from paramclient.errors import FileError, UsageError
from paramclient.files import conversion, dumps, loads
from paramclient.files.param_file import TooManyParams
from paramclient.metadata import Metadata, metadata_cache, read_content
from paramclient.model import comparison as compare_room
from paramclient.model import params as params_model
from paramclient.model import patterns
from paramclient.model.ext_params import ExtParam
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.patterns import NameChoice
from paramclient.model.values import Param, ParamType
from paramclient.provision import inspection
from paramclient.service import (
    AccessSettings,
    Hub,
    Settings,
    Tokens,
    create_app,
    followed_extended,
    jobs,
    metrics,
    responses,
)
from paramclient.service import hub as hub_room
from paramclient.service.access import AccessMiddleware
from paramclient.service.body_limits import DIGITS_MAX, LINE_BYTES_MAX, PARAM_FILE_BYTES_MAX, SEPARATORS_MAX
from paramclient.service.event_feed import BATCH_EVENTS_MAX
from paramclient.service.link import COMPONENTS_PER_TURN
from paramclient.service.param_sources import (
    PATTERNS_MAX,
    REQUEST_NAMES_MAX,
    REQUEST_VALUES_MAX,
    parse_upload,
)
from paramclient.service.problems import ServiceError
from paramclient.service.quota import (
    LARGE_GETS_OF_HOLDER_MAX,
    LONG_REQUESTS_OF_HOLDER_MAX,
    WAITING_REQUESTS_MAX,
    WAITING_REQUESTS_OF_HOLDER_MAX,
    Quota,
)
from paramclient.service.responses import (
    STREAMED_CHUNK_LENGTH,
    STREAMED_ENTRIES_MAX,
    encode_document,
    streamed_response,
)
from paramclient.service.route_context import run_until_disconnect
from paramclient.service.routes import apply as setup_room
from paramclient.service.routes import extended as extended_room
from paramclient.service.routes import params as params_room
from paramclient.sim import Camera, GenericVehicle, PX4Vehicle
from tests.asgi import a_browser
from tests.service_hub import C, met, problem, service
from tests.shell import Tap, in_simulated_time, until

TABLE = {f"ABC_{number % 5}_P{number:02}": float(number) for number in range(40)}
VALUES = {name: value + 1 for name, value in TABLE.items()}
LARGE = {f"ABC_{number % 50}_P{number:04}": float(number) for number in range(1_500)}
"""As many parameters as an autopilot has."""
A_FILE = {"content-type": "application/octet-stream"}
A_JSON = {"content-type": "application/json"}
READER = "paramclient files"
"""The thread in which that is done which requests bring."""


@contextmanager
def peak() -> Iterator[Callable[[], float]]:
    """Bytes that were in use at the most since the beginning, in MiB."""
    tracemalloc.start()
    try:
        yield lambda: tracemalloc.get_traced_memory()[1] / 2**20
    finally:
        tracemalloc.stop()


@contextmanager
def threads_of(monkeypatch: pytest.MonkeyPatch, *calls: tuple[Any, str]) -> Iterator[dict[str, set[str]]]:
    """The names of the threads in which functions run, by their names."""
    seen: dict[str, set[str]] = {name: set() for _, name in calls}

    def watched(name: str, function: Any) -> Any:
        def call(*args: Any, **kwargs: Any) -> Any:
            seen[name].add(threading.current_thread().name)
            return function(*args, **kwargs)

        return call

    with monkeypatch.context() as patch:
        for place, name in calls:
            patch.setattr(place, name, watched(name, getattr(place, name)))
        yield seen


async def fetched(browser: httpx.AsyncClient) -> None:
    await met(browser)
    assert (await browser.post(f"{C}/fetch", json={})).status_code == 200


def a_file(text: str, name: str = "a.parm") -> dict[str, Any]:
    return {"file": {"name": name, "text": text}}


# Patterns


def test_an_exact_name_is_looked_up_and_never_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    compared: list[str] = []

    def translate(text: str) -> str:
        compared.append(text)
        return "x"

    monkeypatch.setattr(patterns, "translate", translate)
    choice = NameChoice([*TABLE, "A*", "B?", "[C]"])
    assert compared == ["A*", "B?", "[C]"]
    assert choice.choose(TABLE.keys())[0] == TABLE.keys()


def test_names_and_patterns_choose_as_the_shell_does() -> None:
    names = ["MC_ROLL_P", "MC_PITCH_P", "SERVO1_TRIM", "SERVO12_TRIM", "A[1]"]
    assert NameChoice(["MC_*", "SERVO?_TRIM"]).choose(names) == ({*names[:3]}, "")
    assert NameChoice(["MC_ROLL_P", "A[[]1]"]).choose(names) == ({"MC_ROLL_P", "A[1]"}, "")
    assert NameChoice(["mc_*", "X", "MC_*"]).choose(names) == ({*names[:2]}, "X")
    many = NameChoice([f"X{number:02}" for number in range(30)]).choose(names)[1]
    assert many.endswith("X19 (and 10 more)")
    assert not NameChoice([]).has("A")
    wanted = ParamSet({name: WrittenParam(name, 1) for name in names})
    with pytest.raises(UsageError, match=r"no parameter is called MC_ROL [(]did you mean MC_ROLL_P[?][)]$"):
        wanted.only(["MC_ROL", "MC_PITCH_P"])


@in_simulated_time
async def test_a_request_has_few_patterns_and_many_names(monkeypatch: pytest.MonkeyPatch) -> None:
    many = [f"A*{number}" for number in range(10_000)]
    few = ["ABC_*", *[f"*{number % 40:02}" for number in range(PATTERNS_MAX - 1)]]
    async with service(GenericVehicle(table=TABLE)) as (_, browser):
        await fetched(browser)
        for path, member in (("diff", "only"), ("plan", "only"), ("plan", "include"), ("verify", "include")):
            body = {"wanted": {"values": VALUES}, member: many}
            reported = problem(await browser.post(f"{C}/{path}", json=body), 422, "invalid-request")
            assert f"at most {PATTERNS_MAX} of the names may be patterns" in reported["detail"]
            body = {"wanted": {"values": VALUES}, member: [*few, *TABLE]}
            assert (await browser.post(f"{C}/{path}", json=body)).status_code == 200
        body = {
            "wanted": {"values": VALUES},
            "only": [f"A{number}" for number in range(REQUEST_NAMES_MAX + 1)],
        }
        reported = problem(await browser.post(f"{C}/diff", json=body), 422, "invalid-request")
        assert str(REQUEST_NAMES_MAX) in reported["detail"]
        reported = problem(
            await browser.post("/api/v1/fleet/diff", json={"names": many[:500]}), 422, "invalid-request"
        )
        assert f"at most {PATTERNS_MAX}" in reported["detail"]

        with threads_of(monkeypatch, (params_room, "NameChoice")) as seen:
            answer = await browser.get(f"{C}/params", params={"names": few})
            assert answer.json()["params"].keys() == TABLE.keys()
        assert seen == {"NameChoice": {"paramclient files"}}
        query = {"names": many[: PATTERNS_MAX + 1]}
        problem(await browser.get(f"{C}/params", params=query), 422, "invalid-request")


# Sizes


BODIES: list[tuple[str, bytes]] = [
    ("unknown members", b"{" + b",".join(b'"a%d":0' % number for number in range(250_000)) + b"}"),
    ("empty objects", b'{"wanted":[' + b",".join([b"{}"] * 900_000) + b"]}"),
    ("values", json.dumps({"wanted": {"values": dict.fromkeys(range(110_000), 1)}}).encode()),
    ("brackets", b"[" * 3_000_000),
]


@pytest.mark.parametrize(("_", "body"), BODIES, ids=[name for name, _ in BODIES])
@in_simulated_time
async def test_a_body_with_too_many_values_is_not_parsed(
    _: str, body: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with service(GenericVehicle(table=TABLE)) as (_hub, browser):
        await fetched(browser)
        with threads_of(monkeypatch, (json, "loads")) as seen:
            answer = await browser.post(f"{C}/diff", content=body, headers=A_JSON)
        assert seen == {"loads": set()}
        assert problem(answer, 413, "too-large")["most"] == SEPARATORS_MAX


FILES: list[tuple[str, bytes]] = [
    ("a.json", b'{"paramclient":1,"sets":[' + b",".join([b"{}"] * 690_000) + b"]}"),
    ("a.parm", b"A 1\n" * 500_000),
]


@pytest.mark.parametrize(("name", "data"), FILES)
@in_simulated_time
async def test_a_file_with_too_many_values_is_not_read(name: str, data: bytes) -> None:
    """As it is, and in a body: with line ends and brackets it is the file that has too many."""
    assert len(data) <= PARAM_FILE_BYTES_MAX
    coded = {"file": {"name": name, "base64": base64.b64encode(data).decode()}}
    async with service(GenericVehicle(table=TABLE)) as (_, browser):
        await fetched(browser)
        with peak() as used:
            answer = await browser.post(f"/api/v1/files?name={name}", content=data, headers=A_FILE)
            assert problem(answer, 413, "too-large")["most"] == SEPARATORS_MAX
            answer = await browser.post(f"{C}/plan", json={"wanted": coded})
            assert problem(answer, 413, "too-large")["most"] == SEPARATORS_MAX
            assert used() < 40


@in_simulated_time
async def test_a_request_with_more_values_than_a_vehicle_has_is_refused() -> None:
    unknown = {f"U{number}": number for number in range(60_000)}
    text = "".join(f"U{number} 1\n" for number in range(REQUEST_VALUES_MAX + 1))
    vehicle = Tap(GenericVehicle(table=TABLE))
    async with service(vehicle) as (_, browser):
        await fetched(browser)
        vehicle.received.clear()
        answer = await browser.post(f"{C}/plan", json={"wanted": {"values": unknown}})
        assert problem(answer, 413, "too-large")["most"] == SEPARATORS_MAX
        few = dict(list(unknown.items())[: REQUEST_VALUES_MAX + 1])
        answer = await browser.post(f"{C}/plan", json={"wanted": {"values": few}})
        assert str(REQUEST_VALUES_MAX) in problem(answer, 422, "invalid-request")["detail"]
        for path in ("plan", "verify", "diff"):
            reported = problem(
                await browser.post(f"{C}/{path}", json={"wanted": a_file(text)}), 413, "too-large"
            )
            assert reported["most"] == REQUEST_VALUES_MAX
        answer = await browser.post("/api/v1/files?name=a.parm", content=text.encode(), headers=A_FILE)
        assert problem(answer, 413, "too-large")["most"] == REQUEST_VALUES_MAX
        assert not vehicle.received, "none of them is requested from the vehicle"


@in_simulated_time
async def test_a_whole_table_is_within_all_limits() -> None:
    """The page sends a whole file in base64, with the names that were chosen; programs send values."""
    text = "".join(f"{name},{value + 1}\n" for name, value in LARGE.items())
    coded = {"file": {"name": "a.param", "base64": base64.b64encode(text.encode()).decode()}}
    chosen = {"only": [*LARGE], "include": [*LARGE]}
    async with service(GenericVehicle(table=LARGE)) as (_, browser):
        await fetched(browser)
        planned = await browser.post(f"{C}/plan", json={"wanted": coded, **chosen})
        assert planned.json()["counts"]["set"] == len(LARGE)
        bits = {"values": {name: {"bits": "40d00000"} for name in LARGE}}
        compared = await browser.post(f"{C}/diff", json={"wanted": bits, "full": True})
        assert len(compared.json()["params"]) == len(LARGE)


@in_simulated_time
async def test_the_rows_of_a_comparison_are_written_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Thousands at once make full garbage collections long, in which no thread runs."""
    most, made = 0, weakref.WeakSet[DifferenceDoc]()
    create = DifferenceDoc.of

    def of(*args: Any) -> DifferenceDoc:
        nonlocal most
        document = create(*args)
        made.add(document)
        most = max(most, len(made))
        return document

    async with service(GenericVehicle(table=TABLE)) as (_, browser):
        await fetched(browser)
        body = {"wanted": {"values": VALUES}, "known": True}
        expected = (await browser.post(f"{C}/diff", json=body)).json()["params"]
        assert len(expected) == len(TABLE)
        monkeypatch.setattr(DifferenceDoc, "of", of)
        assert (await browser.post(f"{C}/diff", json=body)).json()["params"] == expected
    assert 1 <= most <= 2


# The first requests


@in_simulated_time
async def test_the_first_requests_build_neither_handlers_nor_models(monkeypatch: pytest.MonkeyPatch) -> None:
    """To build those of one router takes 30 ms and more, in which no other client is served."""
    built: list[str] = []
    analyze = dependency_utils.get_typed_signature

    def get_typed_signature(call: Callable[..., Any]) -> Any:
        built.append(repr(call))
        return analyze(call)

    async with service(GenericVehicle(table=TABLE)) as (_, browser):
        monkeypatch.setattr(dependency_utils, "get_typed_signature", get_typed_signature)
        documents = Document.__subclasses__()
        for document in documents:
            documents += document.__subclasses__()
        assert len(documents) > 50
        assert all(document.__pydantic_complete__ for document in documents)
        await fetched(browser)
        for path in ("components", "jobs", "links", "metadata", "history", "nothing", f"{C[8:]}/params"):
            await browser.get(f"/api/v1/{path}")
        assert not built
        create_app(Hub([], cache=False))
        assert built, "this is how FastAPI builds them"


# Errors, one by one


@pytest.mark.parametrize(
    ("path", "body", "where"),
    [
        ("diff", {f"a{number}": 0 for number in range(40_000)}, "body.a0"),
        ("diff", {"wanted": {f"a{number}": 0 for number in range(40_000)}}, "body.wanted.a0"),
        ("plan", {"wanted": {"values": {"A": 1}}, "only": [{}] * 25_000}, "body.only.0"),
        ("restore", {"include": [[]] * 9_000}, "body.include.0"),
    ],
)
@in_simulated_time
async def test_of_many_faults_of_one_kind_the_first_is_reported(
    path: str, body: dict[str, Any], where: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with service(GenericVehicle(table=TABLE)) as (_, browser):
        await fetched(browser)
        with threads_of(monkeypatch, (json, "loads")) as seen:
            answer = await browser.post(f"{C}/{path}", content=json.dumps(body).encode(), headers=A_JSON)
        places = [fault["where"] for fault in problem(answer, 422, "invalid-request")["faults"]]
        assert [place for place in places if place.startswith(where.rstrip("0"))] == [where]
        assert READER in seen["loads"]


@in_simulated_time
async def test_of_many_wrong_values_a_part_is_looked_at() -> None:
    body = json.dumps({"wanted": {"values": {f"A{number}": [] for number in range(5_000)}}}).encode()
    async with service(GenericVehicle(table=TABLE)) as (_, browser):
        await fetched(browser)
        with peak() as used:
            answer = await browser.post(f"{C}/plan", content=body, headers=A_JSON)
            reported = problem(answer, 422, "invalid-request")
            assert used() < 4
        assert reported["faults"][0]["where"].startswith("body.wanted.values.A0")


MANY = 3_000


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.json", '{"paramclient":1,"sets":[' + ",".join(["{}"] * MANY) + "]}"),
        ("a.json", '{"paramclient":1,"sets":[{' + ",".join(f'"A{n}":0' for n in range(MANY)) + "}]}"),
        (
            "a.json",
            '{"paramclient":1,"sets":[{"params":{' + ",".join(f'"A{n}":{{}}' for n in range(MANY)) + "}}]}",
        ),
    ],
    ids=["empty sets", "unknown members", "empty parameters"],
)
def test_the_faults_of_a_document_are_counted_and_not_kept(name: str, text: str) -> None:
    data = text.encode()
    with peak() as used:
        with pytest.raises(FileError) as caught:
            loads(data, source=name)
        assert used() < 2
    lines = str(caught.value).splitlines()
    assert len(lines) <= 21
    assert lines[-1].startswith("and ")
    assert int(lines[-1].split()[1]) >= MANY - 20


# Threads


@in_simulated_time
async def test_names_and_patterns_of_a_query_are_short() -> None:
    async with service(GenericVehicle(table=TABLE)) as (_, browser):
        await fetched(browser)
        for path in ("params", "metadata"):
            answer = await browser.get(f"{C}/{path}", params={"names": "[" * 65})
            assert answer.status_code == 422, path
        assert (await browser.get(f"{C}/params", params={"names": "[" * 64})).status_code == 200


@in_simulated_time
async def test_long_work_is_done_in_a_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    text = f"# {'long ' * 1_000}\n" + "".join(f"{name},{value}\n" for name, value in VALUES.items())
    calls = (
        *((json, "loads"), (setup_room, "compare"), (responses, "encode_document")),
        *((inspection, "plan"), (NameChoice, "choose")),
    )
    async with service(GenericVehicle(table=TABLE)) as (_, browser):
        await fetched(browser)
        with threads_of(monkeypatch, *calls) as seen:
            for path in ("diff", "plan", "verify"):
                body = json.dumps({"wanted": a_file(text, "a.param"), "only": ["ABC_*"]}).encode()
                answer = await browser.post(f"{C}/{path}", content=body, headers=A_JSON)
                assert answer.status_code == 200
        assert {name: threads for name, threads in seen.items() if threads != {READER}} == {}


@in_simulated_time
async def test_a_table_is_copied_out_in_a_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """A table may have thousands of names; each takes 5 µs."""
    requested: list[tuple[str, str, dict[str, Any] | None]] = [
        *(("GET", f"file?from={source}&format=parm", None) for source in ("known", "live")),
        *(("POST", "diff", {"wanted": {"values": VALUES}, "known": known}) for known in (True, False)),
        ("POST", "diff", {"wanted": {"component": {"system": 1, "component": 1}}, "known": True}),
        *(("POST", path, {"wanted": {"values": VALUES}}) for path in ("plan", "verify")),
    ]
    async with service(GenericVehicle(table=TABLE)) as (_, browser):
        await fetched(browser)
        for method, path, body in requested:
            with threads_of(monkeypatch, (WrittenParam, "of")) as seen:
                answer = await browser.request(method, f"{C}/{path}", json=body)
                assert answer.status_code == 200, answer.text
            assert seen["of"], path
            assert seen["of"] <= {READER, "paramclient service"}, path


@in_simulated_time
async def test_cached_metadata_is_parsed_once_and_not_in_the_thread_of_the_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "cache.sqlite3"
    parsed: list[str] = []

    def noting(content: bytes, *, source: str) -> Metadata:
        parsed.append(threading.current_thread().name)
        return read_content(content, source=source)

    monkeypatch.setattr(metadata_cache, "read_content", noting)
    async with service(PX4Vehicle(metadata=True), cache=place) as (_, browser):
        await fetched(browser)
        answer = await browser.post(f"{C}/metadata", json={})
        assert answer.status_code == 200, answer.text
        for path in ("diff", "plan", "verify", "diff"):
            answer = await browser.post(f"{C}/{path}", json={"wanted": {"values": {"MC_ROLL_P": 5}}})
            assert answer.status_code == 200, answer.text
    assert parsed == [READER]
    async with service(PX4Vehicle(metadata=True), cache=place) as (hub, browser):
        await fetched(browser)
        await until(lambda: hub.followed[0].metadata is not None)
        answer = await browser.post(f"{C}/diff", json={"wanted": {"values": {"MC_ROLL_P": 5}}})
        assert answer.status_code == 200, answer.text
        [vehicle] = (await browser.get("/api/v1/vehicles")).json()["vehicles"]
        kept = await browser.get(f"/api/v1/vehicles/{vehicle['key']}/1/params")
        assert kept.status_code == 200, kept.text
    assert parsed == [READER, READER]


@pytest.mark.asyncio
async def test_metrics_components_and_fetches_are_encoded_in_a_thread_of_their_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with service(GenericVehicle(table=TABLE)) as (hub, browser):
        await fetched(browser)
        is_free = threading.Event()
        calls = (metrics, "generate_latest"), (responses, "encode_document")
        async with anyio.create_task_group() as tasks:
            for run in (hub.run_in_thread, hub.run_in_file_thread):  # a locked cache, a long comparison
                tasks.start_soon(run, is_free.wait)
            try:
                with threads_of(monkeypatch, *calls) as seen:
                    with anyio.fail_after(30):
                        answers = [await browser.get(path) for path in ("/metrics", "/api/v1/components")]
                        answers.append(await browser.post("/api/v1/fetch", json={}))
            finally:
                is_free.set()
        assert [answer.status_code for answer in answers] == [200] * 3, [each.text for each in answers]
        assert "paramclient_component_parameters{" in answers[0].text
        assert [each["component"] for each in answers[1].json()["components"]] == [1]
        assert [each["component"] for each in answers[2].json()["results"]] == [1]
        assert seen == {name: {"paramclient responses"} for _, name in calls}


@in_simulated_time
async def test_the_document_of_the_api_is_made_once_and_in_a_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    async with service() as (_, browser):
        with threads_of(monkeypatch, (FastAPI, "openapi")) as seen:
            documents = [(await browser.get("/openapi.json")).content for _ in range(2)]
            assert seen == {"openapi": {"paramclient service"}}
        with threads_of(monkeypatch, (FastAPI, "openapi")) as seen:
            documents.append((await browser.get("/openapi.json")).content)
            assert seen == {"openapi": set()}
        assert len(set(documents)) == 1


def test_a_document_is_written_as_pydantic_writes_it() -> None:
    def of(count: int, add: float) -> ParamSet:
        return ParamSet({f"A{each}": WrittenParam(f"A{each}", each + add) for each in range(count)})

    for count in (0, 3, 500):
        document = DiffDoc.of(compare_room.compare(of(count, 0.5), of(count + 1, 1.5)), everything=True)
        assert encode_document(document) == document.model_dump_json().encode()
    assert encode_document(JobsDoc(jobs=[])) == b'{"jobs":[]}'
    assert (
        encode_document(ComponentsDoc(run="a", seq=1, components=[]))
        == b'{"run":"a","seq":1,"components":[]}'
    )


# Quotas


TOKENS = Tokens.of_text("anna write anna-may-write-0123456789\nben read ben-may-read-0123456789ab")


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


ANNA = bearer("anna-may-write-0123456789")
BEN = bearer("ben-may-read-0123456789ab")


@in_simulated_time
async def test_jobs_have_a_quota_for_each_holder() -> None:
    vehicle = Tap(GenericVehicle(table=TABLE))
    settings = Settings(access=AccessSettings(tokens=TOKENS))
    async with (
        Hub([vehicle], cache=False, fetches=False) as hub,
        a_browser(create_app(hub, settings)) as browser,
    ):
        body = {"wait": False}
        await browser.post("/api/v1/find", json={}, headers=BEN)
        vehicle.is_deaf = True
        statuses = [
            (await browser.post(f"{C}/fetch", json=body, headers=BEN)).status_code for _ in range(256)
        ]
        assert statuses == [202] * jobs.HOLDER_JOBS_MAX + [429] * (256 - jobs.HOLDER_JOBS_MAX)
        reported = problem(await browser.post(f"{C}/fetch", json=body, headers=BEN), 429, "too-many")
        assert reported["most"] == jobs.HOLDER_JOBS_MAX
        others = await browser.post(f"{C}/fetch", json=body, headers=ANNA)
        assert others.status_code == 202
        hub.start_fetch(hub.find_component(1, 1), "service")
        listed = (await browser.get("/api/v1/jobs", headers=ANNA)).json()["jobs"]
        assert len(listed) == jobs.HOLDER_JOBS_MAX + 2
        own = next(job["id"] for job in listed if job["requested_by"].startswith("ben"))
        await browser.delete(f"/api/v1/jobs/{own}", headers=BEN)
        await until(lambda: hub.jobs.find(own).state == "cancelled")
        assert (await browser.post(f"{C}/fetch", json=body, headers=BEN)).status_code == 202


@in_simulated_time
async def test_plans_have_a_quota_for_each_holder_and_for_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without tokens an address is the holder."""
    vehicle = Tap(GenericVehicle(table=TABLE))
    body = {"wanted": {"values": {"A": 1}}, "timeout_s": 20}
    async with service(vehicle) as (hub, browser), a_browser(create_app(hub), client=("::1", 1)) as other:
        await fetched(browser)
        vehicle.is_deaf = True
        answers: list[int] = []

        async def ask(client: httpx.AsyncClient) -> None:
            answers.append((await client.post(f"{C}/plan", json=body)).status_code)

        async with anyio.create_task_group() as tasks:
            for _ in range(LONG_REQUESTS_OF_HOLDER_MAX):
                tasks.start_soon(ask, browser)
            await anyio.sleep(0.5)
            assert not answers, "they wait for the vehicle"
            for path in ("plan", "diff", "verify"):
                reported = problem(await browser.post(f"{C}/{path}", json=body), 429, "too-many")
                assert reported["most"] == LONG_REQUESTS_OF_HOLDER_MAX
            problem(await browser.post("/api/v1/fetch", json={"timeout_s": 20}), 429, "too-many")
            dry = {**body, "dry_run": True}
            problem(await browser.post(f"{C}/apply", json=dry), 429, "too-many")
            problem(await browser.post("/api/v1/files", content=b"A 1\n", headers=A_FILE), 429, "too-many")
            read = await other.post("/api/v1/files", content=b"A 1\n", headers=A_FILE)
            assert read.status_code == 200
            assert (await browser.get(f"{C}/params")).status_code == 200
            monkeypatch.setattr(hub, "long_requests", Quota("requests", total_max=0, holder_max=1))
            problem(await other.post("/api/v1/files", content=b"A 1\n", headers=A_FILE), 429, "too-many")
        assert answers == [504] * LONG_REQUESTS_OF_HOLDER_MAX


@pytest.mark.parametrize(
    ("path", "body", "status"),
    [
        ("/api/v1/find", {"system": 77, "timeout_s": 20}, 504),
        ("/api/v1/find", {"system": 77, "only": True, "timeout_s": 20}, 504),
        (f"{C}/successor", {"system": 77, "timeout_s": 20}, 504),
        (f"{C}/params/ABC_1_P01/read", {"timeout_s": 20}, 504),
    ],
)
@in_simulated_time
async def test_waiting_requests_have_a_quota_for_each_holder_and_for_all(
    path: str, body: dict[str, Any], status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    vehicle = Tap(GenericVehicle(table=TABLE))
    async with service(vehicle) as (hub, browser), a_browser(create_app(hub), client=("::1", 1)) as other:
        await fetched(browser)
        vehicle.is_deaf = True
        statuses: list[int] = []

        async def ask() -> None:
            statuses.append((await browser.post(path, json=body)).status_code)

        async with anyio.create_task_group() as tasks:
            for _ in range(WAITING_REQUESTS_OF_HOLDER_MAX):
                tasks.start_soon(ask)
            await anyio.sleep(0.5)
            assert not statuses, "they wait"
            reported = problem(await browser.post(path, json=body), 429, "too-many")
            assert reported["most"] == WAITING_REQUESTS_OF_HOLDER_MAX
            assert (await browser.get(f"{C}/params")).status_code == 200
            assert (await other.post("/api/v1/find", json={})).status_code == 200
            none_left = Quota("requests", total_max=0, holder_max=1)
            monkeypatch.setattr(hub, "waiting_requests", {True: none_left, False: none_left})
            problem(await other.post("/api/v1/find", json={}), 429, "too-many")
        assert statuses == [status] * WAITING_REQUESTS_OF_HOLDER_MAX


@in_simulated_time
async def test_waiting_readers_keep_no_writer_and_no_other_reader_out() -> None:
    vehicle = Tap(GenericVehicle(table=TABLE))
    readers = [f"reader{number}-0123456789abcdef" for number in range(4)]
    lines = "".join(f"r{number} read {each}\n" for number, each in enumerate(readers))
    tokens = Tokens.of_text(lines + f"anna write {ANNA['Authorization'].removeprefix('Bearer ')}\n")
    settings = Settings(access=AccessSettings(tokens=tokens))
    async with (
        Hub([vehicle], cache=False, fetches=False) as hub,
        a_browser(create_app(hub, settings)) as browser,
    ):
        await browser.post("/api/v1/find", json={}, headers=ANNA)
        absent = {"system": 77, "timeout_s": 30}
        statuses: list[int] = []

        async def ask(token: str) -> None:
            answer = await browser.post("/api/v1/find", json=absent, headers=bearer(token))
            statuses.append(answer.status_code)

        async with anyio.create_task_group() as tasks:
            for reader in readers[:3]:
                for _ in range(WAITING_REQUESTS_MAX):
                    tasks.start_soon(ask, reader)
                await anyio.sleep(0.5)
            found = await browser.post("/api/v1/find", json={}, headers=bearer(readers[3]))
            assert found.status_code == 200
            written = await browser.put(f"{C}/params/ABC_1_P01", json={"value": 3}, headers=ANNA)
            assert written.status_code == 200, written.text
        assert statuses.count(504) == 64 + 32 + 16
        assert statuses.count(429) == 3 * WAITING_REQUESTS_MAX - (64 + 32 + 16)


@in_simulated_time
async def test_a_list_of_jobs_has_their_results() -> None:
    async with service(GenericVehicle(table=TABLE)) as (_, browser):
        await fetched(browser)
        answer = await browser.post(f"{C}/apply", json={"wanted": {"values": VALUES}})
        assert answer.status_code == 200
        [first, last] = (await browser.get("/api/v1/jobs")).json()["jobs"]
        assert (first["kind"], last["kind"]) == ("fetch", "apply")
        assert last["result"] == answer.json()
        assert (await browser.get(f"/api/v1/jobs/{last['id']}")).json() == last


@in_simulated_time
async def test_a_list_of_jobs_has_no_long_results() -> None:
    async with service(GenericVehicle(table=LARGE)) as (_, browser):
        await fetched(browser)
        answer = await browser.post(f"{C}/apply", json={"wanted": {"values": LARGE}, "full": True})
        assert len(answer.json()["params"]) == len(LARGE) > jobs.LISTED_ENTRIES_MAX
        [_, last] = (await browser.get("/api/v1/jobs")).json()["jobs"]
        whole = (await browser.get(f"/api/v1/jobs/{last['id']}")).json()
        assert whole["result"] == answer.json()
        del whole["result"]["params"]
        assert last == whole


class Turns:
    """Counts what happens in one turn of the event loop."""

    def __init__(self) -> None:
        self.most = 0
        self._count = 0
        self._next()

    def note(self) -> None:
        """It has happened."""
        self._count += 1
        self.most = max(self.most, self._count)

    def _next(self) -> None:
        self._count = 0
        asyncio.get_running_loop().call_soon(self._next)


@in_simulated_time
async def test_a_table_is_read_a_part_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    table = {f"ABC_P{number:04}": float(number) for number in range(3 * params_room.PARAMS_PER_TURN)}
    async with service(GenericVehicle(table=table)) as (_, browser):
        await fetched(browser)
        turns = Turns()

        def param_of(*given: Any) -> Param:
            turns.note()
            return made(*given)

        made = params_model.param_of
        monkeypatch.setattr(params_model, "param_of", param_of)
        for query, count in (
            ("", len(table)),
            ("?names=ABC_P000*", 10),
            ("?names=ABC_P0001&changed=true", 0),
        ):
            answer = await browser.get(f"{C}/params{query}")
            assert list(answer.json()["params"]) == list(table)[:count]
        assert params_room.PARAMS_PER_TURN / 2 < turns.most <= params_room.PARAMS_PER_TURN


@in_simulated_time
async def test_extended_parameters_are_chosen_in_a_thread_and_encoded_as_they_are_sent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    table = {f"ABC_P{number:04}": "\U0001f6f0" * 32 for number in range(3 * STREAMED_ENTRIES_MAX)}
    extended = "/api/v1/components/1/100/extended"
    async with service(Camera(table)) as (_, browser):
        await met(browser, system=1, component=100)
        assert (await browser.post(f"{extended}/fetch", json={})).status_code == 200
        with threads_of(monkeypatch, (extended_room, "NameChoice")) as seen:
            answer = await browser.get(f"{extended}/params", params={"names": ["ABC_P000*", "[a-\uffff]x"]})
            assert list(answer.json()["params"]) == list(table)[:10]
        assert seen == {"NameChoice": {READER}}
        turns = Turns()

        def ext_param_json(*given: Any) -> str:
            turns.note()
            return made(*given)

        made = followed_extended.ext_param_json
        monkeypatch.setattr(followed_extended, "ext_param_json", ext_param_json)
        answer = await browser.get(f"{extended}/params")
        assert list(answer.json()["params"]) == list(table)
        assert turns.most == STREAMED_ENTRIES_MAX
        assert (await browser.get(f"{extended}/params?names=NONE")).json()["params"] == {}


@in_simulated_time
async def test_descriptions_are_encoded_as_they_are_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    table = {f"ABC_P{number:03}": 1.0 for number in range(200)}
    bits = [{"index": 0, "description": "b" * 500}]
    group = {"name": "ABC_P{n}", "longDesc": "x" * 30_000, "units": "m" * 500, "bitmask": bits}
    content = json.dumps({"version": 1, "parameters": [group]}).encode()
    async with service(GenericVehicle(table=table)) as (_, browser):
        await fetched(browser)
        answer = await browser.put(f"{C}/metadata", content=content, headers=A_FILE)
        assert answer.status_code == 200
        turns = Turns()

        def of(*given: Any) -> InfoDoc:
            turns.note()
            return made(*given)

        made = InfoDoc.of
        monkeypatch.setattr(InfoDoc, "of", of)
        for query, count in (("", 200), ("?names=ABC_P00*", 10)):
            answer = await browser.get(f"{C}/metadata{query}")
            assert list(answer.json()["params"]) == list(table)[:count]
        answer = await browser.get(f"{C}/params?metadata=true")
        params = answer.json()["params"]
        assert list(params) == list(table)
        assert {len(each["metadata"]["long_description"]) for each in params.values()} == {30_000}
        assert turns.most == 2, "32,768 characters"
        assert not any({"text", "units"} & each.keys() for each in params.values()), "too long for many rows"
        wanted = {"wanted": {"values": {"ABC_P001": 3}}, "known": True, "partial": True}
        compared = (await browser.post(f"{C}/diff", json=wanted)).json()["params"]["ABC_P001"]
        assert not {"text", "units"} & {*compared, *compared["left"], *compared["right"]}


@in_simulated_time
async def test_extended_parameters_of_a_second_list_are_compared_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    compared = 0

    def is_equal(one: ExtParam, other: object) -> bool:
        nonlocal compared
        compared += 1
        return bool(equal(one, other))

    extended = "/api/v1/components/1/100/extended"
    async with service(Camera({f"P{number:03}": number for number in range(200)})) as (_, browser):
        await met(browser, system=1, component=100)
        for _ in range(2):
            assert (await browser.post(f"{extended}/fetch", json={})).status_code == 200
        equal = ExtParam.__eq__
        monkeypatch.setattr(ExtParam, "__eq__", is_equal)
        assert (await browser.post(f"{extended}/fetch", json={})).status_code == 200
        assert 0 < compared <= 200
        for _ in range(10):
            assert (await browser.get(f"{extended}/params/P000")).status_code == 200
            assert len((await browser.get(f"{extended}/params")).json()["params"]) == 200
        assert compared <= 200


@pytest.mark.asyncio
async def test_of_a_streamed_response_nothing_is_made_before_it_can_be_sent() -> None:
    made = 0
    sizes: list[int] = []

    def entries(length: int) -> Iterator[str]:
        nonlocal made
        for number in range(100):
            made += 1
            yield f'"{number}":"{"x" * length}"'

    async def send(message: Any) -> None:
        sizes.append(len(message.get("body", b"")))
        assert made <= STREAMED_ENTRIES_MAX * len(sizes)

    async def receive() -> Any:
        await anyio.sleep_forever()

    for length in (10, STREAMED_CHUNK_LENGTH):
        made, sizes = 0, []
        await streamed_response("{", entries(length), "}")({"type": "http"}, receive, send)
        assert made == 100
        assert max(sizes) < STREAMED_CHUNK_LENGTH + length + 20


@in_simulated_time
async def test_events_are_written_out_few_at_a_time() -> None:
    async with service() as (hub, browser):
        turns = Turns()

        def write() -> str:
            turns.note()
            return '"a":1'

        for _ in range(1_000):
            hub.feed.publish("note", write)
        async with browser.stream("GET", f"/api/v1/events?after={hub.feed.run}-0") as stream:
            async for line in stream.aiter_lines():
                if line.endswith("-1000"):
                    break
        assert turns.most == BATCH_EVENTS_MAX


@in_simulated_time
async def test_metrics_are_collected_a_part_at_a_time() -> None:
    turns = Turns()

    class Counted:
        link = SimpleNamespace(name="a", state="open")
        address = (1, 1)

        @property
        def component(self) -> Any:
            turns.note()
            return SimpleNamespace(state="active", sync_state="synced", params={}, round_trip=None)

    hub: Any = SimpleNamespace(followed=[Counted() for _ in range(1_000)])
    families = await metrics._component_metrics(hub)
    assert [len(family.samples) for family in families] == [1_000, 1_000, 1_000, 0]
    assert turns.most == COMPONENTS_PER_TURN


@in_simulated_time
async def test_many_components_are_looked_at_few_at_a_time() -> None:
    turns = Turns()
    looked: Any = SimpleNamespace(publish_changes=turns.note)

    async def receive() -> dict[str, str]:
        await anyio.sleep(9)
        return {"type": "http.disconnect"}

    hub = SimpleNamespace(waiting_requests={True: Quota("requests", total_max=1, holder_max=1)})
    app = SimpleNamespace(state=SimpleNamespace(hub=hub))
    state = {"quota": "anna", "role": "write", "read_only": False}
    request: Any = SimpleNamespace(receive=receive, app=app, scope={"state": state})

    async def work() -> int:
        return 7

    assert await run_until_disconnect(request, work, *[looked] * 1_000) == 7
    assert turns.most == COMPONENTS_PER_TURN


@pytest.mark.parametrize(
    ("name", "data", "most"),
    [
        ("a.parm", b"P1 " + b"1" * 100_000, LINE_BYTES_MAX),
        ("a.params", b"1\t1\tA\t1\t9\r" * 60_001, SEPARATORS_MAX),
    ],
)
@in_simulated_time
async def test_a_file_with_long_lines_is_not_parsed(name: str, data: bytes, most: int) -> None:
    async with service() as (_, browser):
        answer = await browser.post(f"/api/v1/files?name={name}", content=data, headers=A_FILE)
        assert problem(answer, 413, "too-large")["most"] == most


@in_simulated_time
async def test_a_file_without_lines_may_be_long() -> None:
    wanted = ParamSet({name: WrittenParam(name, value) for name, value in LARGE.items()})
    document = json.dumps(json.loads(dumps(wanted, file_format="json"))).encode()
    coarse = {name: WrittenParam(name, value, ParamType.REAL32) for name, value in LARGE.items()}
    packed = dumps(ParamSet(coarse), file_format="pck")
    assert b"\n" not in document
    assert min(len(document), len(packed)) > LINE_BYTES_MAX
    async with service() as (_, browser):
        for name, data in (("a.json", document), ("", b"\xef\xbb\xbf \n" + document), ("a.pck", packed)):
            answer = await browser.post(f"/api/v1/files?name={name}", content=data, headers=A_FILE)
            assert answer.status_code == 200, answer.text
            assert len(answer.json()["params"]) == len(LARGE)


def test_in_a_document_of_one_line_no_comment_is_sought(monkeypatch: pytest.MonkeyPatch) -> None:
    sought: list[str] = []

    def lines_of(text: str, *_: Any) -> Iterator[Any]:
        sought.append(text)
        return iter(())

    monkeypatch.setattr(conversion, "lines_of", lines_of)
    with pytest.raises(FileError):
        loads(b'{"a":"' + b"x" * 100_000 + b'"}')
    assert not sought


@pytest.mark.parametrize("number", ["9" * 4_300, "9" * (DIGITS_MAX + 1), "0." + "3" * (DIGITS_MAX + 1)])
@in_simulated_time
async def test_a_body_with_endless_numbers_is_not_parsed(
    number: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with service() as (_, browser):
        with threads_of(monkeypatch, (json, "loads")) as seen:
            answer = await browser.post("/api/v1/find", content=f'{{"system":{number}}}', headers=A_JSON)
        assert seen == {"loads": set()}
        assert problem(answer, 413, "too-large")["most"] == DIGITS_MAX
        answer = await browser.post("/api/v1/find", content=f'{{"system":{"9" * 128}}}', headers=A_JSON)
        assert answer.status_code == 422


@pytest.mark.parametrize(
    "data",
    [
        b"".join(b"1\t1\tP%05d\t1.5\t9\n" % number for number in range(20_000)),
        b"".join(b"P%05d,1.5\n" % number for number in range(20_000)),
        b'{"paramclient":1,"sets":[{"params":{'
        + b",".join(b'"P%05d":{"value":1}' % number for number in range(20_000))
        + b"}}]}",
    ],
)
def test_a_file_with_too_many_parameters_is_rejected(data: bytes) -> None:
    with pytest.raises(TooManyParams, match="more than 1,000 parameters"):
        loads(data, params_max=1_000)
    with pytest.raises(ServiceError, match="10,000"):
        parse_upload(data, "", None)


@pytest.mark.asyncio
async def test_the_end_of_the_service_waits_for_nothing_that_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hub_room, "FILE_WORK_TIMEOUT", 0.1)
    begun: list[int] = []
    may_end = threading.Event()
    problems: list[str] = []

    def work() -> None:
        begun.append(1)
        may_end.wait(20)

    async def ask(hub: Hub) -> None:
        with pytest.raises(ServiceError) as caught:
            await hub.run_in_file_thread(work)
        problems.append(caught.value.kind)

    async with anyio.create_task_group() as tasks:
        async with service() as (hub, _):
            for _ in range(5):
                tasks.start_soon(ask, hub)
            await until(lambda: bool(begun))
            ending = anyio.current_time()
        assert anyio.current_time() - ending < 2
    assert problems == ["closing"] * 5
    assert len(begun) == 1
    may_end.set()


@in_simulated_time
async def test_large_answers_wait_for_each_other_until_they_are_sent() -> None:
    async with service(GenericVehicle(table=LARGE)) as (_, browser):
        await fetched(browser)
        async with contextlib.AsyncExitStack() as stack:
            for _ in range(LARGE_GETS_OF_HOLDER_MAX):
                request = browser.stream("GET", f"{C}/params")
                assert (await stack.enter_async_context(request)).status_code == 200  # and takes nothing
            answers: list[httpx.Response] = []

            async def ask(path: str) -> None:
                answers.append(await browser.get(path))

            async with anyio.create_task_group() as tasks:
                for path in (f"{C}/params", f"{C}/file?from=known", "/metrics", f"{C}/snapshots/1"):
                    tasks.start_soon(ask, path)
                await anyio.sleep(1)
                assert not answers
                assert (await browser.get(f"{C}/params/ABC_0_P0000")).status_code == 200
                assert (
                    await browser.post(f"{C}/diff", json={"wanted": {"values": VALUES}})
                ).status_code == 200
                await stack.aclose()
            assert sorted(each.status_code for each in answers) == [200, 200, 200, 409]


@in_simulated_time
async def test_a_quota_limits_each_holder_and_all_together() -> None:
    quota = Quota("requests", total_max=3, holder_max=2)
    held: list[str] = []
    may_leave = anyio.Event()

    async def answer(holder: str) -> None:
        async with quota.wait(holder):
            held.append(holder)
            await may_leave.wait()

    async with anyio.create_task_group() as tasks:
        for holder in ("a", "a", "a", "b", "b"):
            tasks.start_soon(answer, holder)
        await anyio.sleep(1)
        assert held == ["a", "a", "b"]
        may_leave.set()
    assert sorted(held) == ["a", "a", "a", "b", "b"]
    assert not len(quota)


@pytest.mark.asyncio
async def test_an_answer_is_sent_as_it_is_taken() -> None:
    sent: list[tuple[int, bool]] = []
    body = bytes(range(256)) * 1_000

    async def app(scope: Any, receive: Any, send: Any) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": body})

    async def send(message: Any) -> None:
        if message["type"] == "http.response.body":
            sent.append((len(message["body"]), message.get("more_body", False)))
            parts.append(message["body"])

    async def receive() -> Any:
        raise AssertionError("it has no body")

    parts: list[bytes] = []
    scope = {"type": "http", "method": "GET", "path": "/health", "headers": [(b"host", b"127.0.0.1")]}
    await AccessMiddleware(app, AccessSettings())(scope, receive, send)
    assert sent == [(65_536, True)] * 3 + [(256_000 - 3 * 65_536, False)]
    assert b"".join(parts) == body
