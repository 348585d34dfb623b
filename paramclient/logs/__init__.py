"""Telemetry logs and on-board logs as sources of parameters.

- `telemetry`: import of telemetry logs into a cache.
- `onboard`, `logged_params`: reading of on-board logs, and their content.
- `dataflash`, `ulog`: one module for each format of on-board logs.
"""
