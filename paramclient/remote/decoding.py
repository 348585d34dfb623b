"""Decoding of JSON documents of a service to records of the library, without loss of values."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from types import NoneType
from typing import Any, Final

from paramclient.cache import SnapshotSummary
from paramclient.client.stats import ClientStats
from paramclient.documents.extended_param import ExtParamDoc
from paramclient.documents.param import ParamDoc
from paramclient.errors import LinkError, ParamClientError
from paramclient.model.ext_params import ExtParam, ExtValue
from paramclient.model.ext_paramset import ExtParamSet
from paramclient.model.identity import Identity
from paramclient.model.notation import parse_value
from paramclient.model.paramset import ParamSet, RestorePoint, WrittenParam
from paramclient.model.values import Param, ParamType, WireValue, type_of_name
from paramclient.protocol.ext.fetch import ExtFetchResult
from paramclient.protocol.ext.write_batch import ExtSetOutcome
from paramclient.protocol.ext.writes import ExtSetResult
from paramclient.protocol.params.fetch_result import FetchResult, Progress
from paramclient.protocol.params.sampling import Sample
from paramclient.protocol.params.write_batch import SetOutcome, SetStatus
from paramclient.protocol.params.writes import SetResult
from paramclient.remote.problems import error_of, parse_unix_time

__all__ = [
    "Document",
    "check_kind",
    "ext_fetch_result_of",
    "ext_param_of",
    "ext_params_of",
    "ext_set_outcome_of",
    "ext_set_result_of",
    "ext_snapshot_of",
    "ext_state_of",
    "ext_value_as_sent",
    "fetch_result_of",
    "hash_of",
    "identity_of",
    "param_of",
    "params_of",
    "progress_of",
    "restore_point_of",
    "set_outcome_of",
    "set_result_of",
    "state_of",
    "stats_of",
    "decode_errors",
    "value_as_sent",
]

Document = Mapping[str, Any]

_IDENTITY: Final = {"link": (str,), "git_hash": (str,), "uid": (str, NoneType)}
"""Types of the members of an identity that are not integers."""


@contextmanager
def decode_errors(name: str) -> Iterator[None]:
    """Context for decoding documents: errors become LinkError.

    Args:
        name: name of the link, for messages.

    Raises:
        LinkError: a document is not valid.
    """
    try:
        yield
    except ParamClientError:
        raise
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError, struct.error) as error:
        raise LinkError(f"{name}: a document of the service is not valid: {error!r}", link=name) from error


def value_as_sent(value: WireValue) -> object:
    """Return the JSON form of a value for a write, without loss."""
    if isinstance(value, bytes):
        return {"raw": value.hex()}
    if isinstance(value, float) and value - value != 0.0:  # NaN and infinities, which JSON does not have
        return "NaN" if value != value else "Infinity" if value > 0 else "-Infinity"
    return value


def param_of(document: Document, name: str | None = None) -> Param:
    """Return the parameter of a document.

    Args:
        document: the document.
        name: param_id; None if it is in the document.
    """
    found = ParamDoc.model_validate(document)
    name = found.name if name is None else name
    check_kind(name, str)
    assert name is not None
    return found.param(name)


def ext_param_of(document: Document, name: str | None = None) -> ExtParam:
    """Return the extended parameter of a document.

    Args:
        document: the document.
        name: param_id; None if it is in the document.
    """
    found = ExtParamDoc.model_validate(document)
    name = found.name if name is None else name
    check_kind(name, str)
    assert name is not None
    return found.param(name)


def ext_params_of(documents: Mapping[str, Document]) -> dict[str, ExtParam]:
    """Return a whole table of extended parameters, in the order of the service."""
    return {name: ext_param_of(document, name) for name, document in documents.items()}


def params_of(documents: Mapping[str, Document]) -> dict[str, Param]:
    """Return a whole table, in the order of the service."""
    return {name: param_of(document, name) for name, document in documents.items()}


def hash_of(text: str | None) -> int | None:
    """Return a PX4 hash, or None."""
    return None if text is None else int(text, 16)


def identity_of(document: Document) -> Identity:
    """Return the identity of a vehicle. Members unknown to this version are ignored."""
    known = {each.name: document[each.name] for each in fields(Identity)}
    for name, value in known.items():
        check_kind(value, *_IDENTITY.get(name, (int,)))
    return Identity(**known)


def check_kind(value: object, *kinds: type) -> None:
    """Check that a value is of one of these types. A boolean is not a number.

    Raises:
        TypeError: the value has another type.
    """
    if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
        raise TypeError(f"{value!r:.40} has the wrong type")


def progress_of(document: Document) -> Progress:
    """Return the progress of a fetch."""
    progress = Progress(*(document[name] for name in ("received", "total", "rate", "seconds_left")))
    check_kind(progress.received, int)
    check_kind(progress.total, int, NoneType)
    check_kind(progress.rate, int, float)
    check_kind(progress.seconds_left, int, float, NoneType)
    return progress


def fetch_result_of(document: Document, params: Mapping[str, Param], elapsed: float) -> FetchResult:
    """Return the result of a fetch.

    Args:
        document: the result without parameters.
        params: the current parameters.
        elapsed: seconds from the call to its end.
    """
    sample = document["sample"]
    return FetchResult(
        system=document["system"],
        component=document["component"],
        params=dict(params),
        source=document["source"],
        count=document["count"],
        received=document["received"],
        missing=tuple(document["missing"]),
        hash=hash_of(document["hash"]),
        elapsed=elapsed,
        notes=tuple(document["notes"]),
        resumed=document["resumed"],
        lost=document["lost"],
        repeated=document["repeated"],
        round_trip=document["round_trip_s"],
        sample=None if sample is None else Sample(**{**sample, "differing": tuple(sample["differing"])}),
    )


def set_result_of(document: Document, requested: WireValue) -> SetResult:
    """Return the result of a write."""
    param = param_of(document["param"])
    return SetResult(
        document["name"],
        document["status"],
        requested,
        param,
        document["attempts"],
        document.get("note", ""),
    )


def set_outcome_of(document: Document, name: str, requested: WireValue, link: str) -> SetOutcome:
    """Return the outcome of one of several writes."""
    problem = document.get("problem")
    if problem is None:
        result = set_result_of(document, requested)
        return SetOutcome(name, requested, SetStatus(result.status), result)
    error = error_of(problem, status=problem["status"], link=link)
    return SetOutcome(name, requested, SetStatus(document["status"]), error=error)


def ext_snapshot_of(document: Document, key: str) -> SnapshotSummary:
    """Return a snapshot of extended parameters of the vehicle with this key, without its parameters."""
    return SnapshotSummary(
        int(document["id"]),
        key,
        int(document["component"]),
        float(document["at"]),
        str(document["reason"]),
        int(document["size"]),
        None,
        bool(document["complete"]),
    )


def ext_state_of(document: Document, identity: Identity) -> ExtParamSet:
    """Return an earlier state of the extended parameters of a vehicle."""
    params = {name: ext_param_of({**each, "name": name}) for name, each in document["params"].items()}
    at = document["at"]
    return ExtParamSet(
        params,
        document["system"],
        document["component"],
        None if at is None else float(at),
        str(document["source"]),
        identity,
    )


def state_of(document: Document) -> ParamSet:
    """Return an earlier state of a component (`StateDoc`)."""
    at, identity = document["at"], document["identity"]
    for name in ("system", "component"):
        check_kind(document[name], int, NoneType)
    return ParamSet(
        {name: _written_of(name, each) for name, each in document["params"].items()},
        document["component"],
        document["system"],
        None if identity is None else identity_of(identity),
        None if at is None else float(at),
        str(document["source"]),
    )


def restore_point_of(document: Document) -> RestorePoint:
    """Return the state before the last apply (`StateDoc`)."""
    point = document["restore_point"]
    check_kind(point["snapshot"], int)
    changes = {str(name): parse_unix_time(at) for name, at in point["changes"].items()}
    return RestorePoint(point["snapshot"], parse_unix_time(point["at"]), state_of(document), changes)


def _written_of(name: str, document: Document) -> WrittenParam:
    name_of_type = document["type"]
    kind = None if name_of_type is None else type_of_name(name_of_type)
    value = parse_value(document["value"], ParamType.REAL64 if kind is None else kind)
    return WrittenParam(name, value, kind)


def ext_value_as_sent(value: ExtValue) -> object:
    """Return the JSON form of an extended value for a write, without loss.

    The words of NaN and infinities would be taken as numbers by a service if the parameter is one.
    """
    if isinstance(value, bytes):
        return {"hex": value.hex()}
    if isinstance(value, str):
        return {"hex": value.encode().hex()} if value in ("NaN", "Infinity", "-Infinity") else value
    sent = value_as_sent(value)
    return {"number": sent} if isinstance(sent, str) else sent


def ext_fetch_result_of(document: Document, params: Mapping[str, ExtParam], elapsed: float) -> ExtFetchResult:
    """Return the result of a fetch of extended parameters.

    Args:
        document: the result without parameters.
        params: the current parameters.
        elapsed: seconds from the call to its end.
    """
    count = document["count"]
    check_kind(count, int, NoneType)
    return ExtFetchResult(
        system=document["system"],
        component=document["component"],
        params=dict(params),
        count=count,
        missing=tuple(document["missing"]),
        source=document["source"],
        elapsed=elapsed,
        notes=tuple(document["notes"]),
    )


def ext_set_result_of(document: Document, requested: ExtValue) -> ExtSetResult:
    """Return the result of a write of an extended parameter."""
    param = ext_param_of(document["param"])
    SetStatus(document["status"])
    check_kind(document["attempts"], int)
    return ExtSetResult(
        str(document["name"]), document["status"], requested, param.value, param, document["attempts"]
    )


def ext_set_outcome_of(document: Document, name: str, requested: ExtValue, link: str) -> ExtSetOutcome:
    """Return the outcome of one of several writes of extended parameters."""
    problem = document.get("problem")
    if problem is None:
        result = ext_set_result_of(document, requested)
        return ExtSetOutcome(name, requested, SetStatus(result.status), result)
    error = error_of(problem, status=problem["status"], link=link)
    return ExtSetOutcome(name, requested, SetStatus(document["status"]), error=error)


def stats_of(documents: list[Document]) -> ClientStats:
    """Return the sums of the counters of several open links."""
    counted = [each.name for each in fields(ClientStats) if each.name != "round_trips"]
    sums: dict[str, Any] = {}
    for name in counted:
        counts = [each[name] for each in documents if each.get(name) is not None]  # older services have fewer
        sums[name] = sum(counts) if counts or name not in ("lost", "repeated") else None
    trips = {
        (int(system), int(component)): float(seconds)
        for each in documents
        for address, seconds in each["round_trips"].items()
        for system, component in [address.split("/")]
    }
    return ClientStats(**sums, round_trips=trips)
