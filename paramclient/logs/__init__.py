"""Telemetry logs and on-board logs as sources of parameters.

- `telemetry`, `onboard_import`: import of both kinds into a cache.
- `onboard`, `logged_params`: reading of on-board logs, and the content of logs.
- `dataflash`, `ulog`: one module for each format of on-board logs.
"""
