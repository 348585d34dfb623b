"""Traffic, packet loss by sequence numbers, and traces of a link."""
