"""Statistics of a link.

`packet_loss`: lost frames, by sequence numbers.
`sniffer`: all frames of a link, including damaged and unknown ones.
`trace`: trace lines for debugging.
`traffic`: counts, rates and losses by component and message.
"""
