"""Telemetry logs as sources of parameters."""
