"""Decoding of problem documents (RFC 9457) to exceptions."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, Final

from paramclient.errors import (
    AlreadyRestored,
    AmbiguousVehicle,
    AnotherVehicle,
    CacheError,
    CommandRefused,
    ContestedAddress,
    ExtSetRefused,
    FileError,
    InvalidParameters,
    LinkError,
    NoReply,
    NotDurable,
    NotInCache,
    ParamClientError,
    Refused,
    SetFailed,
    TypeMismatch,
    UnknownParameter,
    UnknownVehicle,
    UsageError,
    ValueNotApplied,
    ValueUnsupported,
    VehicleArmed,
)
from paramclient.model.notation import parse_number
from paramclient.model.values import WireValue

__all__ = ["NotDescribed", "NotHeard", "error_of", "parse_unix_time"]

Problem = Mapping[str, Any]

DETAIL_LENGTH_MAX: Final = 10_000
"""Maximum number of characters of an explanation: one with each invalid line of a file has some thousands."""
_REQUEST_ERRORS: Final = (400, 401, 403, 413, 421, 422)
"""HTTP status codes (RFC 9110) of a request that is not valid or not allowed."""


class NotHeard(NoReply):
    """The service does not know a component. It may appear soon if the service has just started."""


class NotDescribed(UsageError):
    """The service has no metadata of a component's parameters, and the component provides none."""


def error_of(problem: Problem, *, status: int, link: str) -> ParamClientError:
    """Return the exception of a problem, with the class, text and attributes of the original.

    Args:
        problem: the document.
        status: HTTP status code of the response.
        link: name of the client's link, if the problem has none.

    Raises:
        KeyError, TypeError, ValueError: the document is not valid.
    """
    detail = str(
        problem.get("detail") or problem.get("title") or f"the service responds with status {status}"
    )
    detail = detail[:DETAIL_LENGTH_MAX]
    make = _MAKERS.get(str(problem.get("error")))
    if make is not None:
        return make(detail, problem)
    if problem.get("error") in ("LinkError", "ClientClosed"):
        return LinkError(detail, link=str(problem.get("link", link)))
    if str(problem.get("type", "")).endswith(":unknown-component"):
        return NotHeard(detail.rstrip("."), attempts=0, waited=0.0)
    if str(problem.get("type", "")).endswith(":not-described"):
        return NotDescribed(detail)
    if status in _REQUEST_ERRORS or str(problem.get("type", "")).endswith(":ambiguous"):
        return UsageError(detail)
    return LinkError(f"{link}: {detail}", link=link)


def parse_unix_time(given: object) -> float:
    """Return a time in unix seconds.

    Raises:
        TypeError, ValueError: it is not a finite number.
    """
    if isinstance(given, bool) or not isinstance(given, int | float):
        raise TypeError(f"a time must be a number, not {given!r}")
    if not math.isfinite(given):
        raise ValueError("a time must be finite")
    return float(given)


def _address_of(problem: Problem) -> dict[str, Any]:
    index = problem.get("index")
    return {
        "system": int(problem["system"]),
        "component": int(problem["component"]),
        "name": problem.get("name"),
        "index": None if index is None else int(index),
    }


def _vehicles(problem: Problem) -> tuple[str, ...]:
    return tuple(map(str, problem["vehicles"]))


def _no_reply(detail: str, problem: Problem) -> NoReply:
    return NoReply(
        str(problem["awaited"]),
        attempts=int(problem["attempts"]),
        waited=float(problem["waited"]),
        hint=str(problem.get("hint", ""))[:DETAIL_LENGTH_MAX],
    )


def _not_applied(detail: str, problem: Problem) -> ValueNotApplied:
    return ValueNotApplied(
        detail,
        system=int(problem["system"]),
        component=int(problem["component"]),
        name=str(problem["name"]),
        requested=_value(problem["requested"]),
        actual=_value(problem["actual"]),
    )


def _value(given: object) -> WireValue | str:
    """Return the value of a parameter in a problem: a number, text or bytes."""
    if not isinstance(given, Mapping):
        return parse_number(given)
    return str(given["text"]) if "text" in given else bytes.fromhex(given["hex"])


def _ext_refused(kind: type[ExtSetRefused]) -> Callable[[str, Problem], ExtSetRefused]:
    return lambda detail, problem: kind(
        detail,
        system=int(problem["system"]),
        component=int(problem["component"]),
        code=int(problem["code"]),
        name=str(problem["name"]),
    )


def _command_refused(detail: str, problem: Problem) -> CommandRefused:
    return CommandRefused(
        int(problem["system"]), int(problem["component"]), int(problem["command"]), int(problem["code"])
    )


def _another(detail: str, problem: Problem) -> AnotherVehicle:
    return AnotherVehicle(
        int(problem["system"]), int(problem["component"]), str(problem["expected"]), str(problem["found"])
    )


_MAKERS: Final[dict[str, Callable[[str, Problem], ParamClientError]]] = {
    "UsageError": lambda detail, problem: UsageError(detail),
    "FileError": lambda detail, problem: FileError(detail),
    "InvalidParameters": lambda detail, problem: InvalidParameters(dict(problem["problems"])),
    "AlreadyRestored": lambda detail, problem: AlreadyRestored(
        str(problem["summary"])[:DETAIL_LENGTH_MAX],
        before_apply=int(problem["before_apply"]),
        before_restore=int(problem["before_restore"]),
        restored_at=parse_unix_time(problem["restored_at"]),
    ),
    "UnknownVehicle": lambda detail, problem: UnknownVehicle(detail, vehicles=_vehicles(problem)),
    "AmbiguousVehicle": lambda detail, problem: AmbiguousVehicle(
        str(problem["summary"]), vehicles=_vehicles(problem), choose_by=str(problem["choose_by"])
    ),
    "UnknownParameter": lambda detail, problem: UnknownParameter(
        detail, **_address_of(problem), nearest=tuple(map(str, problem.get("nearest", ())))
    ),
    "TypeMismatch": lambda detail, problem: TypeMismatch(detail, **_address_of(problem)),
    "ContestedAddress": lambda detail, problem: ContestedAddress(
        int(problem["system"]),
        int(problem["component"]),
        [str(each) for each in problem["claimants"]],
        str(problem["difference"]),
    ),
    "VehicleArmed": lambda detail, problem: VehicleArmed(detail, **_address_of(problem)),
    "Refused": lambda detail, problem: Refused(detail, code=int(problem["code"]), **_address_of(problem)),
    "CommandRefused": _command_refused,
    "ExtSetRefused": _ext_refused(ExtSetRefused),
    "ValueUnsupported": _ext_refused(ValueUnsupported),
    "SetFailed": _ext_refused(SetFailed),
    "ValueNotApplied": _not_applied,
    "AnotherVehicle": _another,
    "NoReply": _no_reply,
    "CacheError": lambda detail, problem: CacheError(detail),
    "NotDurable": lambda detail, problem: NotDurable(detail),
    "NotInCache": lambda detail, problem: NotInCache(detail),
}
