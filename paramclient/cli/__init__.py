"""The command line: parses arguments, calls the client, and prints tables or JSON.

- `app`: all subcommands, the main function, signals and errors.
- Subcommands: `read_commands` (fetch, get, watch), `set_command` (set), `apply` (apply, restore, reset),
  `show` (show, search, info), `cached` (cache, import, history), `sources` (save, diff), `metadata`, `link`
  (link, ports), `check`, `signing` and `serve` (serve, token, sim).
- `session`: open links with the vehicles of --vehicle, on which a subcommand works, and the parameters that
  it reads there. `options`: options.
- `sources` also finds the parameters that an argument names: of a file, a link or the cache.
- `metadata`: descriptions and defaults that a subcommand uses.
- `output`: tables, lines, the status line, exit codes.
- `json_output`: JSON.
"""
