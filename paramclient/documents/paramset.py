"""Documents of parameter sets and parameter files: origin, parameters, file formats."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import zip_longest
from typing import TYPE_CHECKING, Final

from paramclient.documents.component import IdentityDoc
from paramclient.documents.document import Document, Maybe
from paramclient.documents.param import WrittenParamDoc
from paramclient.files.formats import ENDINGS, FileFormat
from paramclient.model.identity import autopilot_name
from paramclient.model.notation import time_or_none

if TYPE_CHECKING:
    from paramclient.files import ParamFile
    from paramclient.model.defaults import DefaultSource
    from paramclient.model.paramset import ParamSet, RestorePoint

__all__ = [
    "FileDoc",
    "FormatDoc",
    "FormatsDoc",
    "OriginDoc",
    "RestorePointDoc",
    "SetDoc",
    "StateDoc",
    "UploadedDoc",
]


class OriginDoc(Document):
    """The origin of a set: source, vehicle, and the time `at` which the vehicle had these values."""

    source: str
    system: int | None
    component: int | None
    autopilot: str | None
    uid: str | None
    at: str | None
    count: int

    @classmethod
    def of(cls, params: ParamSet) -> OriginDoc:
        """Return the document of the origin of a `ParamSet`."""
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
    """A set with its parameters by name."""

    params: dict[str, WrittenParamDoc]

    @classmethod
    def of(cls, params: ParamSet, sources: Mapping[str, DefaultSource] | None = None) -> SetDoc:
        """Return the document of a `ParamSet`.

        Args:
            params: the set.
            sources: the origins of its defaults by name, if they are to be included.
        """
        origins = sources or {}
        written = {name: WrittenParamDoc.of(param, origins.get(name)) for name, param in params.items()}
        return cls(**OriginDoc.of(params).model_dump(), params=written)


class RestorePointDoc(Document):
    """The snapshot before the last apply, and what a restore of it undoes; see `RestorePoint`.

    `at`, and the time of the latest change of each parameter in `changes`, are in unix seconds.
    """

    snapshot: int
    at: float
    changes: dict[str, float]


class StateDoc(Document):
    """An earlier state of a component, with its identity at that time; `at` is in unix seconds.

    `restore_point` is present if the request names no state.
    """

    system: int | None
    component: int | None
    at: float | None
    source: str
    identity: IdentityDoc | None
    params: dict[str, WrittenParamDoc]
    restore_point: Maybe[RestorePointDoc] = None

    @classmethod
    def of(cls, state: ParamSet, point: RestorePoint | None = None) -> StateDoc:
        """Return the document of a `ParamSet`, and of the restore point that has it."""
        return cls(
            system=state.system,
            component=state.component,
            at=state.at,
            source=state.source,
            identity=None if state.identity is None else IdentityDoc.of(state.identity),
            params={name: WrittenParamDoc.of(param) for name, param in state.items()},
            restore_point=None
            if point is None
            else RestorePointDoc(snapshot=point.snapshot, at=point.at, changes=dict(point.changes)),
        )


class FileDoc(Document):
    """The content of a parameter file: a set for each component. `format` is the file format."""

    file: str
    format: str
    components: list[SetDoc]

    @classmethod
    def of(
        cls,
        file: ParamFile,
        sets: Iterable[ParamSet] | None = None,
        sources: Iterable[Mapping[str, DefaultSource]] = (),
    ) -> FileDoc:
        """Return the document of a file.

        Args:
            file: the file.
            sets: the sets of it to include; None for all.
            sources: of each set, the origins of its defaults by name, if they are to be included.
        """
        shown = zip_longest(file.sets if sets is None else sets, sources)
        return cls(file=file.source, format=file.file_format, components=[SetDoc.of(*each) for each in shown])


class UploadedDoc(Document):
    """The content of an uploaded parameter file.

    `format` is the file format, `notes` are remarks for the user, `components` the origins of the sets in the
    file, `params` the parameters of the chosen set.
    """

    file: str
    format: str
    notes: list[str]
    components: list[OriginDoc]
    params: dict[str, WrittenParamDoc]

    @classmethod
    def of(cls, file: ParamFile, chosen: ParamSet) -> UploadedDoc:
        """Return the document of a file and the set chosen from it."""
        return cls(
            file=file.source,
            format=file.file_format,
            notes=list(file.notes),
            components=[OriginDoc.of(each) for each in file.sets],
            params={name: WrittenParamDoc.of(param) for name, param in chosen.items()},
        )


class FormatDoc(Document):
    """A format of parameter files: its file name endings, and whether it can be written."""

    name: str
    title: str
    endings: list[str]
    writes: bool

    @classmethod
    def of(cls, file_format: FileFormat) -> FormatDoc:
        """Return the document of a file format."""
        return cls(
            name=file_format.value,
            title=_TITLES[file_format],
            endings=[ending for ending, each in ENDINGS.items() if each is file_format],
            writes=True,
        )


class FormatsDoc(Document):
    """The formats of parameter files."""

    formats: list[FormatDoc]


_TITLES: Final = {
    FileFormat.QGC: "QGroundControl",
    FileFormat.PARM: "MAVProxy, ArduPilot",
    FileFormat.MISSION_PLANNER: "Mission Planner",
    FileFormat.PCK: "Packed file of a vehicle",
    FileFormat.JSON: "paramclient",
}
"""The title of each file format for users: the programs that use it."""
