"""The command line: parses arguments, calls the client, and prints tables or JSON.

- `app`: all subcommands, the main function, signals and errors.
- Subcommands: `parameters` (fetch, get, watch), `set_command` (set), `offline` (show, cache), `logs`
  (import), `apply` (apply, verify, restore), `save`, `diff`, `history`, `search` (search, info), `fleet`,
  `link`, `check`, `ports`, `signing`, `serve`, `token` and `simulate` (sim).
- `param_names`: names and patterns of parameters, and suggestions.
- `extended`: extended parameters in these subcommands.
- `sources`, `targets`: the parameters and the vehicles that an argument names. `time_arguments`: times.
- `session`, `options`: an open link with its vehicle; options that several subcommands share.
- `output`, `param_rows`, `results`, `metadata`, `exit_codes`: tables, JSON, metadata and exit codes.
- `signals`: SIGINT and SIGTERM.
"""

from __future__ import annotations

from paramclient.cli.app import run

__all__ = ["run"]
