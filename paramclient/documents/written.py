"""Parameters that no vehicle stands behind: whose they are, and what a file of them says."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from paramclient.documents.base import Document, Maybe
from paramclient.documents.param import WrittenParamDoc
from paramclient.identity import autopilot_name
from paramclient.notation import time_or_none

if TYPE_CHECKING:
    from paramclient.files import ParamFile
    from paramclient.paramset import ParamSet

__all__ = ["FileDoc", "OriginDoc", "SetDoc"]


class OriginDoc(Document):
    """Whose parameters a set has. `at` is when it was so."""

    source: str
    system: int | None
    component: int | None
    autopilot: str | None
    uid: str | None
    at: str | None
    count: int

    @classmethod
    def of(cls, params: ParamSet) -> OriginDoc:
        """What a set says of itself."""
        identity = params.identity
        return cls(
            source=params.source,
            system=params.system,
            component=params.component,
            autopilot=None if identity is None else autopilot_name(identity.autopilot),
            uid=None if identity is None else identity.uid,
            at=time_or_none(params.at),
            count=len(params),
        )


class SetDoc(OriginDoc):
    """A set with its parameters, by name."""

    params: dict[str, WrittenParamDoc]

    @classmethod
    def of(cls, params: ParamSet) -> SetDoc:
        """All of it."""
        written = {name: WrittenParamDoc.of(param) for name, param in params.items()}
        return cls(**OriginDoc.of(params).model_dump(), params=written)


class FileDoc(Document):
    """What a parameter file holds: a set for each component. `notes` are what its reader should know."""

    file: str
    form: str
    components: list[SetDoc]
    notes: Maybe[list[str]] = None

    @classmethod
    def of(cls, file: ParamFile, sets: Iterable[ParamSet] | None = None) -> FileDoc:
        """A file as it was read; only some sets of it where they are given."""
        shown = file.sets if sets is None else sets
        return cls(file=file.source, form=file.form, components=[SetDoc.of(each) for each in shown])
