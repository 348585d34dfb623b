"""A change of one extended parameter."""

from __future__ import annotations

from dataclasses import dataclass

from paramclient.model.ext_params import ExtParam

__all__ = ["ExtChange"]


@dataclass(frozen=True, slots=True)
class ExtChange:
    """One extended parameter that appeared, changed its value or was removed.

    Attributes:
        name: param_id.
        old: the parameter before, or None for a new one.
        new: the parameter now, or None when the component no longer has it.
        by: the author, as in `Change`.
        is_added: whether the component has a parameter that its last complete list lacked.
    """

    name: str
    old: ExtParam | None
    new: ExtParam | None
    by: str = "vehicle"
    is_added: bool = False
