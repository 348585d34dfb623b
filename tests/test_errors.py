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
