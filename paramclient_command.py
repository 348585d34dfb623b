"""Entry point of the command `paramclient`: outside of the package, whose import Ctrl-C may interrupt."""

import sys


def main() -> None:
    """Run the command line; see `paramclient.__main__`."""
    try:
        from paramclient.__main__ import main as run

        run()
    except KeyboardInterrupt:
        sys.exit(130)
