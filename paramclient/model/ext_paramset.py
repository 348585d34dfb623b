"""Extended parameter sets without a vehicle: the contents of a file, a snapshot or a cached table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from paramclient.model.ext_params import ExtParam
from paramclient.model.identity import Identity

__all__ = ["ExtParamSet"]


@dataclass(frozen=True, slots=True)
class ExtParamSet:
    """The extended parameters of one component, in the order of the source.

    Attributes:
        params: the parameters by name.
        system, component: MAVLink ids, or None if the source does not contain them.
        at: when the values were observed, in unix seconds, or None if unknown.
        source: the source, for messages: a file's name, `link udpin:…`, `snapshot 3 of uid:…`.
        identity: the vehicle's identity, or None if the source does not contain it.
    """

    params: Mapping[str, ExtParam]
    system: int | None = None
    component: int | None = None
    at: float | None = None
    source: str = ""
    identity: Identity | None = None
