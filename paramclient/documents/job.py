"""Documents of jobs of the service: fetches and set-ups that run, or have ended."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from paramclient.documents.component import ProgressDoc
from paramclient.documents.document import Document
from paramclient.documents.problem import Problem

if TYPE_CHECKING:
    from paramclient.cache import InterruptedSetup

__all__ = ["JobDoc", "JobsDoc", "progress_text"]


class JobDoc(Document):
    """One job. `result` is the document of its kind; it is null until the job is done, and in events.

    Times are in unix seconds. A set-up is `cut-off` if the service ended while it ran: `ended` is then the
    last time at which it was known to run.
    """

    id: str
    kind: Literal["fetch", "extended-fetch", "apply", "restore"]
    link: str
    system: int
    component: int
    state: Literal["running", "done", "failed", "cancelled", "cut-off"]
    requested_by: str
    began: float
    ended: float | None
    progress: ProgressDoc | dict[str, Any] | None
    result: dict[str, Any] | None
    problem: Problem | None

    @classmethod
    def of_cut_off(cls, note: InterruptedSetup) -> JobDoc:
        """Return the document of a set-up that was interrupted when an earlier run of the service ended."""
        detail = (
            f"The service ended while the set-up ran, {progress_text(note)}. The written values are in the "
            "history, and the state before is among the snapshots: apply again, or restore."
        )
        return cls(
            id=note.id,
            kind="restore" if note.kind == "restore" else "apply",
            link=note.link,
            system=note.system,
            component=note.component,
            state="cut-off",
            requested_by=note.requested_by,
            began=round(note.began, 3),
            ended=round(note.at, 3),
            progress={"phase": "cut-off", "done": note.done, "total": note.total},
            result=None,
            problem=Problem(type="urn:paramclient:cut-off", title="Cut off", status=409, detail=detail),
        )


class JobsDoc(Document):
    """The running jobs, and the last ones that have ended."""

    jobs: list[JobDoc]


def progress_text(note: InterruptedSetup) -> str:
    """Return the progress of an interrupted set-up in words."""
    return f"after {note.done} of {note.total} values" if note.total else "before anything was written"
