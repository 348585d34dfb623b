"""Base classes of all documents and request bodies, and the validation of long objects."""

from __future__ import annotations

from collections.abc import Callable
from itertools import islice
from typing import Annotated, Any, Final, TypeVar

from pydantic import BaseModel, ConfigDict, Field, WrapValidator, model_validator

from paramclient.model.notation import Scalar

__all__ = ["Body", "Document", "InParts", "Maybe", "Scalar", "build_documents", "limit_unknown_members"]

T = TypeVar("T")

PART_SIZE: Final = 64
"""Members of a long object that are validated in one call; see `InParts`."""


def _is_none(value: object) -> bool:
    return value is None


Maybe = Annotated[T | None, Field(exclude_if=_is_none)]
"""A member that is left out if it is None, which is its default. A member that is null instead has no
default."""


class Document(BaseModel):
    """A document that is printed or sent: immutable, with members in the order of their declaration."""

    model_config = ConfigDict(
        frozen=True,
        allow_inf_nan=False,
        defer_build=True,  # each subcommand needs only a few documents
        serialize_by_alias=True,
        validate_by_name=True,
        validate_by_alias=True,
    )

    def as_json(self) -> dict[str, Any]:
        """Return the document as objects that `json.dumps` accepts."""
        return self.model_dump(mode="json")


def build_documents() -> None:
    """Build the validators and serializers of all documents, in place of each at its first use.

    pydantic takes up to 5 ms for one and lets no other thread run meanwhile.
    """
    waiting: list[type[Document]] = [Document]
    while waiting:
        model = waiting.pop()
        model.model_rebuild()
        waiting += model.__subclasses__()


class Body(BaseModel):
    """A request body. An unknown member is refused, so that a misspelt one is not ignored."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _limit_unknown_members(cls, content: object) -> object:
        return limit_unknown_members(cls, content)


def limit_unknown_members(model: type[BaseModel], content: object) -> object:
    """Return `content` with the members that a model knows, and only the first unknown one.

    pydantic creates an error for each unknown member: megabytes of members would become many times as many
    megabytes of errors.
    """
    known = model.model_fields
    if not isinstance(content, dict) or len(content) <= len(known):
        return content
    unknown = next(name for name in content if name not in known)
    kept = {name: content[name] for name in known if name in content}
    return {**kept, unknown: content[unknown]}


def _validate_in_parts(content: object, validate: Callable[[object], Any]) -> Any:
    """Validate a long object in parts of `PART_SIZE` members, up to the first part with an error."""
    if not isinstance(content, dict) or len(content) <= PART_SIZE:
        return validate(content)
    members = iter(content.items())
    found: dict[str, Any] = {}
    while part := dict(islice(members, PART_SIZE)):
        found.update(validate(part))
    return found


InParts: Final = WrapValidator(_validate_in_parts)
"""Annotates an object with many members; it comes before a limit of their number. pydantic collects all
errors of an object, and lets no other thread run while it validates one: in parts, both stay small."""
