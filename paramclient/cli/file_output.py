"""Tables and texts for parameters of files and of compared sets."""

from __future__ import annotations

from paramclient.cli.output import local_time
from paramclient.files.formats import address
from paramclient.model.identity import autopilot_name
from paramclient.model.names import counted
from paramclient.model.paramset import ParamSet, WrittenParam
from paramclient.model.values import ParamType, Value, format_value


def described(params: ParamSet) -> str:
    """Return a set in words: `903 parameters of 1/1 px4 from link sim:px4, 2026-11-20T18:00:00.000Z`."""
    origin = [
        "" if params.component is None and params.system is None else f"of {address(params)}",
        "" if params.identity is None else autopilot_name(params.identity.autopilot),
        f"from {params.source}" if params.source else "",
    ]
    at = "" if params.at is None else f", {local_time(params.at)}"
    return " ".join(filter(None, [counted(len(params), noun_of(params)), *origin])) + at


def noun_of(params: ParamSet) -> str:
    """Return the parameters of a set in words, in the singular."""
    return "extended parameter" if params.is_extended else "parameter"


def value_text(param: WrittenParam) -> str:
    """Return a parameter's value as text."""
    return _text(param.settable, param)


def _text(value: Value, param: WrittenParam) -> str:
    return format_value(value, ParamType.REAL32 if param.type is None else param.type)
