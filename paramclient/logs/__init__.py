"""Telemetry logs and on-board logs as sources of parameters.

- `onboard`: the parameters in on-board logs, ArduPilot's and PX4's.
- `imports`: import of both kinds of logs into a cache.
"""
