"""Metrics of the service for Prometheus, rendered by prometheus_client in the text format 0.0.4."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from paramclient.version import __version__

if TYPE_CHECKING:
    from paramclient.service.hub import Hub

__all__ = ["MEDIA_TYPE", "metrics_text"]

MEDIA_TYPE: Final = CONTENT_TYPE_PLAIN_0_0_4

_COUNTERS: Final = {
    "bytes_received": "Bytes that have come over the link.",
    "bytes_sent": "Bytes of the frames that were sent.",
    "frames_received": "Whole frames that have come.",
    "frames_sent": "Frames that were sent.",
    "skipped": "Bytes that belong to no frame.",
    "damaged": "Frames with a wrong checksum.",
    "unusable_names": "Messages left out, as no parameter file can hold the name in them.",
    "lost": "Frames that were lost on the way.",
    "repeated": "Frames that came twice.",
    "reads": "Parameters that were asked for one by one.",
    "writes": "Parameters that were written.",
    "retries": "Requests of these that were sent again.",
    "downloads": "Fetches that brought a whole table.",
    "cache_hits": "Fetches that the cache settled.",
}
_COMPONENT_GAUGES: Final = {
    "up": "1 while the component is heard, and its link is open.",
    "synced": "1 while its table is known to be the vehicle's.",
    "parameters": "Parameters that are known.",
    "round_trip_seconds": "The measured round trip, smoothed.",
}
_STATES: Final = ("opening", "open", "away", "failed", "ended")


def metrics_text(hub: Hub) -> bytes:
    """Return the metrics of the service as they are now."""
    registry = CollectorRegistry()  # not the library's global one, which has metrics of the process
    registry.register(_HubMetrics(hub))
    return generate_latest(registry)


class _HubMetrics(Collector):
    """Reads the metrics from a hub when Prometheus asks for them."""

    def __init__(self, hub: Hub) -> None:
        self._hub = hub

    def collect(self) -> Iterator[Metric]:
        hub = self._hub
        info = GaugeMetricFamily("paramclient_info", "The version.", labels=["version"])
        info.add_metric([__version__], 1)
        yield info
        uptime = round(hub.age, 3)
        yield GaugeMetricFamily("paramclient_uptime_seconds", "Seconds since the service began.", uptime)
        yield CounterMetricFamily("paramclient_events_total", "Events that were told.", hub.feed.seq)
        listeners = hub.feed.listeners
        yield GaugeMetricFamily("paramclient_listeners", "Streams of events that are open.", listeners)
        running = sum(job.state == "running" for job in hub.jobs.all)
        yield GaugeMetricFamily("paramclient_jobs_running", "Fetches and set-ups under way.", running)
        yield from self._link_metrics()
        yield from self._component_metrics()

    def _link_metrics(self) -> Iterator[Metric]:
        held = list(self._hub.lines.values())
        states = GaugeMetricFamily(
            "paramclient_link_state", "1 for the state that the link is in.", labels=["link", "state"]
        )
        openings = CounterMetricFamily(
            "paramclient_link_openings_total",
            "How often the link was opened with nothing known of it.",
            labels=["link"],
        )
        for line in held:
            openings.add_metric([line.name], line.openings)
            for state in _STATES:
                states.add_metric([line.name, state], line.state == state)
        yield states
        yield openings
        counted = [(line.name, line.client.stats) for line in held if line.client is not None]
        for name, help_ in _COUNTERS.items():
            counter = CounterMetricFamily(f"paramclient_link_{name}_total", help_, labels=["link"])
            for link, stats in counted:
                if (count := getattr(stats, name)) is not None:
                    counter.add_metric([link], count)
            yield counter

    def _component_metrics(self) -> Iterator[Metric]:
        up, synced, parameters, round_trip = families = [
            GaugeMetricFamily(f"paramclient_component_{name}", help_, labels=["link", "system", "component"])
            for name, help_ in _COMPONENT_GAUGES.items()
        ]
        for each in self._hub.followed:
            labels = [each.line.name, *map(str, each.address)]
            component, is_open = each.component, each.line.state == "open"
            up.add_metric(labels, is_open and component.state != "lost")
            synced.add_metric(labels, is_open and component.sync_state == "synced")
            parameters.add_metric(labels, len(component.params))
            if component.round_trip is not None:
                round_trip.add_metric(labels, component.round_trip)
        yield from families
