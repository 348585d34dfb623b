"""Names of links: their spellings, options and faults, and what makes a link."""

from __future__ import annotations

import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from paramclient.errors import UsageError
from paramclient.links import FORMS, SimLink, create_link, parse_link
from paramclient.sim import PX4Vehicle

BY_PATH = "serial:/dev/serial/by-path/pci-0000:00:14.0-usb-0:1:1.0-port0:115200"


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("udp://127.0.0.1:14550", "udpin:127.0.0.1:14550"),
        ("udpin:14550", "udpin:0.0.0.0:14550"),
        ("localhost:14550", "udpin:localhost:14550"),
        ("[::1]:14550", "udpin:[::1]:14550"),
        ("udpin:[0:0:0:0:0:0:0:1]:00080", "udpin:[::1]:80"),
        ("udpin:[fe80::1%eth0]:14550", "udpin:[fe80::1%eth0]:14550"),
        ("UDPIN:LocalHost:14550", "udpin:localhost:14550"),
        (" udpin:0.0.0.0:14550\n", "udpin:0.0.0.0:14550"),
        ("udpout://vehicle_7.local:14550", "udpout:vehicle_7.local:14550"),
        ("tcpin:5760", "tcpin:0.0.0.0:5760"),
        ("serial:/dev/ttyACM0", "serial:/dev/ttyACM0:57600"),
        ("/dev/ttyACM0,115200", "serial:/dev/ttyACM0:115200"),
        ("serial:///dev/ttyUSB0,9600", "serial:/dev/ttyUSB0:9600"),
        ("com5:115200", "serial:COM5:115200"),
        (BY_PATH, BY_PATH),
        ("replay:///logs/a b.tlog", "replay:/logs/a b.tlog"),
        ("replay:what?.tlog", "replay:what?.tlog"),
        ("REPLAY:/x.tlog?speed=2", "replay:/x.tlog?speed=2"),
        ("replay:/x.tlog?speed=inf", "replay:/x.tlog?speed=0.0"),
        ("sim://ArduPilot", "sim:ardupilot"),
        (
            "sim:px4?jitter=-0&queue=0&system=255&reorder=.5",
            "sim:px4?jitter=0.0&queue=0&reorder=0.5&system=255",
        ),
        ("sim:px4?rate=1e3&bit_errors=.00001", "sim:px4?bit_errors=1e-05&rate=1000.0"),
    ],
)
def test_every_spelling_has_one_canonical_name(text: str, name: str) -> None:
    spec = parse_link(text)
    assert str(spec) == spec.name == name
    assert parse_link(name) == spec


NO_HOST_AND_PORT = ["", "0.0.0.0", "0.0.0.0:", "a:65536", "a:-1", "a:+5", "a:١٢", "٣", "::1:1", "a:1/"]
NO_HOSTS = [
    *("[::g]", "[127.0.0.1]", "256.0.0.1", "10.1", "-x", "a..b", "me@host"),
    *("a" * 64, f"{'a.' * 127}a"),
]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "kind of link is missing"),
        ("/home/me/vehicle.params", "kind of link is missing"),
        ("http://127.0.0.1:80", "this is an HTTP address, not a link"),
        ("mavlink:px4", "'mavlink' is not a kind of link"),
        *((f"udpin:{rest}", "expected HOST:PORT") for rest in NO_HOST_AND_PORT),
        *((f"{kind}14550", "expected HOST:PORT") for kind in ("udpout:", "udpout::", "tcp:", "tcp://:")),
        ("udpout:10.0.0.1:0", "expected HOST:PORT"),
        *((f"udpout:{host}:14550", "is not a host name or an address") for host in NO_HOSTS),
        ("serial:ttyACM0:57600", "a device and a baud rate"),
        ("serial:/dev/tty ACM0", "a device and a baud rate"),
        ("/dev/ttyUSB0,57", "from 300 .* not 57"),
        ("sim:", "px4, ardupilot and camera"),
        ("sim:px4?loss", "NAME=VALUE"),
        ("sim:px4?colour=red", "'colour' is not an option"),
        ("sim:px4?loss=0.1&loss=0.2", "given twice"),
        ("sim:px4?param_error=yes", "a number, not 'yes'"),
    ],
)
def test_an_invalid_name_gives_the_problem_and_the_accepted_forms(text: str, problem: str) -> None:
    with pytest.raises(UsageError, match=problem) as caught:
        parse_link(text)
    assert FORMS in str(caught.value)


SCHEMES = "udp udpin udpout tcp tcpin tcpout serial sim http"
MARKS = ": : : // / ? & = [ ] , % . -"
WORDS = (
    "px4 ardupilot [::1] 127.0.0.1 localhost 14550 0 99999 /dev/ttyACM0 COM3 loss seed queue rate 0.5 1e400 é"
)


@given(st.text() | st.lists(st.sampled_from(f"{SCHEMES} {MARKS} {WORDS}".split()), max_size=10).map("".join))
def test_any_text_is_a_link_or_a_usage_error(text: str) -> None:
    try:
        spec = parse_link(text)
    except UsageError:
        return
    assert parse_link(spec.name) == spec
    assert parse_link(spec.name).name == spec.name


# Making links


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ("px4?loss=1.1", "loss must be 0 to 1, not 1.1"),
        ("px4?delay=-1", "delay must be 0 or more"),
        ("px4?loss_burst=0.5", "loss_burst must be 1 or more"),
        ("px4?rate=100&queue=-1", "queue must be 0 or more"),
        ("px4?rate=0", "rate must be a number of bytes per second above 0"),
        ("px4?queue=100", "queue needs a rate"),
        ("px4?system=0", "system must be 1 to 255"),
        ("ardupilot?metadata=1", "option metadata is for sim:px4"),
    ],
)
def test_an_option_out_of_its_range_is_a_usage_error(options: str, problem: str) -> None:
    with pytest.raises(UsageError, match=problem):
        create_link(f"sim:{options}")


def test_create_link_returns_links_unchanged() -> None:
    link = SimLink(PX4Vehicle(), "sim:mine")
    assert create_link(link) is link
    assert create_link(parse_link("udpin:14550")).name == "udpin:0.0.0.0:14550"
    wrapped = create_link(PX4Vehicle())
    assert isinstance(wrapped, SimLink)
    assert wrapped.name == "sim:custom"
    with pytest.raises(UsageError, match="not as object"):
        create_link(object())  # type: ignore[arg-type]  # invalid on purpose


def test_without_the_extra_the_error_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "serialx", None)
    with pytest.raises(UsageError) as caught:
        create_link("/dev/ttyACM0")
    assert str(caught.value) == "serial:/dev/ttyACM0:57600 needs serialx: pip install 'paramclient[serial]'"
