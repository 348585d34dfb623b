"""The command that makes tokens for those who may use the service."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from paramclient.cli.output import print_line, say
from paramclient.errors import UsageError

__all__ = ["token"]


def token(name: str, /, *, file: Path, read: bool = False) -> None:
    """Make a token for somebody who may use `paramclient serve`, and print it, this once.

    The file gets its digest alone, with the name that will stand in the history, and is made if it is not
    there. Take the line out, and from the next start of the service on the token is none.

    Args:
        name: For whom, such as anna or bench-laptop.
        file: The file of tokens, as serve --token-file takes it.
        read: It allows to read only.
    """
    if find_spec("fastapi") is None:
        raise UsageError("the service needs fastapi: pip install 'paramclient[service]'")
    from paramclient.service.tokens import add_token  # only here: needs the extra

    made = add_token(file, name, "read" if read else "write")
    say(f"{name} may {'read' if read else 'read and write'} with this token, which is shown this once:")
    print_line(made)
