"""Documents of jobs of the service: fetches and set-ups that run, or have ended."""

from __future__ import annotations

from typing import Any, Literal

from paramclient.documents.component import ProgressDoc
from paramclient.documents.document import Document
from paramclient.documents.problem import Problem

__all__ = ["JobDoc", "JobsDoc"]


class JobDoc(Document):
    """One job. `result` is the document of its kind; it is null until the job is done, and in events.

    Times are in unix seconds.
    """

    id: str
    kind: Literal["fetch", "extended-fetch", "apply", "restore"]
    link: str
    system: int
    component: int
    state: Literal["running", "done", "failed", "cancelled"]
    requested_by: str
    began: float
    ended: float | None
    progress: ProgressDoc | dict[str, Any] | None
    result: dict[str, Any] | None
    problem: Problem | None


class JobsDoc(Document):
    """The running jobs, and the last ones that have ended."""

    jobs: list[JobDoc]
