"""Diagnosis of a link: what a vehicle is, what it serves and how quickly. Nothing is changed."""

from paramclient.diagnosis.findings import Finding, Severity, findings_of
from paramclient.diagnosis.measure import check_vehicle
from paramclient.diagnosis.report import (
    FileService,
    HashService,
    LinkReport,
    ListService,
    ReadService,
    Station,
    VehicleReport,
)

__all__ = [
    "FileService",
    "Finding",
    "HashService",
    "LinkReport",
    "ListService",
    "ReadService",
    "Severity",
    "Station",
    "VehicleReport",
    "check_vehicle",
    "findings_of",
]
