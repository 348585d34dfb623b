"""Telemetry logs as sources of parameters: import into a cache.

- `telemetry`: import of telemetry logs.
"""
