"""What is told as JSON: the command prints these documents, the service sends them.

Each is built by `of(…)` from what the library gives. This room loads pydantic: import it where JSON is made.
"""

from __future__ import annotations

from paramclient.documents.base import Body, Document, Maybe, Scalar
from paramclient.documents.cached import (
    CachedListDoc,
    CachedSummaryDoc,
    CachedTableDoc,
    CachedTablesDoc,
    PlaceDoc,
    RemovedDoc,
    VehicleDoc,
    VehiclesDoc,
)
from paramclient.documents.diff import ComparedDoc, DiffDoc, DifferenceDoc
from paramclient.documents.fleet import FleetDiffDoc, FleetValueDoc, HolderDoc, NameSpreadDoc
from paramclient.documents.param import GotDoc, InfoDoc, ParamDoc, WrittenParamDoc
from paramclient.documents.past import (
    ExactDoc,
    HistoryDoc,
    HistoryEntryDoc,
    SnapshotDoc,
    SnapshotsDoc,
    WholeSnapshotDoc,
)
from paramclient.documents.setup import (
    AddressDoc,
    AppliedRowDoc,
    ApplyProgressDoc,
    ApplyResultDoc,
    FailedVehicleDoc,
    FleetSetupDoc,
    InterruptedDoc,
    PlanDoc,
    PlanRowDoc,
    SetUpDoc,
    StageDoc,
    StepDoc,
    VerifiedDoc,
    VerifiedRowDoc,
)
from paramclient.documents.written import FileDoc, FormDoc, FormsDoc, OriginDoc, SetDoc, UploadedDoc

__all__ = [
    "AddressDoc",
    "AppliedRowDoc",
    "ApplyProgressDoc",
    "ApplyResultDoc",
    "Body",
    "CachedListDoc",
    "CachedSummaryDoc",
    "CachedTableDoc",
    "CachedTablesDoc",
    "ComparedDoc",
    "DiffDoc",
    "DifferenceDoc",
    "Document",
    "ExactDoc",
    "FailedVehicleDoc",
    "FileDoc",
    "FleetDiffDoc",
    "FleetSetupDoc",
    "FleetValueDoc",
    "FormDoc",
    "FormsDoc",
    "GotDoc",
    "HistoryDoc",
    "HistoryEntryDoc",
    "HolderDoc",
    "InfoDoc",
    "InterruptedDoc",
    "Maybe",
    "NameSpreadDoc",
    "OriginDoc",
    "ParamDoc",
    "PlaceDoc",
    "PlanDoc",
    "PlanRowDoc",
    "RemovedDoc",
    "Scalar",
    "SetDoc",
    "SetUpDoc",
    "SnapshotDoc",
    "SnapshotsDoc",
    "StageDoc",
    "StepDoc",
    "UploadedDoc",
    "VehicleDoc",
    "VehiclesDoc",
    "VerifiedDoc",
    "VerifiedRowDoc",
    "WholeSnapshotDoc",
    "WrittenParamDoc",
]
