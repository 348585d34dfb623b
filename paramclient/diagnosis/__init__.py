"""Diagnosis of a vehicle and its link: measurements, report and findings. It changes nothing on the vehicle.

- `measure`: `check_vehicle`, which takes the measurements.
- `report`: the report, as plain data.
- `findings`: slow or unusual results in a report, with their likely cause and advice.
"""

from paramclient.diagnosis.findings import Finding, Severity, findings_of
from paramclient.diagnosis.measure import check_vehicle
from paramclient.diagnosis.report import (
    FileService,
    HashService,
    HeardStation,
    LinkReport,
    ListService,
    ReadService,
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
    "HeardStation",
    "VehicleReport",
    "check_vehicle",
    "findings_of",
]
