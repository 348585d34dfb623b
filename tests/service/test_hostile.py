"""What no page and no program of ours sends: broken bodies, wrong types, odd addresses and tokens."""

from __future__ import annotations

from typing import Any

import pytest

from tests.service.hub import V, browsing, problem
from tests.shell import VALUES, generic

BODIES = [
    b"",
    b"null",
    b"[]",
    b"7",
    b'"text"',
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
    ("PUT", "params/PARAM_04", {}),
    ("PUT", "params/PARAM_04", {"value": 1, "settel_s": 1}),
    ("PUT", "params/PARAM_04", {"value": True}),
    ("PUT", "params/PARAM_04", {"value": None}),
    ("PUT", "params/PARAM_04", {"value": [1]}),
    ("PUT", "params/PARAM_04", {"value": {"bits": "0"}}),
    ("PUT", "params/PARAM_04", {"value": 1, "timeout_s": -1}),
    ("PUT", "params/PARAM_04", {"value": "x" * 1000}),
    ("POST", "apply", {}),
    ("POST", "apply", {"values": {"PARAM_04": 1}, "at": 1}),
    ("POST", "apply", {"values": {}}),
    ("POST", "plan", {"file": {"name": "x"}}),
    ("POST", "plan", {"values": {"A_NAME_THAT_IS_LONG": 1}}),
    ("POST", "restore", {"at": True}),
    ("POST", "restore", {"at": 0}),
    ("POST", "restore", {"at": "2026-11-20T14:00"}),
    ("POST", "snapshots", {"reason": ""}),
    ("POST", "fetch", {"refresh": "maybe", "x": 1}),
]
WRITES = [
    ("PUT", "/params/PARAM_04"),
    ("PATCH", "/params"),
    ("POST", "/fetch"),
    ("POST", "/plan"),
    ("POST", "/apply"),
    ("POST", "/restore"),
    ("POST", "/snapshots"),
]


@pytest.mark.parametrize(("method", "what"), WRITES)
async def test_no_broken_body_is_taken_or_breaks_the_service(method: str, what: str) -> None:
    vehicle = generic()
    async with browsing(vehicle) as browser:
        for body in BODIES:
            for media_type in ("application/json", "text/plain"):
                headers = {"Content-Type": media_type}
                answer = await browser.request(method, f"{V}{what}", content=body, headers=headers)
                assert 400 <= answer.status_code < 500, (body[:80], answer.text)
                assert answer.headers["content-type"] == "application/problem+json"
        assert {name: vehicle.param(name).value for name in VALUES} == VALUES


async def test_odd_addresses_and_queries_are_problems() -> None:
    async with browsing(generic()) as browser:
        for address in (
            *(
                f"/api/vehicles/{each}/params"
                for each in ("0/1", "256/1", "one/1", "1/-1", f"{'9' * 5_000}/1")
            ),
            *(f"{V}/params?at={each}" for each in ("0", "9" * 5_000, "2026-11-20T14:00", "yesterday")),
            *(f"{V}/params?link={'x' * 201}", f"{V}/params?ext=perhaps", f"{V}/file?format=exe"),
            *(f"{V}/history?{each}" for each in ("limit=0", f"name={'N' * 17}", "since=yesterday")),
        ):
            problem(await browser.get(address), 422, "invalid-request")
        for address in ("/api/nothing", "/api/vehicles/1/1", "/../tokens", "/%2e%2e/app.py", "/app.py"):
            assert (await browser.get(address)).status_code == 404, address
        for name in ("%00", "..%2F..%2Fetc", "%F0%9F%9B%A9", "A" * 17):
            assert (await browser.get(f"{V}/params/{name}")).status_code in (404, 422), name
            answer = await browser.put(f"{V}/params/{name}", json={"value": 1})
            assert answer.status_code in (404, 422), name
        assert (await browser.request("DELETE", f"{V}/params")).status_code == 405


@pytest.mark.parametrize(("method", "what", "body"), REFUSED)
async def test_a_senseless_body_is_refused(method: str, what: str, body: dict[str, Any]) -> None:
    async with browsing(generic()) as browser:
        problem(await browser.request(method, f"{V}/{what}", json=body), 422, "invalid-request")
