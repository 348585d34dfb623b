"""The client over one link.

- `client`, `component`: `ParamClient`, `Component`.
- `core`: the tasks of a client, opening and closing.
- `link_task`: reads, sends, and reopens the link.
- `cache_writer`: loads cached tables, writes new values in batches, and waits for the disk
  if a write is durable.
- `streams`: streams of items and of parameter changes.
- `signing`: keys, options, persistent timestamps.
- `taps`: the receivers of all frames of a link: the telemetry log, traffic.
- `blocking`: the client without `await`.
"""
