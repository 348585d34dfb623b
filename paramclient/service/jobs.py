"""What is under way for somebody: who asked for it, how far it is, how it ended."""

from __future__ import annotations

import logging
import secrets
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Final, Literal

import anyio
import anyio.abc

from paramclient.documents.document import Document
from paramclient.documents.job import JobDoc
from paramclient.errors import ParamClientError
from paramclient.service.problems import ServiceError, problem_of

if TYPE_CHECKING:
    from paramclient.cache import CutOff
    from paramclient.service.event_feed import Feed
    from paramclient.service.followed_component import Followed

__all__ = ["Job", "Jobs", "Kind", "Work"]

Kind = Literal["fetch", "apply", "restore"]
State = Literal["running", "done", "failed", "cancelled"]

MOST_RUNNING: Final = 256
"""Jobs that are under way at once: one for each component that a link can carry. Each is a task."""
MOST_OF_ONE: Final = 64
"""Those of one holder of a token or, without tokens, of one address; the service's own are not counted."""
MOST_ENDED: Final = 64
"""Jobs that are kept when they have ended, for those who ask late."""

LISTED_MAX: Final = 64
"""Entries of a member of a result that stands in the list of jobs; `GET /jobs/{id}` has the longer ones."""

logger = logging.getLogger(__name__)


class Job:
    """One piece of work.

    Attributes:
        id: its name.
        kind: what it is.
        followed: whom it is about.
        asked_by: who wanted it.
        holder: of whose quota it is; "" for that of the service.
        state: running, done, failed or cancelled.
        progress: how far it is, as a document; whoever does the work sets it.
        result: what it ended with, as a document.
        error: what it failed with.
    """

    def __init__(self, kind: Kind, followed: Followed, asked_by: str, holder: str) -> None:
        self.id = secrets.token_hex(8)
        self.kind = kind
        self.followed = followed
        self.asked_by = asked_by
        self.holder = holder
        self.state: State = "running"
        self.progress: Document | None = None
        self.result: Document | None = None
        self.error: Exception | None = None
        self.began = time.time()
        self.ended: float | None = None
        self._scope = anyio.CancelScope()
        self._over = anyio.Event()
        self._link = followed.line.name

    def document(self, *, with_result: bool = True) -> JobDoc:
        """How it stands now."""
        system, component = self.followed.address
        return JobDoc(
            id=self.id,
            kind=self.kind,
            link=self._link,
            system=system,
            component=component,
            state=self.state,
            asked_by=self.asked_by,
            began=round(self.began, 3),
            ended=None if self.ended is None else round(self.ended, 3),
            progress=None if self.progress is None else self.progress.as_json(),
            result=self.result.as_json() if with_result and self.result is not None else None,
            problem=None if self.error is None else problem_of(self.error),
        )

    def later_document(self, *, in_list: bool = False) -> Callable[[], JobDoc]:
        """What makes the same document, as it stands now, in any thread: a result may have many rows.

        Args:
            in_list: leaves out the members of the result that have more than `LISTED_MAX` entries.
        """
        document, result = self.document(with_result=False), self.result
        if result is None:
            return lambda: document
        long = {name for name, each in result if in_list and _is_long(each)}
        return lambda: document.model_copy(update={"result": result.model_dump(mode="json", exclude=long)})

    def cancel(self) -> None:
        """End it; what it shares with others goes on for them."""
        self._scope.cancel()

    async def wait(self) -> Document:
        """What it ends with. Cancelled, it goes on.

        Raises:
            Exception: what it failed with; a ServiceError where somebody has cancelled it.
        """
        await self._over.wait()
        if self.error is not None:
            raise self.error.with_traceback(None)
        assert self.result is not None, "it is over, and has not failed"
        return self.result


Work = Callable[[Job], Awaitable[Document]]
"""Does the work of a job, and gives the document of what became of it."""


class Jobs:
    """Those that are under way, and the last ones that were.

    Args:
        feed: where beginnings and ends are told.

    Attributes:
        cut_off: set-ups that an earlier run of the service has not brought to their end.
    """

    def __init__(self, feed: Feed) -> None:
        self.cut_off: Sequence[CutOff] = ()
        self._feed = feed
        self._jobs: dict[str, Job] = {}
        self._tasks: anyio.abc.TaskGroup | None = None

    def open(self, tasks: anyio.abc.TaskGroup) -> None:
        """From now on jobs run in these tasks."""
        self._tasks = tasks

    @property
    def all(self) -> list[Job]:
        """All of them, the oldest first."""
        return list(self._jobs.values())

    @property
    def later_documents(self) -> list[Callable[[], JobDoc]]:
        """What makes the documents of all of them for a list, the oldest first; see `Job.later_document`."""
        cut_off = [partial(JobDoc.of_cut_off, note) for note in self.cut_off]
        return [*cut_off, *(job.later_document(in_list=True) for job in self._jobs.values())]

    def later_document(self, name: str) -> Callable[[], JobDoc]:
        """What makes the document of the one of this name.

        Raises:
            ServiceError: there is none.
        """
        for note in self.cut_off:
            if note.id == name:
                return partial(JobDoc.of_cut_off, note)
        return self.find(name).later_document()

    def begin(self, kind: Kind, followed: Followed, work: Work, asked_by: str, holder: str = "") -> Job:
        """Begin one.

        Args:
            kind: what it is.
            followed: whom it is about.
            work: does it.
            asked_by: who wanted it.
            holder: of whose quota it is; "" for that of the service.

        Raises:
            ServiceError: too many are under way, of this holder or of all.
        """
        assert self._tasks is not None, "the hub is open"
        ended = [job.id for job in self._jobs.values() if job.state != "running"]
        if len(self._jobs) - len(ended) >= MOST_RUNNING:
            raise ServiceError(
                429, "too-many", f"{MOST_RUNNING} jobs are under way already.", most=MOST_RUNNING
            )
        own = sum(job.holder == holder for job in self._jobs.values() if job.state == "running")
        if holder and own >= MOST_OF_ONE:
            raise ServiceError(
                429, "too-many", f"{MOST_OF_ONE} jobs of yours are under way already.", most=MOST_OF_ONE
            )
        for name in ended[: max(0, len(ended) - MOST_ENDED + 1)]:
            del self._jobs[name]
        job = Job(kind, followed, asked_by, holder)
        self._jobs[job.id] = job
        self.tell(job)
        self._tasks.start_soon(self._run, job, work, name=f"paramclient job {job.id}")
        return job

    def find(self, name: str) -> Job:
        """The one of this name.

        Raises:
            ServiceError: there is none.
        """
        job = self._jobs.get(name)
        if job is None:
            raise ServiceError(404, "unknown-job", "There is no such job, or it ended long ago.")
        return job

    def tell(self, job: Job) -> None:
        """Publish how a job stands now."""
        job.followed.tell("job", {"job": job.document(with_result=False).as_json()})

    async def _run(self, job: Job, work: Work) -> None:
        try:
            with job._scope:
                job.result = await work(job)
                job.state = "done"
        except Exception as error:
            job.error = error
            job.state = "failed"
            if not isinstance(error, ParamClientError | ServiceError):
                logger.error("job %s, a %s, failed", job.id, job.kind, exc_info=error)
        finally:
            if job.state == "running":
                job.state = "cancelled"
                job.error = ServiceError(409, "cancelled", "It was cancelled before it had come to its end.")
            job.ended = time.time()
            job.followed.look()
            self.tell(job)
            job._over.set()


def _is_long(content: object) -> bool:
    return (
        not isinstance(content, str) and isinstance(content, Sequence | Mapping) and len(content) > LISTED_MAX
    )
