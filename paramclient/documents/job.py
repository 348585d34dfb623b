"""What is under way for somebody: a fetch, a set-up."""

from __future__ import annotations

from typing import Any, Literal

from paramclient.documents.base import Document
from paramclient.documents.component import ProgressDoc
from paramclient.documents.problem import Problem

__all__ = ["JobDoc", "JobsDoc"]


class JobDoc(Document):
    """One piece of work. `result` is the document of its kind, null until it is done, and in events.

    Times are in unix seconds.
    """

    id: str
    kind: Literal["fetch", "apply", "restore"]
    link: str
    system: int
    component: int
    state: Literal["running", "done", "failed", "cancelled"]
    asked_by: str
    began: float
    ended: float | None
    progress: ProgressDoc | dict[str, Any] | None
    result: dict[str, Any] | None
    problem: Problem | None


class JobsDoc(Document):
    """Those that are under way, and the last ones that were."""

    jobs: list[JobDoc]
