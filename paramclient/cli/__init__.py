"""The command: arguments to the client, and what it brings to a table or JSON.

`app` reads the arguments and runs a command; the commands stand in `vehicle` (fetch, get, set, watch),
`offline` (show, cache), `logs` (import), `link`, `ports` and `simulate` (sim). `options`,
`session`, `output` and `outcome` serve them.
"""

from __future__ import annotations

from paramclient.cli.app import run

__all__ = ["run"]
