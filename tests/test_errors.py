"""Exceptions: base classes, attributes, and message texts."""

from __future__ import annotations

import pytest
from pymavlink.dialects.v20 import all as dialect

from paramclient import errors
from paramclient.errors import (
    CacheError,
    ClientClosed,
    FileError,
    FileErrorCode,
    FileTransferError,
    InvalidParameters,
    LinkError,
    MetadataError,
    NoReply,
    PackError,
    ParamClientError,
    ParamErrorCode,
    Refused,
    TypeMismatch,
    UnknownParameter,
    UsageError,
    ValueNotApplied,
    VehicleArmed,
    VehicleError,
)


@pytest.mark.parametrize(
    ("kind", "base"),
    [
        (UsageError, ValueError),
        (MetadataError, UsageError),
        (FileError, UsageError),
        (UnknownParameter, VehicleError),
        (Refused, VehicleError),
        (TypeMismatch, VehicleError),
        (ValueNotApplied, VehicleError),
        (FileTransferError, VehicleError),
        (NoReply, TimeoutError),
        (LinkError, OSError),
        (ClientClosed, LinkError),
        (InvalidParameters, UsageError),
        (VehicleArmed, VehicleError),
        (PackError, ParamClientError),
        (CacheError, ParamClientError),
    ],
)
def test_base_classes_of_errors(kind: type[Exception], base: type[Exception]) -> None:
    assert issubclass(kind, base)
    assert issubclass(kind, ParamClientError)


def test_vehicle_errors_are_neither_link_nor_usage_errors() -> None:
    assert not issubclass(VehicleError, OSError | ValueError)
    assert not issubclass(NoReply, LinkError | VehicleError)


def test_all_lists_every_error() -> None:
    defined = {
        name for name, thing in vars(errors).items() if getattr(thing, "__module__", "") == errors.__name__
    }
    assert defined == set(errors.__all__)


def test_param_error_codes_match_pymavlink() -> None:
    """Codes 6 to 8 are newer than pymavlink's dialect."""
    names = {
        name.removeprefix("MAV_PARAM_ERROR_"): value
        for name, value in vars(dialect).items()
        if name.startswith("MAV_PARAM_ERROR_") and not name.endswith("ENUM_END")
    }
    assert len(names) >= 6
    assert names.items() <= {code.name: code.value for code in ParamErrorCode}.items()


@pytest.mark.parametrize(
    ("code", "words"), [(5, "read only"), (2, "value out of range"), (99, "error code 99")]
)
def test_param_error_code_names(code: int, words: str) -> None:
    assert ParamErrorCode.name_of(code) == words
    refused = Refused("no", system=1, component=2, code=code, name="A", index=3)
    assert (refused.code, refused.reason) == (code, words)
    assert (refused.system, refused.component, refused.name, refused.index) == (1, 2, "A", 3)
    assert str(refused) == "no"


def test_file_error_codes_match_pymavlink() -> None:
    names = {
        name.removeprefix("MAV_FTP_ERR_"): value
        for name, value in vars(dialect).items()
        if name.startswith("MAV_FTP_ERR_") and not name.endswith("ENUM_END")
    }
    spelled = {name.replace("_", ""): value for name, value in names.items()}
    assert spelled == {code.name.replace("_", ""): code.value for code in FileErrorCode}


@pytest.mark.parametrize(
    ("code", "errno", "words", "not_found"),
    [
        (10, 0, "file not found", True),
        (2, 2, "fail errno", True),
        (2, 13, "fail errno", False),
        (1, 2, "fail", False),
        (99, 0, "error code 99", False),
    ],
)
def test_attributes_of_a_file_transfer_error(code: int, errno: int, words: str, not_found: bool) -> None:
    error = FileTransferError("no", system=1, component=2, path="a.txt", code=code, errno=errno)
    assert (error.system, error.component, error.name, error.path) == (1, 2, None, "a.txt")
    assert (error.code, error.errno, error.reason) == (code, errno, words)
    assert error.is_not_found is not_found


def test_a_pack_error_has_the_offset() -> None:
    error = PackError("it is cut off", offset=7)
    assert str(error) == "it is cut off (byte 7)"
    assert error.offset == 7


@pytest.mark.parametrize(
    ("source", "line", "text"),
    [
        ("quad.param", 17, "quad.param:17: expected A"),
        ("", 17, "line 17: expected A"),
        ("quad.param", None, "quad.param: expected A"),
        ("", None, "expected A"),
    ],
)
def test_a_file_error_starts_with_file_and_line(source: str, line: int | None, text: str) -> None:
    error = FileError("expected A", source=source, line=line, expected="A", more=("and more",))
    assert str(error) == f"{text}\nand more"
    assert (error.source, error.line, error.expected) == (source, line, "A")


def test_value_not_applied_has_both_values() -> None:
    error = ValueNotApplied("kept", system=1, component=1, name="A", requested=2.0, actual=1.0)
    assert (error.name, error.requested, error.actual, error.index) == ("A", 2.0, 1.0, None)


@pytest.mark.parametrize(
    ("attempts", "text"),
    [
        (0, "no reply: A in 1.5 s"),
        (1, "no reply: A after 1 try in 1.5 s"),
        (4, "no reply: A after 4 tries in 1.5 s"),
    ],
)
def test_no_reply_has_attempts_and_duration(attempts: int, text: str) -> None:
    error = NoReply("A", attempts=attempts, waited=1.49)
    assert str(error) == text
    assert (error.awaited, error.attempts, error.waited) == ("A", attempts, 1.49)
    assert str(NoReply("A", attempts=attempts, waited=1.49, hint="B.")) == f"{text}. B."


def test_a_link_error_has_the_links_name() -> None:
    error = ClientClosed("the client was closed", link="udpin:0.0.0.0:14550")
    assert str(error) == "the client was closed"
    assert error.link == "udpin:0.0.0.0:14550"
