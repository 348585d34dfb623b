"""Exceptions: base classes, attributes, and message texts."""

from __future__ import annotations

from enum import IntEnum

import pytest
from pymavlink.dialects.v20 import all as dialect

from paramclient import errors


def test_every_error_can_be_caught_as_what_python_calls_it() -> None:
    for kind, base in (
        (errors.UsageError, ValueError),
        (errors.NoReply, TimeoutError),
        (errors.LinkError, OSError),
        (errors.FileError, errors.UsageError),
        (errors.ClientClosed, errors.LinkError),
        (errors.Refused, errors.VehicleError),
    ):
        assert issubclass(kind, base)
    public = [getattr(errors, name) for name in errors.__all__]
    kinds = [each for each in public if issubclass(each, Exception)]
    assert all(issubclass(each, errors.ParamClientError) for each in kinds)


@pytest.mark.parametrize(
    ("prefix", "codes"), [("MAV_PARAM_ERROR_", errors.ParamErrorCode), ("MAV_FTP_ERR_", errors.FileErrorCode)]
)
def test_codes_match_pymavlink(prefix: str, codes: type[IntEnum]) -> None:
    """Codes 6 to 8 of PARAM_ERROR are newer than pymavlink's dialect."""
    theirs = {
        name.removeprefix(prefix): value for name, value in vars(dialect).items() if name.startswith(prefix)
    }
    theirs.pop("ENUM_END", None)
    assert len(theirs) >= 6
    spelled = {name.replace("_", ""): value for name, value in theirs.items()}
    assert spelled.items() <= {code.name.replace("_", ""): code.value for code in codes}.items()
