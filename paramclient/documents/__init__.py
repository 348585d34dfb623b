"""The JSON documents that the command line prints and the service sends, as pydantic models.

Each document is built by its `of(…)` from an object of the library.

- `document`: the base classes of documents and request bodies.
- `param`, `paramset`: one parameter; parameters of a file or a snapshot.
- `component`, `link`, `job`, `problem`: components, links, running work and errors of the service.
- `results`: results of fetches and writes of the service. `setup`: plans and results of set-ups.
- `receiver`: the vehicle that is written to.
- `diff`, `fleet`: comparisons of two sets and of many vehicles.
- `cached`, `history`: tables, changes and snapshots in the cache.
- `traffic`, `check`: traffic of a link; the diagnosis of a vehicle.
- `extended_param`, `extended_results`: one extended parameter; results of fetches and writes.
- `extended_output`: extended parameters, as subcommands print them.
- `command_output`: what single subcommands print with `--json`, such as `fetch`.

The modules load pydantic, which takes time: import only the one that is needed, where JSON is made.
"""
