"""The parameter protocol without a socket, a clock or a disk: time comes in as an argument."""
