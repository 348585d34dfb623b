"""JSON of metadata: the same values as another parser's, and no long call into C."""

from __future__ import annotations

import gc
import json
import math
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic_core import from_json

from paramclient.errors import MetadataError
from paramclient.metadata import json_parser, read_content
from paramclient.metadata.json_parser import parse_json

VALUES = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=30,
)


@given(VALUES, st.booleans(), st.sampled_from([None, 1]))
def test_values_are_those_of_another_parser(value: object, is_ascii: bool, indent: int | None) -> None:
    content = json.dumps(value, ensure_ascii=is_ascii, indent=indent).encode()
    found = parse_json(content)
    assert repr(found) == repr(from_json(content))  # NaN equals nothing
    assert repr(found) == repr(value)


@given(VALUES, st.data())
def test_damaged_documents_are_parsed_or_rejected_as_by_another_parser(
    value: object, data: st.DataObject
) -> None:
    content = bytearray(json.dumps(value, ensure_ascii=data.draw(st.booleans())).encode())
    at = data.draw(st.integers(0, len(content) - 1))
    if data.draw(st.booleans()):
        content[at] = data.draw(st.sampled_from(b'"\\{}[]:, 1-+.eEuNIt\x00\x1f\x80\xff'))
    else:
        del content[at:]
    try:
        expected = repr(from_json(bytes(content)))
    except ValueError:
        with pytest.raises(ValueError, match=r"^not JSON: "):
            parse_json(bytes(content))
    else:
        assert repr(parse_json(bytes(content))) == expected


@pytest.mark.parametrize(
    ("text", "value"),
    [
        (r'{"a":1,"b":{"a":"\\"},"a":[2]}', {"a": [2], "b": {"a": "\\"}}),
        (r'["\"\\\"", "\\\\", "\ud83d\ude00", "\u00e9é"]', ['"\\"', "\\\\", "\U0001f600", "éé"]),
        (' \r\n\t[ { "a" : [ [ ] , { } ] } ] \n', [{"a": [[], {}]}]),
        ("[Infinity,-Infinity,-0,1e3]", [math.inf, -math.inf, 0, 1000.0]),
        ("9" * 4_300, 10**4_300 - 1),
        ("[" * 200 + "]" * 200, None),
    ],
)
def test_documents(text: str, value: object) -> None:
    found = parse_json(text.encode())
    assert found == (from_json(text) if value is None else value)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (rb'{"a": ["\ud800", {}]}', "unexpected end of hex escape at line 1 column 8"),
        (rb'{"\ud800": {}}', "unexpected end of hex escape at line 1 column 2"),
        (b'{"a":\n[{"b": "\xff"}]}', "invalid unicode code point at line 2 column 2"),
        (b'["\n", []]', "control character .* at line 1 column 2"),
        (b'{"a":1,}', "trailing comma at line 1 column 1"),
        (b'{"a":[],}', "key must be a string at line 1 column 9"),
        (b'{"a" []}', "expected `:` at line 1 column 6"),
        (b'{"a":[] "b":[]}', "expected `,` or `}` at line 1 column 9"),
        (b"[[] 1]", "expected `,` or `]` at line 1 column 5"),
        (b"[[],]", "expected value at line 1 column 5"),
        (b"[] x", "trailing characters at line 1 column 4"),
        (b"[[" + b"9" * 4_301 + b"]]", "number out of range at line 1 column 3"),
        (b'{"a": "b\\"', "EOF while parsing a string at line 1 column 11"),
        (b"[[", "EOF while parsing a value at line 1 column 3"),
        (b"", "EOF while parsing a value at line 1 column 1"),
        (b"[" * 202 + b"]" * 202, "recursion limit exceeded at line 1 column 201"),
        (b"[" * 100_000, "recursion limit exceeded at line 1 column 201"),
        (b'["' + b"x" * 524_288 + b'"]', "a string of more than 524,288 bytes at line 1 column 2"),
    ],
)
def test_invalid_documents_are_rejected_with_reason_and_place(content: bytes, said: str) -> None:
    with pytest.raises(ValueError, match=f"^not JSON: {said}$"):
        parse_json(content)


def test_values_are_limited() -> None:
    most = json_parser.SEPARATORS_MAX
    assert parse_json(b"[" + b"0," * (most - 1) + b"0]") == [0] * most
    with pytest.raises(ValueError, match=r"^has more than 200,000 values$"):
        parse_json(b"[" + b"0," * most + b"0]")


def _in_px4(value: bytes) -> bytes:
    return b'{"version":1,"parameters":[{"name":"A","x":%s}]}' % value


COUNT = 190_000
HOSTILE: dict[str, Callable[[], bytes]] = {
    "members": lambda: _in_px4(b"{" + b",".join(b'"%06d":1' % number for number in range(COUNT)) + b"}"),
    "members of a parameter of ArduPilot": lambda: (
        b'{"json":{},"G":{"A":{"Values":{' + b",".join(b'"%06d":"a"' % n for n in range(COUNT)) + b"}}}}"
    ),
    "empty objects": lambda: _in_px4(b"[" + b",".join([b"{}"] * (COUNT // 2)) + b"]"),
    "strings": lambda: _in_px4(b"[" + b",".join(b'"%06d"' % number for number in range(COUNT)) + b"]"),
    "numbers": lambda: _in_px4(b"[" + b",".join(b"%d.5e-7" % number for number in range(COUNT)) + b"]"),
    "nested": lambda: _in_px4(b"[" + b",".join([b"[" * 150 + b"]" * 150] * (COUNT // 151)) + b"]"),
    "escapes": lambda: _in_px4(b"[" + b",".join([b'"' + b"\\n" * 262_000 + b'"'] * 15) + b"]"),
    "attributes": lambda: (
        b"<paramfile><param name='A' " + b" ".join(b"a%d=''" % n for n in range(COUNT)) + b"/></paramfile>"
    ),
    "named values in XML": lambda: (
        b"<paramfile><param name='A'><field name='Values'>"
        + b",".join(b"%d:a" % n for n in range(800_000))
        + b"</field></param></paramfile>"
    ),
}
"""Files within the limits of size and separators, each of which takes 0.1 s or more in one call into C."""
REFUSED_AT_ONCE = 0.02
"""Seconds within which files are refused that are not read to the end."""


@pytest.mark.skipif(not hasattr(time, "pthread_getcpuclockid"), reason="needs the processor time of a thread")
@pytest.mark.parametrize("shape", HOSTILE)
def test_other_threads_run_while_a_hostile_file_is_read(shape: str) -> None:
    """The longest processor time of the reading thread between two turns of another thread is a small part of
    its whole time: one call into C that held the interpreter would be nearly all of it."""
    content = HOSTILE[shape]()
    before = sys.getswitchinterval()
    sys.setswitchinterval(0.001)  # as in the service, and so is the next line
    gc.freeze()
    try:
        assert min(_longest_hold(content) for _ in range(3)) < 0.25
    finally:
        gc.unfreeze()
        sys.setswitchinterval(before)


def _longest_hold(content: bytes) -> float:
    """Return the longest part of the reading thread's time in which no other thread ran."""

    def read() -> None:
        is_watched.wait()
        with suppress(MetadataError):
            read_content(content, source="the file")

    is_watched = threading.Event()
    reading = threading.Thread(target=read)
    reading.start()
    assert reading.ident is not None
    clock: Any = time.pthread_getcpuclockid(reading.ident)
    longest, began = 0.0, time.clock_gettime(clock)
    last = began
    is_watched.set()
    while reading.is_alive():
        with suppress(OSError):  # it has just ended
            now = time.clock_gettime(clock)
            longest, last = max(longest, now - last), now
        time.sleep(0.001)
    return longest / (last - began) if last - began > REFUSED_AT_ONCE else 0.0
