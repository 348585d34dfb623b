"""Metrics of the service for Prometheus."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Final

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from paramclient.version import __version__

if TYPE_CHECKING:
    from paramclient.service.hub import Hub

__all__ = ["METRICS_MEDIA_TYPE", "metrics_text"]

METRICS_MEDIA_TYPE: Final = CONTENT_TYPE_PLAIN_0_0_4
"""Media type of the metrics."""
_COUNTERS: Final = {
    "bytes_received": "Received bytes.",
    "bytes_sent": "Sent bytes.",
}
"""Help texts of the counters of a link, by attribute of `ParamClient`."""
_STATION_COUNTERS: Final = {
    "relayed": "Frames of vehicles.",
    "answered": "Answers from the tables.",
    "saved": "Bytes of answers that were not sent over the link of a vehicle.",
    "dropped": "Frames dropped because a station did not read.",
}
"""Help texts of the counters of the connected stations of an endpoint, by attribute of `GroundStation`."""
_GAUGES: Final = {
    "up": "1 if the vehicle is not lost.",
    "synced": "1 if the table matches that of the vehicle.",
    "parameters": "Parameters in the table.",
    "round_trip_seconds": "Smoothed round-trip time in seconds.",
}
"""Help texts of the gauges of a component."""


def metrics_text(hub: Hub) -> bytes:
    """Return the current metrics in text format."""
    registry = CollectorRegistry()  # not the library's global one, which has metrics of the process
    registry.register(_HubCollector(hub))
    return generate_latest(registry)


class _HubCollector(Collector):
    def __init__(self, hub: Hub) -> None:
        self._hub = hub

    def collect(self) -> Iterable[Metric]:
        hub = self._hub
        info = GaugeMetricFamily("paramclient_info", "Version of paramclient.", labels=["version"])
        info.add_metric([__version__], 1)
        yield info
        uptime = round(time.monotonic() - hub.started, 3)
        yield GaugeMetricFamily("paramclient_uptime_seconds", "Seconds since the start.", uptime)
        yield CounterMetricFamily("paramclient_events_total", "Published events.", hub.feed.seq)
        yield GaugeMetricFamily("paramclient_listeners", "Open event streams.", hub.feed.listeners)
        yield from _link_metrics(hub)
        yield from _component_metrics(hub)
        yield from _station_metrics(hub)


def _link_metrics(hub: Hub) -> Iterator[Metric]:
    is_open = GaugeMetricFamily("paramclient_link_open", "1 if the link is open.", labels=["link"])
    for link in hub.links.values():
        is_open.add_metric([link.name], link.state == "open")
    yield is_open
    opened = [(link.name, link.client) for link in hub.links.values() if link.client is not None]
    for name, text in _COUNTERS.items():
        counter = CounterMetricFamily(f"paramclient_link_{name}_total", text, labels=["link"])
        for link_name, client in opened:
            counter.add_metric([link_name], getattr(client, name))
        yield counter


def _component_metrics(hub: Hub) -> list[GaugeMetricFamily]:
    labels = ["link", "system", "component"]
    families = {
        name: GaugeMetricFamily(f"paramclient_component_{name}", text, labels=labels)
        for name, text in _GAUGES.items()
    }
    for target in hub.targets:
        component = target.component
        values = [target.link.name, str(component.system), str(component.component)]
        families["up"].add_metric(values, component.sync_state != "lost")
        families["synced"].add_metric(values, component.sync_state == "synced")
        families["parameters"].add_metric(values, len(component.params))
        if component.round_trip is not None:
            families["round_trip_seconds"].add_metric(values, component.round_trip)
    return list(families.values())


def _station_metrics(hub: Hub) -> Iterator[Metric]:
    number = GaugeMetricFamily("paramclient_stations", "Connected ground stations.", labels=["endpoint"])
    for endpoint in hub.gateway.endpoints:
        number.add_metric([endpoint.name], len(endpoint.stations))
    yield number
    for name, text in _STATION_COUNTERS.items():
        gauge = GaugeMetricFamily(f"paramclient_stations_{name}", text, labels=["endpoint"])
        for endpoint in hub.gateway.endpoints:
            gauge.add_metric([endpoint.name], sum(getattr(each, name) for each in endpoint.stations.values()))
        yield gauge
