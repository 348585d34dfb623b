"""The command: arguments to the client, and what it brings to a table or JSON.

`app` reads the arguments and runs a command; the commands stand in `vehicle` (fetch, get, set, watch),
`offline` (show, cache), `diff`, `save`, `history`, `fleet`, `link`, `ports` and `simulate` (sim). `sources`
finds the parameters that a word of the user means, `when` reads moments; `written`, `metadata`, `options`,
`session`, `output` and `outcome` serve them all.
"""

from __future__ import annotations

from paramclient.cli.app import run

__all__ = ["run"]
