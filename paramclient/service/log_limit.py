"""Log lines that others can cause: one in a minute of each kind, and how many there were besides."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

__all__ = ["LogLimit"]

MINUTE: Final = 60.0
"""Seconds in which one line of a kind is written."""
MOST_KINDS: Final = 64
"""Kinds that are told apart; those beyond are one kind."""
LONGEST_KIND: Final = 80
"""Characters of a line that name its kind, where the line is another library's."""

LIMITED: Final = {
    "uvicorn.error": ("",),
    "asyncio": (
        *("SSL handshake failed", "SSL error in data received", "Fatal error on ", "Fatal write error on "),
        *("socket.accept() out of system resource", "socket.send() raised exception"),
    ),
}
"""Loggers of libraries whose lines a client can cause, and how these begin."""


@dataclass(slots=True)
class _Kind:
    """What was told of one kind: when, at which level and in which words; and what was not told since."""

    logger: logging.Logger
    level: int
    text: str
    at: float
    more: int = 0


class LogLimit:
    """Writes the first line of a kind, and after a minute how many more there were.

    Args:
        clock: seconds, that only go forward.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._kinds: dict[str, _Kind] = {}

    def tell(self, logger: logging.Logger, kind: str, text: str, level: int = logging.WARNING) -> None:
        """Write this line, unless one of its kind was written less than a minute ago."""
        if self._is_due(logger, kind, text, level):
            logger.log(level, "%s", text)

    def flush(self, *, ends: bool = False) -> None:
        """Tell of each kind whose minute is over how many lines were left out; at the end, of all kinds."""
        for kind in list(self._kinds):
            self._flush(kind, ends=ends)

    @contextmanager
    def of_libraries(self) -> Iterator[None]:
        """Hold the libraries that serve to the same."""
        loggers = [logging.getLogger(name) for name in LIMITED]
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
        kind = str(record.msg).partition("\n")[0][:LONGEST_KIND]
        if not kind.startswith(LIMITED[record.name]):
            return True
        return self._is_due(logging.getLogger(record.name), f"{record.name}: {kind}", kind, record.levelno)

    def _is_due(self, logger: logging.Logger, kind: str, text: str, level: int) -> bool:
        kind = kind if kind in self._kinds or len(self._kinds) < MOST_KINDS else ""
        self._flush(kind)
        told = self._kinds.get(kind)
        if told is not None:
            told.more += 1
            return False
        self._kinds[kind] = _Kind(logger, level, text, self._clock())
        return True

    def _flush(self, kind: str, *, ends: bool = False) -> None:
        told, now = self._kinds.get(kind), self._clock()
        if told is None or (now - told.at < MINUTE and not ends):
            return
        if told.more:
            said = f"{told.text} (and {told.more} more such lines in {now - told.at:.0f} s)"
            told.logger.log(told.level, "%s", said, extra=_OURS)
        if told.more and not ends:
            told.at, told.more = now, 0
        else:
            del self._kinds[kind]


_OURS: Final = {"is_summary": True}
