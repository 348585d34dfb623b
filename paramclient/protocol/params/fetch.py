"""One fetch of a component's table: from the cache if the hash matches, otherwise as a file or by list."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Final, NamedTuple

from paramclient.errors import CacheError, LinkError, NoReply, UnknownParameter
from paramclient.protocol.params.fetch_notes import (
    CACHED_UNVERIFIED,
    FILE_IN_USE,
    LEFT_OUT,
    NO_FILE,
    NOT_CONFIRMED,
    NOT_REFRESHED,
    NOT_REQUESTED,
    NOT_RESUMED,
    UNPROVEN,
    UNSETTLED,
)
from paramclient.protocol.params.fetch_result import (
    Announcement,
    FetchContext,
    FetchResult,
    FetchSource,
    Policy,
    Progress,
)
from paramclient.protocol.params.file_download import FileDownload
from paramclient.protocol.params.hash_check import HashCheck
from paramclient.protocol.params.list_download import ListDownload, present_of
from paramclient.protocol.params.reads import Read
from paramclient.protocol.requests.operation import Operation
from paramclient.protocol.requests.retry import FETCH_RESTARTS_MAX, OpenRetries
from paramclient.protocol.wire import HASH_CHECK, ParamRequestRead, ParamValue

__all__ = ["Check", "Fetch"]

REPEATED_TIME_MAX: Final = 1.5
"""Seconds of a download that may be repeated when the component seems to have restarted: ArduPilot's clock
shows a restart 1.4 s later (measured)."""


class Check(NamedTuple):
    """A fetch that only checks whether the table of a vehicle without a hash has changed.

    While another station has a file open, such a fetch ends with the server's refusal.

    Attributes:
        may_list: whether the list is downloaded if the file is not available for another reason.
    """

    may_list: bool


class Fetch(Operation[FetchResult]):
    """One fetch: by the hash if the cached table has one; otherwise, or on a mismatch, by file or list.

    The file is preferred where the component serves it: it is exact, has the firmware's defaults, and is
    faster. When it fails, the list follows, and `notes` says why.

    The list is requested in parallel to the file when the opening of the file stays unanswered, and when
    another station has a file open. As soon as the file is opened after all, the list's gaps are left to it.
    The first complete one ends the fetch.

    For a vehicle with a hash, `HashCheck` decides whether the downloaded table is confirmed.

    An unfinished download is resumed if the count is still the same. With a hash the result must be proven in
    the end, otherwise everything is downloaded again; without a hash the cached values stay *cached*.

    Attributes:
        holders: callers that wait for it; at 0 the fetch is cancelled.
        download: the list download, once it is needed.
        file: the file download, in progress or finished.
        file_failed: whether the component is known to have no such file; None before, and where packet loss
            may be the cause.
        check: the options of a fetch that only the watch has requested; None where a caller waits for the
            table.
        first_value_at: when a list download received its first value; infinity before.
        restarted_at: when the fetch restarted because the component seemed to have restarted; minus infinity
            where it did not.
    """

    def __init__(
        self,
        fetch_context: FetchContext,
        now: float,
        *,
        announced: Announcement | None,
        refresh: bool,
        listed: bool,
        by_list: bool = False,
        policy: Policy,
        may_use_file: Callable[[], bool],
        check: Check | None = None,
    ) -> None:
        super().__init__(now)
        self._fetch_context = fetch_context
        self._context = fetch_context.context
        self._target = fetch_context.context.target
        self._open_retries = OpenRetries(fetch_context.context.retry)
        self._reads = fetch_context.reads
        table = self._table = fetch_context.table
        self._may_use_file = may_use_file
        self._present: Mapping[int, str] | None = None  # the values with which a list would resume
        self._list_error: Exception | None = None  # why the list in parallel to the file failed
        self._was_in_use = False  # the server's session was in use when the list was requested
        self._is_cancelled = False
        self._has_begun = self._had_no_file = self._file_was_silent = False
        self._hash_read: Read | None = None
        self._proof = HashCheck(table)
        self._was_requested_meanwhile = False
        self._is_hash_unknown = False  # the vehicle answers other reads, but not that of the hash
        self.first_value_at = math.inf
        self._held_before = 0.0  # seconds waited for the turn before the download was restarted
        self._listed = listed
        self._by_list = by_list
        self.check = check
        self._fetch_policy = policy
        self._restarts = 0
        self._download_begun_at = now
        self.restarted_at = -math.inf
        self.holders = 0
        self.download: ListDownload | None = None
        self.file: FileDownload | None = None
        self.file_failed: bool | None = None
        self._notes: tuple[str, ...] = ()
        self._left_out_before = table.left_out
        self._choose_source(announced, now, is_download=refresh or listed)

    def _choose_source(self, announced: Announcement | None, now: float, *, is_download: bool) -> None:
        """Begin in the cheapest reliable way: with the cached table if the vehicle confirms it.

        In this order:

        - A download, if the caller requests one (`_begin_download`, which chooses between file and list). If
          the policy forbids downloads, `_begin_download` ends with the cached table.
        - The rest of an interrupted download, or all of it, if the table has no hash or is incomplete
          (`_begin_or_resume`).
        - The cached table, if its hash equals the vehicle's (`_compare`). The hash is requested if it was not
          received recently. A mismatch, or no response, begins a download.

        Args:
            announced: the vehicle's last `_HASH_CHECK`.
            now: the time.
            is_download: whether the caller requests a download.
        """
        table = self._table
        if self._fetch_policy is Policy.CACHE_ONLY or is_download:
            self._begin_download(now)
        elif table.hash is None or not table.complete:
            self._begin_or_resume(announced, now)
        elif announced is not None and announced.is_fresh(now):
            self._compare(announced, now)
        else:
            self._ask_hash(self._take_first_hash, now)

    def announced(self, announcement: Announcement) -> None:
        """Process a `_HASH_CHECK`: PX4 sends one at the head of its list."""
        if self.file is not None and self.file.is_awaited:
            self._proof.before = announcement
        if self.download is not None and not self.download.names:
            self.download.note_list_head(announcement.at)
            if self._proof.before is None:
                self._proof.before = announcement

    def receive(self, message: ParamValue, now: float) -> None:
        """Process a PARAM_VALUE of the component, before the reads do."""
        if self.file is not None:
            self.file.receive(message)
        download = self.download
        if download is not None and not download.done:
            if self.first_value_at > now:
                self.first_value_at = now
            download.receive(message, now)
            is_unanswered = self._proof.before is None and not self._was_requested_meanwhile
            if is_unanswered and self._context.expects_hash and not self.done:
                # the one at the head of the list was lost; requested now, it causes no delay later
                self._was_requested_meanwhile = True
                self._ask_hash(self._take_hash_meanwhile, now)

    def tick(self, now: float) -> None:
        self.check_file(now)
        if self.download is not None:
            self.download.tick(now)

    def next_deadline(self) -> float:
        return self._list_due_at if self.download is None else self.download.next_deadline()

    def check_file(self, now: float) -> None:
        """Check the state of the file: the component may have none, or the list may be faster."""
        if self.file is not None:
            self.file.look(now)
        file = self.file
        if file is None or file.done:
            return
        if file.is_served:
            if self.download is not None and not self.download.done:
                self.download.gives_way = True
        elif self._is_file_check:
            return
        elif file.is_awaited and not self._may_use_file():
            self._drop_file(now, is_served=False)
            self._had_no_file = True
            if self.download is None:
                self._begin_list(now)
        elif self.download is None and self._list_error is None:
            if file.blocked_until is not None:
                self._was_in_use = True
                self._begin_list_in_parallel(now)
            elif self._list_due_at <= now:
                self._begin_list_in_parallel(now)

    def doubt(self) -> None:
        """Record that what was announced before proves nothing: changes may have been missed."""
        self._proof.doubt()

    def resume(self, now: float) -> None:
        """Resume: the link is back."""
        if self.download is not None:
            self.download.resume(now)

    @property
    def may_end_with_cache(self) -> bool:
        """Whether it is still open if the cached table is enough."""
        return not self._has_begun or (self.download is not None and self.download.resumed > 0)

    @property
    def is_receiving(self) -> bool:
        """Whether parameters were received, which are stale if the vehicle restarts."""
        return self._has_begun

    def restart(self, now: float) -> None:
        """Start again: the vehicle has restarted or is another one, so the received values are invalid."""
        queue_wait = self.queue_wait(now)
        self._drop(now)
        self.download = None
        self._notes = ()
        self.file_failed = None
        self._had_no_file = self._file_was_silent = self._was_in_use = False
        self._list_error = None
        self._restarts += 1
        if self._restarts > FETCH_RESTARTS_MAX:
            whose = "/".join(map(str, self._target))
            what = f"the parameters of {whose}, which has started again {self._restarts} times"
            self.fail(NoReply(what, attempts=self._restarts, waited=now - self.begun_at), now)
            return
        self._held_before = queue_wait
        self._proof.forget()
        self._was_requested_meanwhile = False
        self._listed = False
        self._begin_download(now)

    def seems_restarted(self, silent_since: float, now: float) -> bool:
        """Start again if the component may have restarted, and return whether that was done.

        Nothing is done if it would repeat more than the component's clock needs to show a restart.

        Args:
            silent_since: when the component was heard last.
            now: the time.
        """
        if self.done or not self._has_begun or silent_since - self._download_begun_at > REPEATED_TIME_MAX:
            return False
        self.restarted_at = now
        self.restart(now)
        return True

    def finish(self, result: FetchResult, now: float) -> None:
        """End with a result, as soon as no unused file session is open on board."""
        files = self._fetch_context.files
        if not files.has_idle_session:
            super().finish(result, now)
        else:
            restarts = self._restarts  # a result from before a restart is invalid

            def closed(at: float) -> None:
                if not self._is_cancelled and self._restarts == restarts:
                    self.finish(result, at)

            files.on_closed.append(closed)

    def cancel(self, now: float) -> None:
        """Cancel the fetch. Values in flight still go into the table."""
        self._is_cancelled = True
        self._drop(now)

    def partial(self, now: float, note: str) -> FetchResult:
        """Return the result so far, for a caller whose timeout ends before the fetch.

        Raises:
            NoReply: nothing was received.
        """
        download = self.download
        file = self.file
        if file is not None and file.count and (download is None or not download.received):
            missing = () if file.done else tuple(range(file.count))
            return self._result("ftp", file.count, missing, None, now, (note,))
        if download is None or download.count is None:
            what = "the parameters of " + "/".join(map(str, self._target))
            attempts = 1 if download is None else download.lists
            raise NoReply(what, attempts=attempts, waited=now - self.begun_at)
        return self._result("stream", download.count, download.missing, None, now, (note,))

    @property
    def is_silent(self) -> bool:
        """Whether nothing was received although it was requested more than once."""
        if self.file is not None and not self.file.is_silent:
            return False
        if self.download is not None:
            return self.download.count is None and self.download.lists > 1
        if self.file is not None:
            return True
        read = self._hash_read
        return read is not None and read.attempts > 1 and not read.request.controls

    def queue_wait(self, now: float) -> float:
        """Return the seconds for which the list has waited for its turn: other lists of the link ran."""
        stream = self.download if self.file is None else self.file
        return self._held_before + (0.0 if stream is None else stream.queue_wait(now))

    def progress(self, now: float) -> Progress:
        """Return the progress."""
        if self.file is not None and (self.download is None or not self.file.is_awaited):
            return self.file.progress(now)
        received, total = (0, self._table.count) if self.download is None else self.download.progress
        downloaded = received - (0 if self.download is None else self.download.resumed)
        return Progress.after(received, total, downloaded, now - self.first_value_at)

    def _ask_hash(self, on_read: Callable[[Read], None], now: float) -> None:
        read = self._hash_read = self._reads.ask(HASH_CHECK, now)

        def ended() -> None:
            if self._hash_read is read:
                self._hash_read = None
                on_read(read)

        read.on_done.append(ended)

    def _take_hash_meanwhile(self, read: Read) -> None:
        self._proof.meanwhile = Announcement.answering(read)
        self._is_hash_unknown = isinstance(read.error, UnknownParameter)
        if self.download is not None and self.download.done:
            self._download_ended(self.download)

    def _take_first_hash(self, read: Read) -> None:
        if read.result is None:
            self._begin_download(read.ended_at)
        else:
            self._compare(Announcement.of(read.result, read.ended_at), read.ended_at)

    def _compare(self, announcement: Announcement, now: float) -> None:
        table = self._table
        known = "none" if table.hash is None else f"{table.hash:08x}"
        self._context.trace("%s/%s: hash %08x announced, %s here", *self._target, announcement.hash, known)
        if announcement.hash != table.hash or announcement.count != table.size:
            self._proof.before = announcement
            self._begin_download(now)
            return
        table.count = announcement.count
        table.verify()
        notes = () if table.volatile_known else (UNPROVEN,)
        if self._fetch_policy is Policy.HASH_ONLY:
            notes = (NOT_REFRESHED,) if table.unhashed() else ()
        self.finish(self._result("cache", announcement.count, (), announcement.hash, now, notes), now)

    def _begin_or_resume(self, announced: Announcement | None, now: float) -> None:
        """Resume with the present values if they are enough and the vehicle's count is unchanged."""
        if not present_of(self._table, self._reads):
            self._begin_download(now)
        elif not self._context.expects_hash:
            self._resume(now)
        elif announced is not None and announced.is_fresh(now):
            self._resume_under(announced, now)
        else:
            self._ask_hash(self._take_hash_to_resume, now)

    def _take_hash_to_resume(self, read: Read) -> None:
        if read.result is not None:
            self._resume_under(Announcement.of(read.result, read.ended_at), read.ended_at)
        elif isinstance(read.error, UnknownParameter):
            self._is_hash_unknown = True
            self._resume(read.ended_at)
        else:
            self._begin_download(read.ended_at)

    def _resume_under(self, announcement: Announcement, now: float) -> None:
        self._proof.before = announcement
        if announcement.count == self._table.count:
            self._resume(now)
        else:
            self._begin_download(now)

    def _resume(self, now: float) -> None:
        self._begin_download(now, present=present_of(self._table, self._reads))

    def _begin_download(self, now: float, present: Mapping[int, str] | None = None) -> None:
        if self._fetch_policy is not Policy.AUTO:
            self._stay_with_cache(now)
            return
        fetch_context = self._fetch_context
        self._has_begun = True
        self._download_begun_at = now
        self._present = present
        fetch_context.doubt(now)
        may_use_file = self._is_file_check or self._may_use_file()
        if self._listed or self._by_list or self._had_no_file or not may_use_file:
            self._begin_list(now)
            return
        self._context.trace("%s/%s: the file is requested, %s there", *self._target, len(present or ()))
        if self._context.expects_hash:
            # once and before the file, so that the response belongs to the time before it
            self._context.send(ParamRequestRead(*self._target, HASH_CHECK, -1))
        file = self.file = FileDownload(
            fetch_context.files,
            fetch_context.list_admission,
            fetch_context.table,
            fetch_context.changed,
            now,
            context=self._context,
            yields=self.check is not None,
        )
        file.on_done.append(partial(self._file_ended, file))

    @property
    def _is_file_check(self) -> bool:
        """Whether the fetch ends without a list when the file is not available."""
        return self.check is not None and not self.check.may_list

    @property
    def _list_due_at(self) -> float:
        """When the list is requested in parallel to an unanswered file; infinity while the file is
        received."""
        file = self.file
        if file is None or file.done or file.is_served or not file.is_awaited or self._list_error is not None:
            return math.inf
        if file.blocked_until is not None or self.download is not None or self._is_file_check:
            return math.inf
        return self._open_retries.list_due_at(file.requested_at)

    def _begin_list_in_parallel(self, now: float) -> None:
        """Request the list while the file is not served."""
        assert self.file is not None
        self.file.give_way()
        self._begin_list(now)

    def _begin_list(self, now: float) -> None:
        fetch_context, present = self._fetch_context, self._present
        self._context.trace("%s/%s: the list is requested, %s there", *self._target, len(present or ()))
        download = self.download = ListDownload(
            self._context,
            fetch_context.reads,
            fetch_context.list_admission,
            now,
            listed=self._listed,
            count=self._table.count,
            present=present,
            parallel_to_file=self.file is not None,
        )
        if download.done:
            self._download_ended(download)
            return
        download.on_done.append(partial(self._download_ended, download))
        if self._proof.before is None and self._context.expects_hash and not self._was_requested_meanwhile:
            # in parallel to the list, so that a lost request of either kind shows at once
            self._was_requested_meanwhile = True
            self._ask_hash(self._take_hash_meanwhile, now)

    def _file_ended(self, file: FileDownload) -> None:
        if self.file is not file:
            return
        now = file.ended_at
        if file.error is None:
            self._drop_download()
            self.file_failed = False
            if file.left_out:
                self._table.unconfirm()
                self._table.complete = False
                self.finish(self._result("ftp", file.count or 0, file.left_out, None, now, ()), now)
                return
            self._table.complete = True
            is_proven = self._proof.is_given(file.count or 0)
            if not is_proven and self._context.expects_hash and not self._is_hash_unknown:
                self._ask_hash(partial(self._take_hash_after_file, file), now)
                return
            if not is_proven:
                self._table.unconfirm()
            self.finish(self._result("ftp", file.count or 0, (), self._table.hash, now, ()), now)
            return
        self.file = None
        self._held_before += file.queue_time
        is_over = self._is_file_check or (self.check is not None and file.is_in_use and not self.download)
        if file.error is not None and (is_over or isinstance(file.error, LinkError)):
            self.fail(file.error, now)
            return
        self._had_no_file = True
        self.file_failed = True if file.is_useless else None
        self._file_was_silent = file.is_unanswered
        if not self._was_in_use:
            self._notes += (NO_FILE.format(file.error),)
        if self.download is not None:
            self.download.request_missing(now)
        elif self._list_error is not None:
            self.fail(self._list_error, now)
        elif self._present is not None:
            self._resume(now)
        else:
            self._begin_download(now)

    def _take_hash_after_file(self, file: FileDownload, read: Read) -> None:
        """Settle the hash: the file is the vehicle's table at one moment, the hash may belong to a later
        one."""
        after = Announcement.answering(read)
        self._table.unconfirm()
        count = file.count or 0
        notes = () if after is None else self._proof.settle(after, count)
        result = self._result("ftp", count, (), self._table.hash, read.ended_at, notes or ())
        self.finish(result, read.ended_at)

    def _stay_with_cache(self, now: float) -> None:
        """End with the cached values and a note: the policy allows no download."""
        table = self._table
        if not table.params:
            whose = "/".join(map(str, self._target))
            self.fail(
                CacheError(f"nothing is cached of {whose}, and the policy is {self._fetch_policy}"), now
            )
            return
        count, missing = table.gaps()
        note = NOT_REQUESTED if self._fetch_policy is Policy.CACHE_ONLY else NOT_CONFIRMED
        self.finish(self._result("cache", count, missing, None, now, (note,)), now)

    def _download_ended(self, download: ListDownload) -> None:
        if self.download is not download:
            return
        file = self.file
        if download.error is not None:
            if file is not None and not file.done:
                self.download, self._list_error = None, download.error  # the file may still be received
            else:
                self.fail(download.error, download.ended_at)
            return
        if file is not None and not file.done:
            self._file_was_silent = file.is_silent and self._open_retries.should_give_up(file.attempts)
            if self._file_was_silent and not self._was_in_use:
                self._notes += (NO_FILE.format(file.silence(download.ended_at)),)
            self._drop_file(download.ended_at)
        if download.missing:
            self._drop_hash_read()  # proves nothing
        if self._hash_read is not None:
            return  # in flight
        now = download.ended_at
        if self._is_proven(download):
            self._finish_download(download, now, ())
        elif self._context.expects_hash and not (self._is_hash_unknown or download.missing):
            self._ask_hash(lambda read: self._settle(download, read, read.ended_at), now)
        else:
            self._settle(download, None, now)

    def _is_proven(self, download: ListDownload) -> bool:
        """Return whether a hash announced during the download proves the table."""
        if download.missing or not download.is_settled:
            return False
        self._remove_unlisted(download)
        return self._proof.is_given(download.count or 0)

    def _remove_unlisted(self, download: ListDownload) -> None:
        self._fetch_context.changed(self._table.settle(download.names))

    def _settle(self, download: ListDownload, read: Read | None, now: float) -> None:
        """End the fetch: the download is over and the hash, if there is one, is known."""
        after = None if read is None else Announcement.answering(read)
        notes: tuple[str, ...] = ()
        if not download.missing:
            if read is not None or not download.is_settled:  # else `_is_proven` has just done it
                self._remove_unlisted(download)
            if not download.is_settled:
                notes = (UNSETTLED,)
            self._table.unconfirm()
        if after is not None and not download.missing:
            judged = self._proof.settle(after, download.count or 0, needs_proof=download.resumed > 0)
            if judged is None:
                # values received earlier may be outdated
                self._notes = (NOT_RESUMED,)
                self._proof.forget()
                self._was_requested_meanwhile = False
                self._begin_download(now)
                return
            notes += judged
        self._finish_download(download, now, notes)

    def _finish_download(self, download: ListDownload, now: float, notes: tuple[str, ...]) -> None:
        count = download.count or 0
        missing = download.missing
        table = self._table
        if not missing:
            table.complete = download.is_settled and len(set(download.names.values())) == count
        else:
            table.place(download.names)
        table.count = count
        if self._file_was_silent and not missing:  # while the list was received
            self.file_failed = True
        if self._was_in_use:
            notes += (FILE_IN_USE,)
        if download.resumed and table.hash is None:
            earlier = table.only_cached
            notes += (CACHED_UNVERIFIED.format(earlier),) if earlier else ()
        self.finish(
            self._result("stream", count, missing, table.hash if not missing else None, now, notes), now
        )

    def _result(
        self,
        source: FetchSource,
        count: int,
        missing: tuple[int, ...],
        confirmed: int | None,
        now: float,
        notes: tuple[str, ...],
    ) -> FetchResult:
        received = count - len(missing)
        download = self.download
        left_out = self._table.left_out - self._left_out_before
        if left_out:
            more = f", and {left_out - 1} more times" if left_out > 1 else ""
            notes += (LEFT_OUT.format(self._table.left_out_name, more),)
        return FetchResult(
            *self._target,
            self._table.params.copy(),
            source,
            count,
            received,
            missing,
            confirmed,
            now - self.begun_at,
            self._notes + notes,
            resumed=0 if download is None else download.resumed,
            lost=0 if download is None else download.lost,
            repeated=0 if download is None else download.repeated,
            round_trip=self._context.round_trip.smoothed,
        )

    def _drop_hash_read(self) -> None:
        read, self._hash_read = self._hash_read, None
        if read is not None:
            self._reads.release(read)

    def _drop(self, now: float) -> None:
        self._drop_hash_read()
        self._drop_file(now)
        self._drop_download()

    def _drop_file(self, now: float, *, is_served: bool = True) -> None:
        file, self.file = self.file, None
        if file is not None:
            self._held_before += file.queue_wait(now)
            file.cancel(now, is_served=is_served)

    def _drop_download(self) -> None:
        download, self.download = self.download, None
        if download is not None:
            download.cancel()
            download.drop_callbacks()
