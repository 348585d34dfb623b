"""Rate limit of log lines that clients can cause: one line per minute and kind, with the number of suppressed
lines."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

__all__ = ["LogLimit"]

LOG_INTERVAL: Final = 60.0
"""Minimum interval in seconds between two log lines of one kind."""
LOG_KINDS_MAX: Final = 64
"""Maximum number of kinds. Further lines share one kind."""
LOG_KIND_LENGTH_MAX: Final = 80
"""Number of characters of a library's message that identify its kind."""

LIMITED_LOGGERS: Final = {
    "uvicorn.error": ("",),
    "asyncio": (
        *("SSL handshake failed", "SSL error in data received", "Fatal error on ", "Fatal write error on "),
        *("socket.accept() out of system resource", "socket.send() raised exception"),
    ),
}
"""Loggers of libraries whose messages clients can cause, and the first words of these messages."""


@dataclass(slots=True)
class _Kind:
    """State of one kind of log line.

    Attributes:
        logger: logger of the last line.
        level: its level.
        text: its text.
        at: its time in seconds.
        more: number of lines suppressed since.
    """

    logger: logging.Logger
    level: int
    text: str
    at: float
    more: int = 0


class LogLimit:
    """Writes the first log line of a kind, and a minute later the number of suppressed lines.

    Args:
        clock: returns monotonic time in seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._kinds: dict[str, _Kind] = {}

    def log(self, logger: logging.Logger, kind: str, text: str, level: int = logging.WARNING) -> None:
        """Write a line, or suppress it if one of its kind was written less than a minute ago."""
        if self._is_due(logger, kind, text, level):
            logger.log(level, "%s", text)

    def flush(self, *, ends: bool = False) -> None:
        """Write the number of suppressed lines of each kind after a minute, or immediately if `ends`."""
        for kind in list(self._kinds):
            self._flush(kind, ends=ends)

    @contextmanager
    def limit_libraries(self) -> Iterator[None]:
        """Return a context manager that limits the messages of the server's libraries too."""
        loggers = [logging.getLogger(name) for name in LIMITED_LOGGERS]
        for logger in loggers:
            logger.addFilter(self._may_pass)
        try:
            yield
        finally:
            for logger in loggers:
                logger.removeFilter(self._may_pass)

    def _may_pass(self, record: logging.LogRecord) -> bool:
        if record.levelno < logging.WARNING or hasattr(record, "is_summary"):
            return True
        kind = str(record.msg).partition("\n")[0][:LOG_KIND_LENGTH_MAX]
        if not kind.startswith(LIMITED_LOGGERS[record.name]):
            return True
        return self._is_due(logging.getLogger(record.name), f"{record.name}: {kind}", kind, record.levelno)

    def _is_due(self, logger: logging.Logger, kind: str, text: str, level: int) -> bool:
        kind = kind if kind in self._kinds or len(self._kinds) < LOG_KINDS_MAX else ""
        self._flush(kind)
        last = self._kinds.get(kind)
        if last is not None:
            last.more += 1
            return False
        self._kinds[kind] = _Kind(logger, level, text, self._clock())
        return True

    def _flush(self, kind: str, *, ends: bool = False) -> None:
        last, now = self._kinds.get(kind), self._clock()
        if last is None or (now - last.at < LOG_INTERVAL and not ends):
            return
        if last.more:
            summary = f"{last.text} (and {last.more} more such lines in {now - last.at:.0f} s)"
            last.logger.log(last.level, "%s", summary, extra=_OURS)
        if last.more and not ends:
            last.at, last.more = now, 0
        else:
            del self._kinds[kind]


_OURS: Final = {"is_summary": True}
