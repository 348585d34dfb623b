"""What is under way for somebody: a fetch, a set-up."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from paramclient.documents.component import ProgressDoc
from paramclient.documents.document import Document
from paramclient.documents.problem import Problem

if TYPE_CHECKING:
    from paramclient.cache import CutOff

__all__ = ["JobDoc", "JobsDoc", "far_text"]


class JobDoc(Document):
    """One piece of work. `result` is the document of its kind, null until it is done, and in events.

    Times are in unix seconds. A set-up is `cut-off` where the service ended while it ran: `ended` is then
    when it was last known to run.
    """

    id: str
    kind: Literal["fetch", "apply", "restore"]
    link: str
    system: int
    component: int
    state: Literal["running", "done", "failed", "cancelled", "cut-off"]
    asked_by: str
    began: float
    ended: float | None
    progress: ProgressDoc | dict[str, Any] | None
    result: dict[str, Any] | None
    problem: Problem | None

    @classmethod
    def of_cut_off(cls, note: CutOff) -> JobDoc:
        """A set-up that an earlier run of the service has not brought to its end."""
        detail = (
            f"The service ended while it ran, {far_text(note)}. What was written is in the history, and the "
            "state before it among the snapshots: apply again, or restore."
        )
        return cls(
            id=note.id,
            kind="restore" if note.kind == "restore" else "apply",
            link=note.link,
            system=note.system,
            component=note.component,
            state="cut-off",
            asked_by=note.asked_by,
            began=round(note.began, 3),
            ended=round(note.at, 3),
            progress={"phase": "cut-off", "done": note.done, "total": note.total},
            result=None,
            problem=Problem(type="urn:paramclient:cut-off", title="Cut off", status=409, detail=detail),
        )


class JobsDoc(Document):
    """Those that are under way, and the last ones that were."""

    jobs: list[JobDoc]


def far_text(note: CutOff) -> str:
    """How far a set-up was, in words."""
    return f"after {note.done} of {note.total} values" if note.total else "before anything was written"
