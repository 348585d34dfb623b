"""Telemetry logs as sources of parameters: import into a cache."""
