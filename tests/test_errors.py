"""Exceptions: base classes, attributes, and message texts."""

from __future__ import annotations

import pytest
from pymavlink.dialects.v20 import all as dialect

from paramclient import errors


@pytest.mark.parametrize(
    ("kind", "base"),
    [
        (errors.UsageError, ValueError),
        (errors.FileError, errors.UsageError),
        (errors.UnknownParameter, errors.VehicleError),
        (errors.Refused, errors.VehicleError),
        (errors.TypeMismatch, errors.VehicleError),
        (errors.ValueNotApplied, errors.VehicleError),
        (errors.FileTransferError, errors.VehicleError),
        (errors.NoReply, TimeoutError),
        (errors.LinkError, OSError),
        (errors.ClientClosed, errors.LinkError),
        (errors.InvalidParameters, errors.UsageError),
        (errors.VehicleArmed, errors.VehicleError),
        (errors.PackError, errors.ParamClientError),
        (errors.CacheError, errors.ParamClientError),
    ],
)
def test_base_classes_of_errors(kind: type[Exception], base: type[Exception]) -> None:
    assert issubclass(kind, base)
    assert issubclass(kind, errors.ParamClientError)


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
    assert names.items() <= {code.name: code.value for code in errors.ParamErrorCode}.items()


@pytest.mark.parametrize(
    ("code", "words"), [(5, "read only"), (2, "value out of range"), (99, "error code 99")]
)
def test_param_error_code_names(code: int, words: str) -> None:
    assert errors.ParamErrorCode.name_of(code) == words
    refused = errors.Refused("no", system=1, component=2, code=code, name="A", index=3)
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
    assert spelled == {code.name.replace("_", ""): code.value for code in errors.FileErrorCode}
