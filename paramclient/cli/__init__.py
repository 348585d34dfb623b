"""The command line: parses arguments, calls the client, and prints tables or JSON.

- `app`: all subcommands, the main function, signals and errors.
- Subcommands: `read_commands` (fetch, get, watch), `set_command` (set), `reset_command` (reset), `offline`
  (show, cache), `logs` (import), `apply` (apply, restore), `save`, `diff`, `history`, `search`
  (search, info), `link`, `check`, `ports`, `signing`, `serve`, `token` and `simulate` (sim).
- `restore_states`: the states that restore writes, and what they undo.
- `metadata_files`: metadata (add, list, remove).
- `param_names`: names and patterns of parameters, and suggestions.
- `extended`: extended parameters in these subcommands. `watch_lines`: the lines of watch.
- `every_vehicle`: --all of fetch, get and set. `both_vehicles`: the two vehicles on one link, for diff.
- `vehicle_name`: the vehicle that --vehicle names.
- `sources`, `targets`: the parameters and the vehicles that an argument names. `time_arguments`: times.
- `session`, `options`: an open link with its vehicle; options that several subcommands share.
- `waiting`: what a command waits for, on a terminal.
- `output`: layout of all tables, progress. `json_output`, `json_cache`, `json_setup`: JSON.
  `exit_codes`: exit codes.
- `file_output`: the table of `show FILE`, and texts of parameters in files. `setup_results`: the tables of
  apply and restore.
- `metadata`: metadata that a subcommand uses, and the columns with units and meanings.
- `default_sources`: the metadata that gives the firmware's defaults.
- `write_outcomes`, `confirmation`: writes with their outcomes, and the question before them.
- `link_history`, `block_characters`: drawings of a link on a terminal.
- `signals`: SIGINT and SIGTERM.
"""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["run"]


def run(arguments: Sequence[str]) -> int:
    """Run the command line, see `app.run`. The libraries that it needs are imported only now."""
    from paramclient.cli import app

    return app.run(arguments)
