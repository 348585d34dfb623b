"""Bytes to messages and back, without I/O and without a clock. The only room that uses pymavlink.

- `frames`: frames from and to bytes; checksums.
- `messages`: the message classes, one table of their formats, decoding and encoding.
- `signing`: signatures of MAVLink 2.
- `loss`: lost frames by the gaps in sequence numbers.
"""
