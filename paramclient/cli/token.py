"""The subcommand token: creates an access token for the service."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from paramclient.cli.output import print_line, say
from paramclient.errors import UsageError

__all__ = ["token"]


def token(name: str, /, *, file: Path, read: bool = False) -> None:
    """Create an access token for `paramclient serve`, and print it once.

    The token file stores only its digest, with the name for the history; the file is created if it does not
    exist. To revoke the token, remove its line and restart the service.

    Args:
        name: The user or computer, such as anna or bench-laptop.
        file: The token file of serve --tokens.
        read: Allow only reading.
    """
    if find_spec("fastapi") is None:
        raise UsageError("the service needs fastapi: pip install 'paramclient[service]'")
    from paramclient.service import add_token  # only here: needs the extra

    made = add_token(file, name, "read" if read else "write")
    say(f"token for {name} ({'read' if read else 'read and write'}), which is shown only once:")
    print_line(made)
