"""What all documents have in common."""

from __future__ import annotations

from collections.abc import Callable
from itertools import islice
from typing import Annotated, Any, Final, TypeVar

from pydantic import BaseModel, ConfigDict, Field, WrapValidator, model_validator

from paramclient.model.notation import Scalar

__all__ = ["Body", "Document", "InParts", "Maybe", "Scalar", "without_strangers"]

T = TypeVar("T")

PART_SIZE: Final = 64
"""Members of a long object that are validated at once."""


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

    @model_validator(mode="before")
    @classmethod
    def _first_stranger(cls, content: object) -> object:
        return without_strangers(cls, content)


def without_strangers(model: type[BaseModel], content: object) -> object:
    """The members that a model knows, and the first one that it does not.

    pydantic makes an error of each unknown member: megabytes of them would be many times as many of errors.
    """
    known = model.model_fields
    if not isinstance(content, dict) or len(content) <= len(known):
        return content
    stranger = next(name for name in content if name not in known)
    kept = {name: content[name] for name in known if name in content}
    return {**kept, stranger: content[stranger]}


def _in_parts(content: object, validate: Callable[[object], Any]) -> Any:
    """Validate a long object part by part, up to the first part with an error in it."""
    if not isinstance(content, dict) or len(content) <= PART_SIZE:
        return validate(content)
    members = iter(content.items())
    found: dict[str, Any] = {}
    while part := dict(islice(members, PART_SIZE)):
        found.update(validate(part))
    return found


InParts: Final = WrapValidator(_in_parts)
"""Stands with an object of many members, and before a limit of their number. pydantic collects every error of
an object, and lets no other thread run while it validates one: of a part both are little."""
