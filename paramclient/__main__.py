"""Entry point of the command line `paramclient` and of `python -m paramclient`."""

from __future__ import annotations

import gc
import os
import signal
import sys
from importlib.util import find_spec
from typing import Final, NoReturn

COMMAND_LIBRARIES: Final = ("cyclopts", "rich")
"""Libraries that the extra `cli` installs."""
SIGPIPE: Final = 13
"""Number of the signal, for the exit code. Windows has no SIGPIPE but uses the same exit code."""


def main() -> NoReturn:
    """Run the command line with the arguments of the process, and exit with its exit code.

    Exits with 130 after Ctrl-C, 143 after SIGTERM and 141 when the output's reader has closed it, like
    programs killed by these signals; `paramclient.cli.output` lists the other codes.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:  # closed, as by `2>&-`
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), mode))
    if missing := [name for name in COMMAND_LIBRARIES if find_spec(name) is None]:
        print(
            f"paramclient: the command needs {' and '.join(missing)}: pip install 'paramclient[cli]'",
            file=sys.stderr,
        )
        sys.exit(2)
    try:
        from paramclient.cli.app import run  # imported here because it needs the extra

        gc.freeze()  # modules stay loaded: excluding them saves 10 ms and more per full collection
        code = run(sys.argv[1:])
    except KeyboardInterrupt:
        code = 128 + signal.SIGINT
    except BrokenPipeError:
        # flushing the buffers at interpreter exit would raise BrokenPipeError again
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in (sys.stdout, sys.stderr):
            os.dup2(nowhere, stream.fileno())
        code = 128 + SIGPIPE
    sys.exit(code)


if __name__ == "__main__":
    main()
