"""Parameters that no vehicle stands behind: whose they are, and what a file of them says."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Final

from paramclient.documents.document import Document
from paramclient.documents.param import WrittenParamDoc
from paramclient.files.param_file import ENDINGS, FileForm
from paramclient.model.identity import autopilot_name
from paramclient.model.notation import time_or_none

if TYPE_CHECKING:
    from paramclient.files import ParamFile
    from paramclient.model.paramset import ParamSet

__all__ = ["FileDoc", "FormDoc", "FormsDoc", "OriginDoc", "SetDoc", "UploadedDoc"]


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
    """What a parameter file holds: a set for each component."""

    file: str
    form: str
    components: list[SetDoc]

    @classmethod
    def of(cls, file: ParamFile, sets: Iterable[ParamSet] | None = None) -> FileDoc:
        """A file as it was read; only some sets of it where they are given."""
        shown = file.sets if sets is None else sets
        return cls(file=file.source, form=file.form, components=[SetDoc.of(each) for each in shown])


class UploadedDoc(Document):
    """What a parameter file says to those who have sent it.

    `notes` are what its reader should know, `components` whose parameters it holds, `params` those that were
    chosen.
    """

    file: str
    form: str
    notes: list[str]
    components: list[OriginDoc]
    params: dict[str, WrittenParamDoc]

    @classmethod
    def of(cls, file: ParamFile, chosen: ParamSet) -> UploadedDoc:
        """A file as it was read."""
        return cls(
            file=file.source,
            form=file.form,
            notes=list(file.notes),
            components=[OriginDoc.of(each) for each in file.sets],
            params={name: WrittenParamDoc.of(param) for name, param in chosen.items()},
        )


class FormDoc(Document):
    """A form of parameter files: the endings that stand for it, and whether it is written too."""

    name: str
    title: str
    endings: list[str]
    writes: bool

    @classmethod
    def of(cls, form: FileForm) -> FormDoc:
        """One of those that there are."""
        return cls(
            name=form.value,
            title=_TITLES[form],
            endings=[ending for ending, each in ENDINGS.items() if each is form],
            writes=form is not FileForm.PX4_SCRIPT,
        )


class FormsDoc(Document):
    """The forms of parameter files."""

    forms: list[FormDoc]


_TITLES: Final = {
    FileForm.QGC: "QGroundControl",
    FileForm.PARM: "MAVProxy, ArduPilot",
    FileForm.MISSION_PLANNER: "Mission Planner",
    FileForm.PCK: "Packed file of a vehicle",
    FileForm.PX4_SCRIPT: "Start script of PX4",
    FileForm.JSON: "paramclient, JSON",
    FileForm.YAML: "paramclient, YAML",
}
