"""The command: arguments to the client, and what it brings to a table or JSON.

`app` reads the arguments and runs a command; the commands stand in `vehicle` (fetch, get, set, watch),
`offline` (show, cache), `logs` (import), `setup` (apply, verify, restore), `diff`, `save`, `history`,
`fleet`, `link`, `ports` and `simulate` (sim). `sources` finds the parameters that a word of the user means,
`targets` the vehicles that are to be set up, `when` reads moments; `results`, `written`, `metadata`,
`options`, `session`, `output` and `outcome` serve them all.
"""

from __future__ import annotations

from paramclient.cli.app import run

__all__ = ["run"]
