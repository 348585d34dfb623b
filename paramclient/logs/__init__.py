"""Telemetry logs and on-board logs as sources of parameters.

- `telemetry`, `onboard`: both kinds of logs, and their import into a cache.
- `logged_params`: the content of logs.
- `dataflash`, `ulog`: one module for each format of on-board logs.
"""
