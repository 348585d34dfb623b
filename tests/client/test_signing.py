"""Signing as users have it: keys, clients, commands, and what never shows."""

from __future__ import annotations

import base64
import logging
import traceback
from pathlib import Path
from typing import Any

import pytest

import paramclient
from paramclient import NoReply, ParamClient, Signing, SigningKey, SigningPolicy, UsageError, read_key
from paramclient.client import signing
from paramclient.client.signing import key_from_environment
from paramclient.sim import Vehicle
from paramclient.wire.signing import UNITS_PER_SECOND, Refusal
from tests.shell import in_simulated_time, small_px4

SECRET = bytes(range(101, 133))
KEY = SigningKey(SECRET)
OTHER_KEY = SigningKey(bytes(range(1, 33)))
NOW = 36_000_000_000_000
TIMEOUT = 60.0

FORMS = [SECRET, SECRET.hex().encode(), SECRET.hex().upper().encode(), base64.b64encode(SECRET)]
FORMS += [repr(SECRET)[2:-1].encode(), ", ".join(map(str, SECRET[:8])).encode()]
"""How the key could show."""


def a_client(link: Any, **options: Any) -> ParamClient:
    given: dict[str, Any] = {"cache": False, "signing": KEY} | options
    return ParamClient(link, **given)


def signed_vehicle(**options: Any) -> Vehicle:
    return small_px4(**{"signing_key": KEY} | options)


# Keys


@pytest.mark.parametrize(
    "data",
    [SECRET, SECRET.hex().encode(), b"\n " + SECRET.hex().upper().encode() + b"\r\n", FORMS[3] + b"\n"],
)
def test_a_file_holds_a_key_as_it_is_or_as_text(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "key"
    path.write_bytes(data)
    path.chmod(0o600)
    assert read_key(path) == KEY
    for mode in (0o644, 0o640, 0o604, 0o620, 0o601):
        path.chmod(mode)
        with pytest.raises(
            UsageError, match=rf"key: other users than its owner .* \(mode {mode:o}\); run `chmod 600`"
        ):
            read_key(path)
    path.write_bytes(b"hunter2-hunter2")
    path.chmod(0o600)
    with pytest.raises(UsageError) as caught:
        read_key(path)
    assert str(caught.value).startswith(f"{path}: a signing key ")
    assert "hunter2" not in "".join(traceback.format_exception(caught.value))


def test_the_environment_names_a_key_in_one_of_three_ways(tmp_path: Path) -> None:
    file = tmp_path / "key"
    file.write_bytes(SECRET)
    file.chmod(0o600)
    for variable, value, key in (
        ("KEY", "", None),
        ("KEY", SECRET.hex(), KEY),
        ("KEY", FORMS[3].decode(), KEY),
        ("KEY_FILE", str(file), KEY),
        ("PASSPHRASE", "my words", SigningKey.from_passphrase("my words")),
    ):
        assert key_from_environment({f"PARAMCLIENT_SIGNING_{variable}": value}) == key
    assert key_from_environment({}) is None
    both = {"PARAMCLIENT_SIGNING_KEY": SECRET.hex(), "PARAMCLIENT_SIGNING_PASSPHRASE": "my words"}
    with pytest.raises(UsageError, match="KEY and PARAMCLIENT_SIGNING_PASSPHRASE"):
        key_from_environment(both)
    with pytest.raises(UsageError, match=r"^PARAMCLIENT_SIGNING_KEY: a signing key in text") as caught:
        key_from_environment({"PARAMCLIENT_SIGNING_KEY": "hunter2-hunter2"})
    assert "hunter2" not in str(caught.value)


def test_invalid_signing_settings_are_refused_at_once() -> None:
    assert Signing(KEY, "signed-only").policy == SigningPolicy.SIGNED_ONLY
    with pytest.raises(
        UsageError, match="unknown signing policy 'none'; choose one of signed-only, unsigned-radios, accept"
    ):
        Signing(KEY, "none")
    for link_id in (-1, 256):
        with pytest.raises(UsageError, match=f"0 to 255, not {link_id}"):
            Signing(KEY, link_id=link_id)


# Timestamps


async def test_a_clock_set_back_adopts_the_vehicles_timestamp(monkeypatch: pytest.MonkeyPatch) -> None:
    for now in (NOW, NOW - 50 * UNITS_PER_SECOND):
        monkeypatch.setattr(signing, "timestamp_now", lambda now=now: now)
        async with a_client(signed_vehicle(signing_timestamp=NOW)) as client:
            assert (await (await client.component()).get("PARAM_04", timeout=2.0)).name == "PARAM_04"


# Clients


async def test_a_signed_client() -> None:
    vehicle = signed_vehicle()
    async with (
        a_client(vehicle) as client,
        a_client(signed_vehicle(), signing=Signing(KEY, link_id=1)) as other,
    ):
        component = await client.component()
        assert dict((await component.fetch_all()).params).keys() == vehicle.params.keys()
        assert (await component.set("PARAM_04", 44)).actual == 44
        assert vehicle.param("PARAM_04").value == 44
        report = client.signing_report()
        assert report is not None
        assert (report.fingerprint, report.policy) == (KEY.fingerprint, "unsigned-radios")
        assert report.signed > 10
        assert [(each.system, each.component, each.link_id) for each in report.streams] == [(1, 1, 0)]
        beside = other.signing_report()
        assert beside is not None
        assert (report.link_id, beside.link_id) == (0, 1)
    async with ParamClient(small_px4(), cache=False) as unsigned:
        assert unsigned.signing_report() is None


async def test_no_reply_says_that_frames_were_refused() -> None:
    async with a_client(signed_vehicle(), signing=OTHER_KEY) as client:
        with pytest.raises(NoReply, match=r"an autopilot \(frames were refused, [0-9]+ for: bad signature\)"):
            await client.component(timeout=3.0)
    async with a_client(small_px4()) as client:
        with pytest.raises(NoReply, match=r"system id 1 \(frames were refused, [0-9]+ for: unsigned\) in"):
            await client.component(1, timeout=3.0)
        report = client.signing_report()
        assert report is not None
        assert report.refused.keys() == {Refusal.UNSIGNED}


async def test_a_vehicle_of_mavlink_1_is_given_no_key_and_is_answered_unsigned() -> None:
    vehicle = small_px4(mavlink_version=1)
    async with a_client(vehicle, signing=None) as client:
        with pytest.raises(UsageError, match="1/1 uses MAVLink 1"):
            await (await client.component()).setup_signing(KEY, link_is_safe=True)
    async with a_client(vehicle, signing=Signing(KEY, SigningPolicy.ACCEPT_ALL)) as client:
        assert (await (await client.component()).fetch_all()).complete
        report = client.signing_report()
        assert report is not None
        assert (report.signed, report.unsigned > 20) == (0, True)


# What never shows


def test_no_key_shows(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    """A life with everything in it; then all that was written is looked through."""
    caplog.set_level(logging.DEBUG)
    shown: list[str] = []
    cache = tmp_path / "cache.sqlite3"

    @in_simulated_time
    async def live() -> None:
        vehicle = small_px4()
        async with a_client(vehicle, signing=None, cache=cache) as client:
            component = await client.component()
            await component.setup_signing(KEY, link_is_safe=True)
        settings = Signing(KEY)
        async with a_client(vehicle, signing=settings, cache=cache) as client:
            component = await client.component()
            await component.fetch_all()
            await component.set("PARAM_04", 3)
            for each in (client, client.signing_report(), component, settings, vehicle.signing_report):
                shown.extend([repr(each), str(each)])
            shown.append(repr({name: repr(value) for name, value in vars(client).items()}))
            for call in (
                component.setup_signing(OTHER_KEY),
                component.get("NO_SUCH_NAME", timeout=1.0),
                component.set("NO_SUCH_NAME", 1, timeout=1.0),
            ):
                with pytest.raises(paramclient.ParamClientError) as caught:
                    await call
                shown.extend([repr(caught.value), *traceback.format_exception(caught.value)])
            try:
                raise RuntimeError
            except RuntimeError as error:
                shown.extend(traceback.TracebackException.from_exception(error, capture_locals=True).format())

    live()
    printed = capsys.readouterr()
    written = [path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()]
    assert written
    assert any(KEY.fingerprint in text for text in shown)
    everything = [*shown, caplog.text, printed.out, printed.err]
    for data in [*written, *(text.encode("utf-8", "surrogateescape") for text in everything)]:
        assert not any(form in data for form in FORMS)
