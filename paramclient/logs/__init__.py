"""Telemetry logs and on-board logs as sources of parameters.

- `telemetry`, `onboard_import`, `imported_table`: import of both kinds into a cache, and its result.
- `onboard`, `logged_params`: reading of on-board logs, and their content.
- `dataflash`, `ulog`: one module for each format of on-board logs.
"""
