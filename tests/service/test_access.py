"""Who may do what: tokens, roles, other sites, host names, sizes; and what no program of ours sends."""

from __future__ import annotations

import stat
from http import HTTPStatus
from pathlib import Path
from typing import Any

import pytest

from paramclient.errors import UsageError
from paramclient.service import Tokens, add_token, create_app, read_tokens
from tests.service.hub import V, browsing, problem, service, synced
from tests.shell import VALUES, generic

READS = {
    "POST /api/files",
    "POST /api/vehicles/{system}/{component}/fetch",
    "POST /api/vehicles/{system}/{component}/plan",
}
"""Requests that change no vehicle and no cache, although they are no GET."""
BODIES: dict[str, Any] = {
    "/params/PARAM_04": {"value": 9},
    "/params": {"values": {"PARAM_04": 9}},
    "/apply": {"values": {"PARAM_04": 9}},
    "/plan": {"values": {"PARAM_04": 9}},
    "/snapshots": {"reason": "test"},
    "/files": {"text": "PARAM_04,9"},
}


@pytest.fixture
def tokens(tmp_path: Path) -> tuple[Tokens, dict[str, str], dict[str, str]]:
    """Tokens, and the headers with one that may only read, and with one that may write."""
    file = tmp_path / "tokens"
    reads, writes = add_token(file, "eye", "read"), add_token(file, "hand", "write")
    return read_tokens(file), bearer(reads), bearer(writes)


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


def requests_of(app: Any) -> list[tuple[str, str, str]]:
    """Method, path and route of every request that the application describes."""
    found = []
    for path, methods in app.openapi()["paths"].items():
        address = path.replace("{system}", "1").replace("{component}", "1").replace("{name}", "PARAM_04")
        found += [(method.upper(), address, path) for method in methods]
    return found


def body_for(address: str) -> dict[str, Any]:
    return next((body for end, body in BODIES.items() if address.endswith(end)), {})


async def test_without_a_token_only_the_page_and_health_are_served(tokens: Any) -> None:
    """As the description of each route says."""
    known, _, _ = tokens
    async with service(generic(), app={"tokens": known}) as (hub, browser):
        paths = create_app(hub).openapi()["paths"]
        for method, address, path in requests_of(create_app(hub)):
            if "security" not in paths[path][method.lower()]:
                assert address == "/health"
                continue
            problem(await browser.request(method, address, json=body_for(address)), 401, "unauthorized")
        assert (await browser.get("/")).status_code == 200
        health = (await browser.get("/health")).json()
        assert (health["role"], "links" in health) == (None, False)


async def test_no_odd_token_is_valid_and_no_cookie(tokens: Any) -> None:
    known, header, _ = tokens
    token = header["Authorization"].removeprefix("Bearer ").encode()
    wrong = [b"", b"Bearer", b"Bearer ", token, b"Basic " + token, b"Bearer " + token[:-1]]
    wrong += [b"Bearer " + token.upper(), b"Bearer \xff\xfe" + token, b"Bearer " + b"x" * 30_000]
    async with service(generic(), app={"tokens": known}) as (_, browser):
        for given in [{b"Authorization": each} for each in wrong] + [{b"Cookie": b"token=" + token}]:
            answer = await browser.get("/api/vehicles", headers=given)
            problem(answer, 401, "unauthorized")
            assert answer.headers["www-authenticate"] == "Bearer"
        problem(await browser.get(f"/api/vehicles?token={token.decode()}"), 401, "unauthorized")
        answer = await browser.get("/api/vehicles", headers={b"Authorization": b"bearer  " + token})
        assert answer.is_success
        assert "set-cookie" not in answer.headers


async def test_no_request_writes_with_a_token_that_reads(tokens: Any) -> None:
    known, reads, writes = tokens
    vehicle = generic()
    async with service(vehicle, app={"tokens": known}) as (hub, browser):
        browser.headers.update(reads)
        await synced(browser)
        assert (await browser.get("/health")).json()["role"] == "read"
        tried = 0
        for method, address, route in requests_of(create_app(hub)):
            if method == "GET":
                continue
            answer = await browser.request(method, address, json=body_for(address))
            if f"{method} {route}" in READS:
                assert answer.status_code in (200, 404), (address, answer.text)
            else:
                problem(answer, 403, "forbidden")
                tried += 1
        assert tried >= 5
        assert vehicle.param("PARAM_04").value == 4
        answer = await browser.put(f"{V}/params/PARAM_04", json={"value": 9}, headers=writes)
        assert answer.json()["status"] == "accepted"


async def test_a_change_has_the_name_of_its_token_as_author(tokens: Any, tmp_path: Path) -> None:
    known, _, writes = tokens
    cache = str(tmp_path / "cache.sqlite3")
    async with service(generic(), cache=cache, app={"tokens": known}) as (_, browser):
        browser.headers.update(writes)
        await synced(browser)
        body = {"value": 9, "durable": True}
        await browser.put(f"{V}/params/PARAM_04", json=body)
        await browser.put(f"{V}/params/PARAM_05", json=body, headers={"X-Author": "page-1"})
        await browser.put(f"{V}/params/PARAM_07", json=body, headers={"X-Author": "<b>"})
        history = (await browser.get(f"{V}/history")).json()["history"]
        assert [each["by"] for each in history] == ["us for hand", "us for hand (page-1)", "us for hand"]


async def test_no_page_of_another_site_writes_without_tokens() -> None:
    vehicle = generic()
    async with service(vehicle) as (hub, browser):
        await synced(browser)
        origins = ["null", "http://localhost:3000", "http://127.0.0.1:8765.evil.example", "http://127.0.0.1"]
        for method, address, _ in requests_of(create_app(hub)):
            for origin in origins if method != "GET" else ():
                headers, body = {"Origin": origin}, body_for(address)
                answer = await browser.request(method, address, json=body, headers=headers)
                problem(answer, 403, "other-origin")
        assert vehicle.param("PARAM_04").value == 4
        own = {"Origin": "http://127.0.0.1:8765"}
        assert (await browser.put(f"{V}/params/PARAM_04", json={"value": 9}, headers=own)).status_code == 200


async def test_a_hostile_host_name_is_refused() -> None:
    async with browsing(generic()) as browser:
        for host in ("evil.example:8765", "127.0.0.1.evil.example", "localhost.evil", ""):
            for address in ("/", f"{V}/params"):
                problem(await browser.get(address, headers={"Host": host}), 400, "invalid-host")
        for host in ("localhost:8765", "127.0.0.1", "127.0.0.2:80", "[::1]:8765"):
            assert (await browser.get("/health", headers={"Host": host})).status_code == 200, host


async def test_a_body_over_the_limit_is_413() -> None:
    async with browsing(generic()) as browser:
        large = b'{"text": "' + b"A" * 5 * 2**20 + b'"}'
        json_type = {"Content-Type": "application/json"}

        async def chunks() -> Any:
            for _ in range(6):
                yield b"A" * 2**20

        kind = HTTPStatus(413).phrase.lower().replace(" ", "-")
        for content in (large, chunks()):
            problem(await browser.post("/api/files", content=content, headers=json_type), 413, kind)
        many = {f"P{number}": 1 for number in range(10_001)}
        problem(await browser.patch(f"{V}/params", json={"values": many}), 422, "invalid-request")


async def test_responses_cannot_be_framed_cached_or_taken_for_another_type() -> None:
    async with service(generic()) as (_, browser):
        for address in ("/", "/health", "/api/nothing"):
            answer = await browser.get(address)
            assert (await browser.head(address)).status_code == answer.status_code  # monitors ask this
            assert "frame-ancestors 'none'" in answer.headers["content-security-policy"]
            assert answer.headers["x-content-type-options"] == "nosniff"
            assert answer.headers["cache-control"] == "no-store"


def test_a_token_file_is_private_and_holds_digests(tmp_path: Path) -> None:
    file = tmp_path / "tokens"
    token = add_token(file, "anna", "write")
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert token not in file.read_text()
    assert add_token(file, "wall", "read") not in file.read_text()
    assert [*read_tokens(file).values()] == [("anna", "write"), ("wall", "read")]
    for again in ("anna", "two words", "", "x" * 33):
        with pytest.raises(UsageError):
            add_token(file, again, "read")
    (tmp_path / "link").symlink_to(tmp_path / "target")
    file.chmod(0o644)
    for each in (file, tmp_path / "link"):
        with pytest.raises(UsageError):
            add_token(each, "eve", "write")
    assert not (tmp_path / "target").exists()
    with pytest.raises(UsageError, match="tokens"):
        read_tokens(file)


@pytest.mark.parametrize("text", ["", "# none", "anna write secret-token-itself", "anna admin sha256:00"])
def test_an_invalid_token_file_is_refused_without_its_content(tmp_path: Path, text: str) -> None:
    file = tmp_path / "tokens"
    file.write_text(text)
    file.chmod(0o600)
    with pytest.raises(UsageError) as refused:
        read_tokens(file)
    assert "secret-token-itself" not in str(refused.value)


# broken bodies, wrong types, odd addresses

BROKEN = [
    b"",
    b"[]",
    b"{",
    b"\xff\xfe\x00",
    b'{"value": 1e999}',
    b'{"values": {"PARAM_04": ' + b"9" * 5_000 + b"}}",
    b'{"value": NaN, "values": NaN, "reason": NaN, "at": NaN, "refresh": NaN, "text": NaN}',
    b'{"value": "\\ud800", "values": {"\\ud800": "\\udfff"}, "reason": "\\ud800", "text": "\\ud800"}',
    b'{"values": {"PARAM_04": {"deep": ' + b"[" * 5_000 + b"]" * 5_000 + b"}}}",
    b'{"values": {"": 1}, "value": [], "at": {}, "file": 1, "only": 1, "include": "x", "force": 7}',
]
REFUSED: list[tuple[str, str, dict[str, Any]]] = [
    ("PUT", "params/PARAM_04", {"value": 1, "settel_s": 1}),
    ("PUT", "params/PARAM_04", {}),
    ("PUT", "params/PARAM_04", {"value": True}),
    ("PUT", "params/PARAM_04", {"value": 1, "timeout_s": -1}),
    ("POST", "apply", {}),
    ("POST", "apply", {"values": {"PARAM_04": 1}, "at": 1}),
    ("POST", "apply", {"values": {}}),
    ("POST", "plan", {"values": {"A_NAME_THAT_IS_LONG": 1}}),
    ("POST", "restore", {"at": True}),
    ("POST", "snapshots", {"reason": ""}),
    ("POST", "fetch", {"refresh": "maybe", "x": 1}),
]


async def test_no_broken_body_is_taken_or_breaks_the_service() -> None:
    vehicle = generic()
    async with service(vehicle) as (hub, browser):
        await synced(browser)
        for method, address, _ in requests_of(create_app(hub)):
            for body in BROKEN if method != "GET" else ():
                for media_type in ("application/json", "text/plain"):
                    headers = {"Content-Type": media_type}
                    answer = await browser.request(method, address, content=body, headers=headers)
                    problem(answer, 422, "invalid-request")
        assert {name: vehicle.param(name).value for name in VALUES} == VALUES


async def test_odd_addresses_and_queries_are_problems() -> None:
    ids = ("0/1", "256/1", "one/1", "1/-1", f"{'9' * 5_000}/1")
    async with browsing(generic()) as browser:
        for address in (
            *(f"/api/vehicles/{each}/params" for each in ids),
            *(f"{V}/params?at={each}" for each in ("0", "9" * 5_000, "2026-11-20T14:00", "yesterday")),
            *(f"{V}/params?{each}" for each in (f"link={'x' * 201}", f"names={'[' * 65}", "ext=perhaps")),
            f"{V}/file?format=exe",
            *(f"{V}/history?{each}" for each in ("limit=0", f"name={'N' * 17}", "since=yesterday")),
        ):
            problem(await browser.get(address), 422, "invalid-request")
        for address in ("/api/nothing", "/api/vehicles/1/1", "/../tokens", "/%2e%2e/app.py", "/app.py"):
            assert (await browser.get(address)).status_code == 404, address
        assert (await browser.delete(f"{V}/params")).status_code == 405
        assert (await browser.get(f"{V}/plan")).headers["allow"] == "POST"
        for address in (f"{V}/params/{each}" for each in ("%00", "..%2F..%2Fetc", "%F0%9F%9B%A9", "A" * 17)):
            assert (await browser.get(address)).status_code in (404, 422), address
            assert (await browser.put(address, json={"value": 1})).status_code in (404, 422), address


async def test_senseless_bodies_are_refused() -> None:
    async with browsing(generic()) as browser:
        for method, what, body in REFUSED:
            problem(await browser.request(method, f"{V}/{what}", json=body), 422, "invalid-request")
        for body in ({"text": "no\0parameters"}, {"text": "{", "format": "json"}, {"base64": "###"}):
            answer = await browser.post("/api/files", json=body)
            assert answer.headers["content-type"] == "application/problem+json"
            assert answer.status_code == 422, answer.text
