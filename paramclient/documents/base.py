"""What all documents have in common."""

from __future__ import annotations

from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field

from paramclient.notation import Scalar

__all__ = ["Body", "Document", "Maybe", "Scalar"]

T = TypeVar("T")


def _is_none(value: object) -> bool:
    return value is None


Maybe = Annotated[T | None, Field(exclude_if=_is_none)]
"""A member that is left out where there is nothing to say. It has None for a default; a member that stands as
null instead has no default."""


class Document(BaseModel):
    """What is told: it does not change, and members stand in the order in which they are declared."""

    model_config = ConfigDict(
        frozen=True,
        allow_inf_nan=False,
        defer_build=True,  # each command needs a few of them
        serialize_by_alias=True,
        validate_by_name=True,
        validate_by_alias=True,
    )

    def as_json(self) -> dict[str, Any]:
        """The same as `json.dumps` takes it."""
        return self.model_dump(mode="json")


class Body(BaseModel):
    """What is asked: a member that nobody knows is refused, so that a misspelt one is not passed over."""

    model_config = ConfigDict(frozen=True, extra="forbid")
