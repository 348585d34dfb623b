"""Round-trip time, timeouts and pacing of requests."""
