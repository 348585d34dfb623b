"""The command `paramclient`, also as `python -m paramclient`."""

from __future__ import annotations

import gc
import os
import signal
import sys
from importlib.util import find_spec
from typing import Final, NoReturn

__all__ = ["main"]

LIBRARIES: Final = ("cyclopts", "rich")
"""What the extra `cli` installs."""
SIGPIPE: Final = 13
"""Windows has no such signal, and the exit code is the same there."""


def main() -> NoReturn:
    """Run the command with the arguments of the process, and leave with its exit code.

    130 after Ctrl-C, 143 after SIGTERM and 141 when nobody reads the output any more, as for programs that
    die of these signals; the other codes stand in `paramclient.cli.exit_codes`.
    """
    if missing := [name for name in LIBRARIES if find_spec(name) is None]:
        print(
            f"paramclient: the command needs {' and '.join(missing)}: pip install 'paramclient[cli]'",
            file=sys.stderr,
        )
        sys.exit(2)
    try:
        from paramclient.cli import run  # only here: needs the extra

        gc.freeze()  # what is loaded by now stays: full collections need not go through it, 10 ms and more
        code = run(sys.argv[1:])
    except KeyboardInterrupt:
        code = 128 + signal.SIGINT
    except BrokenPipeError:
        # what is still in the buffers must not fail once more when the interpreter ends
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in (sys.stdout, sys.stderr):
            os.dup2(nowhere, stream.fileno())
        code = 128 + SIGPIPE
    sys.exit(code)


if __name__ == "__main__":
    main()
