"""Metrics of the service for Prometheus, rendered by prometheus_client in the text format 0.0.4."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Final

import anyio.lowlevel
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from paramclient.service.link import COMPONENTS_PER_TURN
from paramclient.version import __version__

if TYPE_CHECKING:
    from paramclient.service.hub import Hub

__all__ = ["METRICS_MEDIA_TYPE", "metrics_text"]

METRICS_MEDIA_TYPE: Final = CONTENT_TYPE_PLAIN_0_0_4
"""Media type of the metrics."""

_COUNTERS: Final = {
    "bytes_received": "Received bytes.",
    "bytes_sent": "Sent bytes.",
    "frames_received": "Received complete frames.",
    "frames_sent": "Sent frames.",
    "skipped": "Received bytes outside of frames.",
    "damaged": "Received frames with a checksum error.",
    "unusable_names": "Dropped messages whose parameter name no parameter file can contain.",
    "lost": "Lost frames, by sequence numbers.",
    "repeated": "Repeated frames.",
    "reads": "Parameters read individually.",
    "writes": "Parameters written.",
    "retries": "Retries of reads and writes.",
    "downloads": "Fetches that downloaded the table.",
    "cache_hits": "Fetches with a matching hash of the cached table.",
}
"""Help texts of the counters of a link, by attribute of its statistics."""
_COMPONENT_GAUGES: Final = {
    "up": "1 if the link is open and the component is not lost.",
    "synced": "1 if the table matches that of the vehicle.",
    "parameters": "Parameters in the table.",
    "round_trip_seconds": "Smoothed round-trip time in seconds.",
}
"""Help texts of the gauges of a component."""
_STATES: Final = ("opening", "open", "reconnecting", "failed", "ended")
"""States of a link."""


async def metrics_text(hub: Hub) -> bytes:
    """Return the current metrics. They are collected in parts, and rendered in a thread."""
    families = [*_hub_metrics(hub), *_link_metrics(hub), *await _component_metrics(hub)]
    registry = CollectorRegistry()  # not the library's global one, which has metrics of the process
    registry.register(_Families(families))
    return await hub.encode_in_thread(lambda: generate_latest(registry))


class _Families(Collector):
    """Collected metrics."""

    def __init__(self, families: Iterable[Metric]) -> None:
        self._families = families

    def collect(self) -> Iterable[Metric]:
        return self._families


def _hub_metrics(hub: Hub) -> Iterator[Metric]:
    info = GaugeMetricFamily("paramclient_info", "Version of paramclient.", labels=["version"])
    info.add_metric([__version__], 1)
    yield info
    uptime = round(hub.uptime, 3)
    yield GaugeMetricFamily("paramclient_uptime_seconds", "Seconds since the start of the service.", uptime)
    yield CounterMetricFamily("paramclient_events_total", "Published events.", hub.feed.seq)
    listeners = hub.feed.listeners
    yield GaugeMetricFamily("paramclient_listeners", "Open event streams.", listeners)
    running = sum(job.state == "running" for job in hub.jobs.all)
    yield GaugeMetricFamily("paramclient_jobs_running", "Running fetches and set-ups.", running)


def _link_metrics(hub: Hub) -> Iterator[Metric]:
    links = list(hub.links.values())
    states = GaugeMetricFamily(
        "paramclient_link_state", "1 for the current state of the link.", labels=["link", "state"]
    )
    openings = CounterMetricFamily(
        "paramclient_link_openings_total",
        "Clients opened for the link.",
        labels=["link"],
    )
    for link in links:
        openings.add_metric([link.name], link.openings)
        for state in _STATES:
            states.add_metric([link.name, state], link.state == state)
    yield states
    yield openings
    counted = [(link.name, link.client.stats) for link in links if link.client is not None]
    for name, help_ in _COUNTERS.items():
        counter = CounterMetricFamily(f"paramclient_link_{name}_total", help_, labels=["link"])
        for link_name, stats in counted:
            if (count := getattr(stats, name)) is not None:
                counter.add_metric([link_name], count)
        yield counter


async def _component_metrics(hub: Hub) -> list[GaugeMetricFamily]:
    up, synced, parameters, round_trip = families = [
        GaugeMetricFamily(f"paramclient_component_{name}", help_, labels=["link", "system", "component"])
        for name, help_ in _COMPONENT_GAUGES.items()
    ]
    for number, each in enumerate(hub.followed, 1):
        labels = [each.link.name, *map(str, each.address)]
        component, is_open = each.component, each.link.state == "open"
        up.add_metric(labels, is_open and component.state != "lost")
        synced.add_metric(labels, is_open and component.sync_state == "synced")
        parameters.add_metric(labels, len(component.params))
        if component.round_trip is not None:
            round_trip.add_metric(labels, component.round_trip)
        if not number % COMPONENTS_PER_TURN:
            await anyio.lowlevel.checkpoint()
    return families
