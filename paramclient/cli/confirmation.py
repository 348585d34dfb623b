"""Questions to the user at the terminal, while a link is open."""

from __future__ import annotations

import sys

import anyio
import anyio.to_thread

from paramclient.cli.options import LinkOptions
from paramclient.cli.output import printable

__all__ = ["can_ask", "can_confirm", "confirm"]


def can_ask() -> bool:
    """Return whether a user can read a question and answer it: stdin and stderr are a terminal."""
    return sys.stdin.isatty() and sys.stderr.isatty()


def can_confirm(options: LinkOptions) -> bool:
    """Return whether a user can confirm changes that are shown first: `can_ask`, without --json."""
    return not options.json and can_ask()


async def confirm(question: str) -> bool:
    """Ask a question on stderr; return whether the answer is y or yes. The link is served meanwhile.

    Cancellation, as by Ctrl-C, ends the question.
    """
    sys.stderr.write(printable(f"{question} [y/N] "))
    sys.stderr.flush()
    if sys.platform == "win32":  # a console cannot be waited for
        answer = await anyio.to_thread.run_sync(sys.stdin.readline, abandon_on_cancel=True)
    else:
        await anyio.wait_readable(sys.stdin)  # a terminal becomes readable with a whole line
        answer = sys.stdin.readline()
    return answer.strip().lower() in ("y", "yes")
