"""Jobs: fetches and set-ups in progress, with author, progress and result."""

from __future__ import annotations

import logging
import secrets
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final, Literal

import anyio
import anyio.abc

from paramclient.documents.document import Document
from paramclient.documents.job import JobDoc
from paramclient.errors import ParamClientError
from paramclient.service.problems import ServiceError, problem_of

if TYPE_CHECKING:
    from paramclient.service.event_feed import EventFeed
    from paramclient.service.followed_component import FollowedComponent

__all__ = ["FETCHES", "Job", "Jobs", "Kind", "Work"]

Kind = Literal["fetch", "extended-fetch", "apply", "restore"]
FETCHES: Final[tuple[Kind, ...]] = ("fetch", "extended-fetch")
"""Jobs that change nothing on a vehicle."""
State = Literal["running", "done", "failed", "cancelled"]

RUNNING_JOBS_MAX: Final = 256
"""Maximum number of running jobs: one for each component of a full link. Each is a task."""
HOLDER_JOBS_MAX: Final = 64
"""Maximum number of running jobs of one holder of a token or, without tokens, of one address. Jobs of the
service itself do not count."""
ENDED_JOBS_KEPT_MAX: Final = 64
"""Number of ended jobs that are kept for later requests."""

LISTED_ENTRIES_MAX: Final = 64
"""Maximum number of entries of a result's member in the list of jobs; `GET /jobs/{id}` has longer members."""

logger = logging.getLogger(__name__)


class Job:
    """One job.

    Attributes:
        id: random id.
        kind: fetch, extended-fetch, apply or restore.
        followed: its component.
        requested_by: author who started it.
        holder: holder of its quota; "" for the service.
        state: running, done, failed or cancelled.
        progress: progress as a document, set by the work.
        result: result as a document, or None.
        error: error of a failed job, or None.
        began: start time in unix seconds.
        ended: end time in unix seconds, or None.
    """

    def __init__(self, kind: Kind, followed: FollowedComponent, requested_by: str, holder: str) -> None:
        self.id = secrets.token_hex(8)
        self.kind = kind
        self.followed = followed
        self.requested_by = requested_by
        self.holder = holder
        self.state: State = "running"
        self.progress: Document | None = None
        self.result: Document | None = None
        self.error: Exception | None = None
        self.began = time.time()
        self.ended: float | None = None
        self._scope = anyio.CancelScope()
        self._over = anyio.Event()
        self._link = followed.link.name

    def document(self, *, with_result: bool = True) -> JobDoc:
        """Return its current state."""
        system, component = self.followed.address
        return JobDoc(
            id=self.id,
            kind=self.kind,
            link=self._link,
            system=system,
            component=component,
            state=self.state,
            requested_by=self.requested_by,
            began=round(self.began, 3),
            ended=None if self.ended is None else round(self.ended, 3),
            progress=None if self.progress is None else self.progress.as_json(),
            result=self.result.as_json() if with_result and self.result is not None else None,
            problem=None if self.error is None else problem_of(self.error),
        )

    def document_factory(self, *, in_list: bool = False) -> Callable[[], JobDoc]:
        """Return a function that creates the document of the current state in any thread: a result may have
        many rows.

        Args:
            in_list: whether members of the result with more than `LISTED_ENTRIES_MAX` entries are omitted.
        """
        document, result = self.document(with_result=False), self.result
        if result is None:
            return lambda: document
        long = {name for name, each in result if in_list and _is_long(each)}
        return lambda: document.model_copy(update={"result": result.model_dump(mode="json", exclude=long)})

    def cancel(self) -> None:
        """Cancel the job. A download shared with other jobs continues."""
        self._scope.cancel()

    async def wait(self) -> Document:
        """Wait for the end of the job and return its result. Cancellation does not cancel the job.

        Raises:
            Exception: the error of the job; ServiceError if it was cancelled.
        """
        await self._over.wait()
        if self.error is not None:
            raise self.error.with_traceback(None)
        assert self.result is not None, "a job without an error has a result"
        return self.result


Work = Callable[[Job], Awaitable[Document]]
"""The work of a job: returns the document of its result."""


class Jobs:
    """Running jobs, and the last ended ones.

    Args:
        feed: the event feed.
    """

    def __init__(self, feed: EventFeed) -> None:
        self._feed = feed
        self._jobs: dict[str, Job] = {}
        self._tasks: anyio.abc.TaskGroup | None = None

    def open(self, tasks: anyio.abc.TaskGroup) -> None:
        """Use this task group for jobs."""
        self._tasks = tasks

    @property
    def all(self) -> list[Job]:
        """Return all jobs, the oldest first."""
        return list(self._jobs.values())

    @property
    def document_factories(self) -> list[Callable[[], JobDoc]]:
        """Return functions that create the documents of all jobs for a list, the oldest first; see
        `Job.document_factory`."""
        return [job.document_factory(in_list=True) for job in self._jobs.values()]

    def document_factory(self, name: str) -> Callable[[], JobDoc]:
        """Return a function that creates the document of the job with this id.

        Raises:
            ServiceError: the job is unknown.
        """
        return self.find(name).document_factory()

    def start(
        self, kind: Kind, followed: FollowedComponent, work: Work, requested_by: str, holder: str = ""
    ) -> Job:
        """Start a job.

        Args:
            kind: fetch, extended-fetch, apply or restore.
            followed: its component.
            work: the work of the job.
            requested_by: author who starts it.
            holder: holder of its quota; "" for the service.

        Raises:
            ServiceError: too many jobs are running, of this holder or in total.
        """
        assert self._tasks is not None, "the hub is open"
        ended = [job.id for job in self._jobs.values() if job.state != "running"]
        if len(self._jobs) - len(ended) >= RUNNING_JOBS_MAX:
            raise ServiceError(
                429,
                "too-many",
                f"{RUNNING_JOBS_MAX} jobs are already running. Try again later.",
                most=RUNNING_JOBS_MAX,
            )
        own = sum(job.holder == holder for job in self._jobs.values() if job.state == "running")
        if holder and own >= HOLDER_JOBS_MAX:
            raise ServiceError(
                429,
                "too-many",
                f"{HOLDER_JOBS_MAX} of your jobs are already running. Try again later.",
                most=HOLDER_JOBS_MAX,
            )
        for name in ended[: max(0, len(ended) - ENDED_JOBS_KEPT_MAX + 1)]:
            del self._jobs[name]
        job = Job(kind, followed, requested_by, holder)
        self._jobs[job.id] = job
        self.publish(job)
        self._tasks.start_soon(self._run, job, work, name=f"paramclient job {job.id}")
        return job

    def find(self, name: str) -> Job:
        """Return the job with this id.

        Raises:
            ServiceError: the job is unknown.
        """
        job = self._jobs.get(name)
        if job is None:
            raise ServiceError(404, "unknown-job", "The job is unknown, or ended too long ago.")
        return job

    def publish(self, job: Job) -> None:
        """Publish the current state of a job."""
        job.followed.publish("job", {"job": job.document(with_result=False).as_json()})

    async def _run(self, job: Job, work: Work) -> None:
        try:
            with job._scope:
                job.result = await work(job)
                job.state = "done"
        except Exception as error:
            job.error = error
            job.state = "failed"
            if not isinstance(error, ParamClientError | ServiceError):
                logger.error("the %s job %s failed", job.kind, job.id, exc_info=error)
        finally:
            if job.state == "running":
                job.state = "cancelled"
                job.error = ServiceError(409, "cancelled", "The job was cancelled before its end.")
            job.ended = time.time()
            job.followed.publish_changes()
            self.publish(job)
            job._over.set()


def _is_long(content: object) -> bool:
    return (
        not isinstance(content, str)
        and isinstance(content, Sequence | Mapping)
        and len(content) > LISTED_ENTRIES_MAX
    )
