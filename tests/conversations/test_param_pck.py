"""param.pck: the two real files, the rules of the format one by one, and bytes that are none."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from paramclient.errors import PackError
from paramclient.model.values import from_bits
from paramclient.protocol.param_pck import decode, encode
from paramclient.sim import ardupilot_table
from tests.recordings import DATA

PLAIN = (DATA / "ardupilot_param.pck").read_bytes()
WITH_DEFAULTS = (DATA / "ardupilot_param_withdefaults.pck").read_bytes()
TABLE = Path(__file__).parents[2] / "paramclient" / "sim" / "tables" / "ardupilot.csv"


def packed(*rows: bytes, number: int | None = None, total: int | None = None, magic: int = 0x671B) -> bytes:
    number = len(rows) if number is None else number
    return struct.pack("<HHH", magic, number, number if total is None else total) + b"".join(rows)


def entry(name: str, value: bytes = b"\x07", *, kind: int = 1, shared: int = 0) -> bytes:
    own = name[shared:].encode("latin-1")
    return bytes((kind, shared | len(own) - 1 << 4)) + own + value


@pytest.mark.parametrize("data", [PLAIN, WITH_DEFAULTS], ids=["plain", "with defaults"])
def test_a_real_file_has_every_parameter_and_the_defaults_of_what_differs(data: bytes) -> None:
    pack = decode(data)
    assert pack.total == len(pack.entries) == 1382
    assert pack.with_defaults is (data is WITH_DEFAULTS)
    for each, row in zip(pack.entries, ardupilot_table(), strict=True):
        assert (each.name, each.type, each.bits) == (row.name, row.type, row.bits)
        if data is PLAIN or row.default in (None, row.value):
            assert each.default is None
        else:  # SIM_OH_RELAY_MSK is -1 as an INT16, and 65535 in the firmware's source
            default = from_bits(each.default or 0, each.type)
            assert default == pytest.approx(row.default) or (default, row.default) == (-1, 65535)
    assert sum(each.default is not None for each in pack.entries) == 42 * (data is WITH_DEFAULTS)
    assert encode(pack.entries, with_defaults=pack.with_defaults) == data


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "cut off in its header"),
        (b"\x1b\x67\x01\x00\x01", "cut off in its header"),
        (packed(entry("A"), magic=0x671D), "does not begin with 0x671d"),
        (packed(entry("A"), total=0), "1 entries of a table of 0"),
        (packed(entry("A"), number=2), "cut off: 1 of 2 entries"),
        (packed(entry("A"), b"\0\0\0\0", number=2), "cut off: 1 of 2 entries"),
        (packed(entry("A"), entry("B"), number=1), "4 bytes are left over"),
        (packed(entry("A"), b"\0", number=1), "1 bytes are left over"),
        (packed(entry("A"), entry("A")), "A occurs twice"),
        (packed(entry("AB"), entry("AB", shared=1)), "AB occurs twice"),
        (packed(entry("A", kind=5)), "entry 0 begins with 0x05"),
        (packed(entry("A", kind=0x10)), "entry 0 begins with 0x10"),
        (packed(entry("A", b"\1\2", kind=0x11)), "entry 0 begins with 0x11"),
        (packed(entry("A", b"\1\2", kind=0x21), magic=0x671C), "entry 0 begins with 0x21"),
        (packed(entry("A", b"\1", kind=0x11), magic=0x671C), "cut off: 0 of 1 entries"),
        (packed(entry("AB", shared=1)), "shares 1 characters"),
        (packed(entry("AB"), entry("ABCD", shared=3)), "shares 3 characters"),
        (packed(entry("ABCDEFGHIJ"), entry("ABCDEFGHIJKLMNOPQ", shared=10)), "has the name"),
        (packed(entry("A\0")), "has the name"),
        (packed(entry("A\x7f")), "has the name"),
        (packed(entry("\xc4")), "has the name"),
    ],
)
def test_a_file_that_is_no_param_pck_is_an_error(data: bytes, words: str) -> None:
    with pytest.raises(PackError, match=words) as caught:
        decode(data)
    assert 0 <= caught.value.offset <= len(data)
    assert str(caught.value).endswith(f"(byte {caught.value.offset})")
