"""A thread for what blocks: in order, to the end, and no thread left behind."""

from __future__ import annotations

import threading
from collections.abc import Callable

import anyio

from paramclient.client.worker_thread import Worker

NAME = "a worker of tests"


def threads() -> int:
    return sum(thread.name == NAME for thread in threading.enumerate())


def test_calls_made_while_the_worker_closes_are_completed() -> None:
    """Their calls follow the last one of the closing, and are executed and reported all the same."""
    done: list[str] = []
    may_go_on = threading.Event()

    async def ask(worker: Worker, what: str) -> None:
        await worker.run(lambda: done.append(what))

    async def main() -> None:
        worker = Worker(NAME)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(worker.run, may_go_on.wait)
            await anyio.lowlevel.checkpoint()
            tasks.start_soon(worker.close, lambda: done.append("last"))
            await anyio.lowlevel.checkpoint()
            for number in range(5):
                tasks.start_soon(ask, worker, str(number))
            await anyio.lowlevel.checkpoint()
            may_go_on.set()

    with_patience(main)
    assert done == ["last", "0", "1", "2", "3", "4"]
    assert not threads()


def test_a_call_after_the_close_is_completed() -> None:
    async def main() -> None:
        worker = Worker(NAME)
        assert await worker.run(lambda: 1) == 1
        assert threads() == 1
        await worker.close(lambda: None)
        assert not threads()
        assert await worker.run(lambda: 2) == 2
        with anyio.fail_after(20):
            while threads():  # noqa: ASYNC110 - no event reports it
                await anyio.sleep(0.001)

    with_patience(main)


def with_patience(main: object) -> None:
    """Run it; one that hangs is reported, and not waited for."""
    ended = threading.Thread(target=anyio.run, args=(main,), daemon=True)
    ended.start()
    ended.join(20)
    assert not ended.is_alive()


def test_abandoned_it_does_nothing_more_and_does_not_wait() -> None:
    begun: list[str] = []
    errors: list[str] = []
    blocked, may_end = threading.Event(), threading.Event()

    def block() -> None:
        begun.append("first")
        blocked.set()
        may_end.wait(20)

    async def ask(worker: Worker, work: Callable[[], None]) -> None:
        try:
            await worker.run(work)
        except EOFError as error:
            errors.append(str(error))

    async def main() -> None:
        worker = Worker(NAME)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(ask, worker, block)
            for _ in range(3):
                tasks.start_soon(ask, worker, lambda: begun.append("more"))
            while not blocked.is_set():  # noqa: ASYNC110 - no event reports it
                await anyio.sleep(0.001)
            worker.drop(lambda: EOFError("over"))
            await anyio.lowlevel.checkpoint()
            assert errors == ["over"] * 3
            began = anyio.current_time()
            await worker.abandon(lambda: EOFError("over"), 0.1)
            assert anyio.current_time() - began < 5
            tasks.start_soon(ask, worker, lambda: begun.append("late"))
        assert errors == ["over"] * 5
        may_end.set()
        while threads():  # noqa: ASYNC110 - no event reports it
            await anyio.sleep(0.001)

    with_patience(main)
    assert begun == ["first"]
