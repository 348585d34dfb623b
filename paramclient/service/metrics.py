"""Metrics of the service, in the text format of Prometheus."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Final, TypeAlias

from paramclient.version import __version__

if TYPE_CHECKING:
    from paramclient.service.hub import Hub

METRICS_MEDIA_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"
"""Media type of the metrics."""
STATION_SUMS: Final = {
    "relayed": "Frames of vehicles.",
    "answered": "Answers from the tables.",
    "saved": "Bytes of answers that were not sent over the link of a vehicle.",
    "dropped": "Frames dropped because a station did not read.",
}
"""Help texts of the sums over the connected stations of an endpoint, by attribute of `GroundStation`."""
_ESCAPES: Final = str.maketrans({"\\": r"\\", "\n": r"\n", '"': r"\""})

Sample: TypeAlias = tuple[Mapping[str, object], float]
"""Labels and a value."""


def metrics_text(hub: Hub) -> str:
    """Return the current metrics."""
    lines = []
    for name, text, samples in _metrics(hub):
        kind = "counter" if name.endswith("_total") else "gauge"
        lines += [f"# HELP paramclient_{name} {text}", f"# TYPE paramclient_{name} {kind}"]
        for labels, value in samples:
            pairs = [f'{label}="{str(each).translate(_ESCAPES)}"' for label, each in labels.items()]
            lines.append(f"paramclient_{name}{{{','.join(pairs)}}} {float(value)}")
    return "\n".join([*lines, ""])


def _metrics(hub: Hub) -> Iterator[tuple[str, str, Sequence[Sample]]]:
    """Yield name, help text and samples of each metric. The name of a counter ends with `_total`."""
    yield "info", "Version of paramclient.", [({"version": __version__}, 1)]
    yield "uptime_seconds", "Seconds since the start.", [({}, time.monotonic() - hub.started)]
    yield "events_total", "Published events.", [({}, hub.feed.seq)]

    links = [({"link": link.name}, link) for link in hub.links.values()]
    yield "link_open", "1 if the link is open.", [(at, link.state == "open") for at, link in links]
    opened = [(at, link.client) for at, link in links if link.client is not None]
    yield "link_bytes_received_total", "Received bytes.", [(at, each.bytes_received) for at, each in opened]
    yield "link_bytes_sent_total", "Sent bytes.", [(at, each.bytes_sent) for at, each in opened]

    tables = [(target.address, target.component) for target in hub.targets]
    is_up = [(at, each.sync_state != "lost") for at, each in tables]
    yield "component_up", "1 if the vehicle is not lost.", is_up
    is_synced = [(at, each.sync_state == "synced") for at, each in tables]
    yield "component_synced", "1 if the table matches that of the vehicle.", is_synced
    sizes = [(at, len(each.params)) for at, each in tables]
    yield "component_parameters", "Parameters in the table.", sizes
    times = [(at, each.round_trip) for at, each in tables if each.round_trip is not None]
    yield "component_round_trip_seconds", "Smoothed round-trip time in seconds.", times

    endpoints = [({"endpoint": each.name}, each.stations.values()) for each in hub.gateway.endpoints]
    yield "stations", "Connected ground stations.", [(at, len(stations)) for at, stations in endpoints]
    for name, text in STATION_SUMS.items():
        sums = [(at, sum(getattr(each, name) for each in stations)) for at, stations in endpoints]
        yield f"stations_{name}", text, sums
