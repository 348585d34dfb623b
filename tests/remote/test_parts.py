"""The parts of a client over a service, without one: addresses, documents, problems, events, mirrors."""

from __future__ import annotations

import inspect
import json
import math
import re
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from paramclient import (
    Added,
    AlreadyRestored,
    AnotherVehicle,
    CacheError,
    Change,
    Changed,
    Changes,
    CommandRefused,
    Component,
    ExtParams,
    ExtSetRefused,
    FirstValue,
    InvalidParameters,
    LinkError,
    NoReply,
    Param,
    ParamClient,
    ParamClientError,
    ParamType,
    Refused,
    Removed,
    SetFailed,
    Trust,
    TypeMismatch,
    UnknownParameter,
    UsageError,
    ValueNotApplied,
    ValueUnsupported,
    VehicleArmed,
)
from paramclient.client.client import implementation_of, local_client
from paramclient.client.link_client import LinkClient
from paramclient.client.link_component import LinkComponent
from paramclient.client.link_extended_params import LinkExtParams
from paramclient.documents.param import ParamDoc
from paramclient.model.notation import parse_number
from paramclient.model.values import TYPES_BY_NAME, WireValue, from_bits, type_name
from paramclient.remote import RemoteComponent
from paramclient.remote.bounded import EVENT_BYTES_MAX, EventReader
from paramclient.remote.decoding import param_of, value_as_sent
from paramclient.remote.mirror import LOADING_CHANGES_MAX, Mirror
from paramclient.remote.problems import error_of
from paramclient.remote.remote_extended_params import RemoteExtParams
from paramclient.remote.service_address import CLIENT_TOKEN_VARIABLE, ServiceAddress, chosen_token
from paramclient.remote.service_client import ServiceClient

IN_INTERFACE = {"aclose", "open", "reset"}
"""Calls that the interface itself implements, by other calls."""
ADDRESS: dict[str, Any] = {"system": 1, "component": 1}


# Addresses


@pytest.mark.parametrize(
    ("text", "base", "link"),
    [
        ("http://127.0.0.1:8765", "http://127.0.0.1:8765", None),
        (" HTTPS://Station.local/params/ ", "https://station.local/params", None),
        ("http://[::1]:8765/", "http://[::1]:8765", None),
        ("http://h:1?link=udp:14550", "http://h:1", "udpin:0.0.0.0:14550"),
        ("http://h:1?link=tcpout:Host:5760", "http://h:1", "tcp:host:5760"),
        ("http://h:1/?link=sim:px4%3Floss=0.1%26seed=2", "http://h:1", "sim:px4?loss=0.1&seed=2"),
    ],
)
def test_addresses_of_services(text: str, base: str, link: str | None) -> None:
    address = ServiceAddress.read(text)
    assert (address.base, address.link) == (base, link)
    assert address.name == (base if link is None else f"{base}?link={link}")
    client = ParamClient(text)
    assert type(implementation_of(client)) is ServiceClient
    assert isinstance(client, ParamClient)
    assert repr(client) == f"<RemoteClient {address.name} closed, 0 components>"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("http://", "http://HOST:PORT"),
        ("http://:8765", "http://HOST:PORT"),
        ("http://h:0", "http://HOST:PORT"),
        ("http://h:99999", "out of range"),
        ("http://h:1#top", "after #"),
        ("http://h:1?token=x", "link=NAME"),
        ("http://h:1?link=", "link=NAME"),
        ("http://h:1?link=a&link=b", "link=NAME"),
    ],
)
def test_addresses_that_cannot_be(text: str, words: str) -> None:
    with pytest.raises(UsageError, match=re.escape(words)):
        ParamClient(text)


def test_a_password_in_an_address_is_refused_and_not_repeated() -> None:
    with pytest.raises(UsageError, match="token=") as caught:
        ParamClient("http://anna:secret@h:1")
    assert "secret" not in str(caught.value)


@pytest.mark.parametrize(
    "option",
    [
        *({"cache": False}, {"cache": "x"}, {"system": 1}, {"component": 1}, {"watch_interval": 5}),
        *({"policy": "hash-only"}, {"traffic": True}, {"listen_only": True}, {"forward": "udpout:h:1"}),
        *({"tlog": "x"}, {"signing": object()}, {"encoding": "bytewise"}),
    ],
    ids=lambda option: next(iter(option)),
)
def test_arguments_for_a_link_of_ones_own_are_refused(option: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match=f"{next(iter(option))} is only for a client with its own link"):
        ParamClient("http://h:1", **option)


def test_arguments_that_say_nothing_are_not() -> None:
    ParamClient("http://h:1", cache=None, system=255, component=190, policy="auto", listen_only=False)
    with pytest.raises(TypeError, match="colour"):
        ParamClient("http://h:1", colour="red")  # type: ignore[call-arg]  # that there is none is the point


def test_a_token_is_given_or_stands_in_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(CLIENT_TOKEN_VARIABLE, raising=False)
    assert chosen_token(None) is None
    monkeypatch.setenv(CLIENT_TOKEN_VARIABLE, "from-there")
    assert chosen_token(None) == "from-there"
    assert chosen_token("given") == "given"
    for bad in ("two words", "line\nbreak", "grün"):
        with pytest.raises(UsageError, match="token"):
            ParamClient("http://h:1", token=bad)
    with pytest.raises(UsageError, match="a token is only for a service"):
        ParamClient("sim:px4", token="given")


def test_the_remote_classes_define_every_public_name_of_the_local_ones() -> None:
    """What a client or a component offers either goes over the service or is refused in words."""
    for local, remote in ((ParamClient, ServiceClient), (RemoteComponent.__base__, RemoteComponent)):
        offered = {name for name in vars(local) if not name.startswith("_")} - IN_INTERFACE
        assert offered <= vars(remote).keys()
        assert {"__repr__", "__init__"} <= vars(remote).keys()


@pytest.mark.parametrize(
    ("interface", "implementation"),
    [
        *((ParamClient, LinkClient), (ParamClient, ServiceClient)),
        *((Component, LinkComponent), (Component, RemoteComponent)),
        *((ExtParams, LinkExtParams), (ExtParams, RemoteExtParams)),
    ],
    ids=lambda kind: kind.__name__,
)
def test_both_implementations_take_the_same_arguments(interface: type, implementation: type) -> None:
    for name, call in vars(interface).items():
        if not name.startswith("_") and name not in IN_INTERFACE and inspect.isfunction(call):
            parameters = inspect.signature(getattr(implementation, name)).parameters
            assert parameters == inspect.signature(call).parameters, name


@pytest.mark.parametrize("link", ["sim:px4", "http://h:1"])
def test_a_subclass_is_a_client_over_both(link: str) -> None:
    class Mine(ParamClient):
        def __init__(self, link: str) -> None:
            super().__init__(link)
            self.is_mine = True

    client = Mine(link)
    assert client.is_mine
    assert client.link.name == link
    assert not client.components


def test_local_client_refuses_a_client_of_a_service() -> None:
    assert local_client(ParamClient("sim:px4")).link.name == "sim:px4"
    with pytest.raises(UsageError, match="a service does not give"):
        local_client(ParamClient("http://h:1"))


# Documents


def a_param(kind: int, bits: int, *, is_raw: bool, default: WireValue | None = None) -> Param:
    value = from_bits(bits, kind, is_raw=is_raw)
    known = ParamType(kind) if kind <= ParamType.REAL64 else kind
    return Param("PARAM", value, known, 3, bits, Trust.VERIFIED, default)


def through_json(param: Param) -> Param:
    return param_of(json.loads(json.dumps(ParamDoc.kept(param).as_json(), allow_nan=False)))


@given(st.sampled_from([*TYPES_BY_NAME.values()]), st.data())
def test_a_parameter_loses_no_bit_on_the_way(kind: ParamType, data: st.DataObject) -> None:
    bits = data.draw(st.integers(0, (1 << 8 * kind.size) - 1))
    param = a_param(kind, bits, is_raw=False)
    param = a_param(kind, bits, is_raw=False, default=param.value)
    received = through_json(param)
    assert received == param
    assert repr(received.value) == repr(param.value)
    assert repr(received.default) == repr(param.default)
    assert received.is_changed is False
    assert received.trust is Trust.VERIFIED


@given(st.sampled_from([1, 6, 8, 77, 255]), st.integers(0, 2**32 - 1))
def test_raw_bytes_stay_raw(kind: int, bits: int) -> None:
    param = a_param(kind, bits, is_raw=True)
    received = through_json(param)
    assert (received, received.value, received.is_raw) == (param, param.value, True)
    assert type_name(received.type_number) == type_name(param.type_number)


@pytest.mark.parametrize("value", [0, -(2**63), 2**64, 2.0, -0.0, 1e300, math.inf, -math.inf, math.nan])
def test_sent_values_stay_integers_or_floats(value: float) -> None:
    sent = json.loads(json.dumps(value_as_sent(value), allow_nan=False))
    assert repr(parse_number(sent)) == repr(value)


def test_raw_bytes_are_written_in_the_order_of_the_message() -> None:
    assert value_as_sent(b"\x01\x02\x03\x04") == {"raw": "01020304"}


# Problems

ERRORS: list[ParamClientError] = [
    UsageError("nothing such"),
    UnknownParameter("gone", **ADDRESS, name="A"),
    UnknownParameter("gone", **ADDRESS, index=7),
    Refused("no", **ADDRESS, code=5, name="A"),
    CommandRefused(1, 1, 246, 1),
    TypeMismatch("no", **ADDRESS, name="A"),
    ValueNotApplied("no", **ADDRESS, name="A", requested=1.5, actual=b"\x01\x02\x03\x04"),
    ValueNotApplied("no", **ADDRESS, name="A", requested=3, actual=math.inf),
    ValueNotApplied("no", **ADDRESS, name="A", requested="0x01", actual=b"\x00\xff" * 9),
    ValueNotApplied("no", **ADDRESS, name="A", requested="NaN", actual=2**64 - 1),
    ExtSetRefused("no", **ADDRESS, name="A", code=9),
    ValueUnsupported("no", **ADDRESS, name="A", code=1),
    SetFailed("no", **ADDRESS, name="A", code=2),
    VehicleArmed("no", **ADDRESS),
    AnotherVehicle(1, 1, "this", "that"),
    NoReply("A of 1/1", attempts=4, waited=2.1234),
    NoReply("an autopilot", attempts=0, waited=2.0, hint="Nothing was received on udpin:0.0.0.0:14550."),
    UnknownParameter("1/1 has no B. Did you mean A?", system=1, component=1, name="B", nearest=("A",)),
    LinkError("gone", link="udpin:0.0.0.0:14550"),
    CacheError("broken"),
    InvalidParameters({"A": "is too large", "B": "is no number"}),
    AlreadyRestored("a restore ran 3 s ago", before_apply=4, before_restore=6, restored_at=1.5e9),
]


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_an_error_is_the_same_on_both_sides(error: ParamClientError) -> None:
    from paramclient.service.problems import problem_of

    problem = problem_of(error).as_json()
    received = error_of(json.loads(json.dumps(problem)), status=problem["status"], link="http://h:1")
    assert type(received) is type(error)
    assert str(received) == str(error)
    assert vars(received) == vars(error)


def test_a_problem_that_no_exception_stands_behind() -> None:
    def reported(kind: str, status: int) -> ParamClientError:
        problem = {"type": f"urn:paramclient:{kind}", "detail": "So it is."}
        return error_of(problem, status=status, link="http://h:1")

    for kind, status in (("forbidden", 403), ("invalid-request", 422), ("ambiguous", 409)):
        error = reported(kind, status)
        assert type(error) is UsageError
        assert str(error) == "So it is."
    assert isinstance(reported("unknown-component", 404), NoReply)
    for kind, status in (("internal", 500), ("too-many", 429)):
        error = reported(kind, status)
        assert type(error) is LinkError
        assert str(error) == "http://h:1: So it is."
    assert (
        str(error_of({}, status=418, link="http://h:1")) == "http://h:1: the service responds with status 418"
    )


# Events


def cut(text: bytes, size: int) -> list[str]:
    reader = EventReader()
    return [
        each.decode() for at in range(0, len(text), size) for each in reader.receive(text[at : at + size])
    ]


def test_events_are_read_however_they_are_cut() -> None:
    text = 'id: r-1\ndata: {"a": "\u2028"}\n\n: \nid: r-1\n\n'
    text += "event: x\r\ndata: one\r\ndata:two\r\n\r\nretry: 1\n\n"
    for size in range(1, 60):
        assert cut(text.encode(), size) == ['{"a": "\u2028"}', "one\ntwo"]


def test_an_event_without_end() -> None:
    reader = EventReader()
    for _ in range(EVENT_BYTES_MAX >> 20):
        reader.receive(b"x" * (1 << 20))
    with pytest.raises(ValueError, match="an event of more than"):
        reader.receive(b"x")


# Mirrors


def param(value: int, trust: Trust = Trust.LIVE, name: str = "A") -> Param:
    return Param(name, value, ParamType.INT32, 0, value, trust)


def shown(mirror: Mirror) -> dict[str, tuple[WireValue, Trust]]:
    return {name: (each.value, each.trust) for name, each in mirror.params.items()}


def loaded(mirror: Mirror, seq: int, *params: Param) -> list[Change] | None:
    mirror.begin()
    return mirror.load(seq, {each.name: each for each in params})


def test_events_before_a_loaded_table_are_dropped_and_later_ones_applied() -> None:
    mirror = Mirror()
    mirror.begin()
    for seq in (4, 5, 6):
        assert mirror.take(seq, Change("A", None, param(seq))) is None
    assert mirror.load(5, {"A": param(5)}) == [Change("A", param(5), param(6))]
    assert shown(mirror) == {"A": (6, Trust.LIVE)}
    assert mirror.take(6, Change("A", None, param(1))) is None
    assert mirror.take(7, Change("A", param(6), param(7), "us")) == Change("A", param(6), param(7), "us")
    assert mirror.take(8, Change("A", param(7), None)) == Change("A", param(7), None)
    assert shown(mirror) == {}


def test_a_first_table_is_no_change_and_a_later_one_gives_the_differences() -> None:
    mirror = Mirror()
    assert loaded(mirror, 1, param(1), param(2, name="B"), param(3, name="C")) == []
    mirror.doubt()
    changes = loaded(mirror, 9, param(1, Trust.CACHED), param(5, name="B"), param(6, name="D"))
    assert changes == [
        Change("C", param(3, name="C"), None),
        Change("B", param(2, name="B"), param(5, name="B")),
        Change("D", None, param(6, name="D")),
    ]
    assert [type(each) for each in changes] == [Removed, Changed, Added]
    assert list(mirror.params) == ["A", "B", "D"]


def test_added_and_removed_names_are_reported_as_such() -> None:
    mirror = Mirror()
    loaded(mirror, 1)
    assert type(mirror.take(2, Change("A", None, param(1)))) is FirstValue, "the service receives the table"
    assert type(mirror.take(3, Added("B", None, param(1, name="B")))) is Added
    assert type(mirror.take(4, Added("B", None, param(2, name="B")))) is Changed, "it is here"
    assert type(mirror.take(5, Change("B", param(2, name="B"), None))) is Removed


def test_a_slow_listener_receives_the_sum_of_additions_and_removals() -> None:
    changes = Changes()
    for change in (
        Added("A", None, param(1)),
        Change("A", param(1), param(2), "us"),
        Added("B", None, param(1, name="B")),
        Removed("B", param(1, name="B"), None),
        Removed("C", param(1, name="C"), None),
        Added("C", None, param(2, name="C")),
        Change("D", None, param(1, name="D")),
        Change("D", param(1, name="D"), param(2, name="D")),
    ):
        changes.push(change)
    reported = [changes._take() for _ in range(4)]
    assert [each and (type(each), each.name) for each in reported] == [
        (Added, "A"),
        (Changed, "C"),
        (FirstValue, "D"),
        None,
    ]


def test_a_change_of_trust_alone_is_none() -> None:
    mirror = Mirror()
    loaded(mirror, 1, param(1, Trust.CACHED))
    assert mirror.take(2, Change("A", None, param(1, Trust.LIVE))) is None
    assert shown(mirror) == {"A": (1, Trust.LIVE)}
    mirror.confirm(param(1, Trust.VERIFIED))
    assert shown(mirror) == {"A": (1, Trust.VERIFIED)}
    mirror.confirm(param(2))
    assert shown(mirror) == {"A": (1, Trust.VERIFIED)}, "only events report changes"


@pytest.mark.parametrize("how", [Mirror.doubt, Mirror.leave])
def test_values_that_may_be_stale_are_cached(how: Callable[[Mirror], None]) -> None:
    mirror = Mirror()
    loaded(mirror, 1, param(1))
    how(mirror)
    assert shown(mirror) == {"A": (1, Trust.CACHED)}
    mirror.confirm(param(1, Trust.LIVE))
    assert shown(mirror) == {"A": (1, Trust.CACHED)}
    mirror.resume()
    is_known = how is Mirror.leave
    assert shown(mirror) == {"A": (1, Trust.LIVE if is_known else Trust.CACHED)}
    if not is_known:
        loaded(mirror, 2, param(1))
        assert shown(mirror) == {"A": (1, Trust.LIVE)}


def test_a_table_that_is_doubted_while_it_is_loaded_is_loaded_again() -> None:
    mirror = Mirror()
    mirror.begin()
    mirror.doubt()
    assert mirror.load(5, {"A": param(5)}) is None
    assert not mirror.is_loaded
    mirror.begin()
    for seq in range(LOADING_CHANGES_MAX + 1):
        mirror.take(seq, Change("A", None, param(seq)))
    assert mirror.load(5, {"A": param(5)}) is None, "more changes arrived meanwhile than are kept"


@given(st.data())
def test_a_mirror_has_what_the_service_has(data: st.DataObject) -> None:
    """Whatever happens there, and whenever the connection drops or the table is loaded."""
    there: dict[str, Param] = {}
    log: list[tuple[int, Change]] = []
    mirror = Mirror()
    seen = 0
    snapshot: tuple[int, dict[str, Param]] | None = None
    steps = st.sampled_from(["happen", "happen", "hear", "begin", "snapshot", "load", "leave", "gap"])
    for step in data.draw(st.lists(steps, max_size=60)):
        if step == "happen":
            name, value = data.draw(st.sampled_from("ABC")), data.draw(st.none() | st.integers(0, 3))
            old = there.pop(name, None) if value is None else there.get(name)
            new = None if value is None else param(value, name=name)
            if new is not None:
                there[name] = new
            log.append((len(log) + 1, Change(name, old, new)))
        elif step == "hear" and seen < len(log):
            mirror.take(*log[seen])
            seen += 1
        elif step == "begin" and not mirror.is_loaded:
            mirror.begin()
            snapshot = None
        elif step == "snapshot":
            snapshot = len(log), dict(there)
        elif step == "load" and snapshot is not None and not mirror.is_loaded:
            mirror.load(*snapshot)
            snapshot = None
        elif step == "leave":
            mirror.leave()
            assert {trust for _, trust in shown(mirror).values()} <= {Trust.CACHED}
            mirror.resume()
        elif step == "gap":
            mirror.doubt()
            seen, snapshot = len(log), None
            assert {trust for _, trust in shown(mirror).values()} <= {Trust.CACHED}
    if not mirror.is_loaded:
        mirror.begin()
        mirror.load(len(log), dict(there))
    for event in log[seen:]:
        mirror.take(*event)
    assert mirror.params == there
