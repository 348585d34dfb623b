"""The client over one link.

- `arguments`: argument defaults and checks.
- `batch_wait`: waiting for the end of a batch of writes.
- `cache_writer`: writes parameter tables to the cache, and waits for the disk if a write is durable.
- `client`: `ParamClient`.
- `client_task`: the task that keeps a client open from `open` to `aclose`.
- `component`: `Component`.
- `component_core`: the state of a component, and the waiting of its calls.
- `core`: the running parts of a client, and opening and closing.
- `event_dispatch`: passes the events of the protocol core on.
- `loop_scheduler`: CPU time and list downloads shared among the links of one event loop.
- `extended_params`: `ExtParams`.
- `events`: public events and their stream.
- `file_ownership`: owner and access rights of files with secrets.
- `fetch_all`: fetches of several components in parallel.
- `files`: MAVFTP calls.
- `forwarding`: frames to and from one other program.
- `link_task`: link reader and sender; reopens the link.
- `recording`: telemetry log of a link.
- `reconnect_delays`: delays between attempts to reopen a link, and the timeout of calls; `link_task` makes
  the attempts.
- `reset`: resets of parameters to the firmware's defaults.
- `signing`: signing keys and options.
- `signing_timestamps`: persistent signature timestamps.
- `stats`: counters of a client.
- `subscription`: streams of items, and of parameter changes.
- `vehicle_search`: all vehicles on a link, or an expected number of them.
- `suspend_detection`: detection of suspend and of a stopped process.
- `taps`: the telemetry log and the forwarder of a client.
"""
