"""The client over one link.

- `client`, `component`: `ParamClient`, `Component`.
- `core`: the tasks of a client, opening and closing.
- `link_task`: reads, sends, and reopens the link.
- `cache_writer`: loads cached tables, writes new values in batches, and waits for the disk
  if a write is durable.
- `streams`, `events`: streams of items and of parameter changes; events of components and their stream.
- `fleet_fetch`, `files`: fetches of several components, MAVFTP calls.
- `signing`: keys, options, persistent timestamps.
- `taps`, `recording`, `traffic`: the receivers of all frames of a link: the telemetry log, counts.
"""
