"""Numbers for Prometheus, in its text format 0.0.4 (Prometheus documentation, "Exposition formats")."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Final

from paramclient.version import __version__

if TYPE_CHECKING:
    from paramclient.service.hub import Hub

__all__ = ["MEDIA_TYPE", "metrics_text"]

MEDIA_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"

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
_STATES: Final = ("opening", "open", "away", "failed", "ended")


def metrics_text(hub: Hub) -> str:
    """All of them, as they are now."""
    lines: list[str] = []

    def add(name: str, kind: str, help_: str, samples: Iterable[tuple[Mapping[str, object], float]]) -> None:
        full = f"paramclient_{name}"
        lines.extend((f"# HELP {full} {help_}", f"# TYPE {full} {kind}"))
        lines.extend(f"{full}{_labels(labels)} {value}" for labels, value in samples)

    held = list(hub.lines.values())
    add("info", "gauge", "The version.", [({"version": __version__}, 1)])
    add("uptime_seconds", "gauge", "Seconds since the service began.", [({}, round(hub.age, 3))])
    add("events_total", "counter", "Events that were told.", [({}, hub.feed.seq)])
    add("listeners", "gauge", "Streams of events that are open.", [({}, hub.feed.listeners)])
    running = sum(job.state == "running" for job in hub.jobs.all)
    add("jobs_running", "gauge", "Fetches and set-ups under way.", [({}, running)])
    add(
        "link_state",
        "gauge",
        "1 for the state that the link is in.",
        [
            ({"link": line.name, "state": state}, int(line.state == state))
            for line in held
            for state in _STATES
        ],
    )
    add(
        "link_openings_total",
        "counter",
        "How often the link was opened with nothing known of it.",
        [({"link": line.name}, line.openings) for line in held],
    )
    counted = [(line.name, line.client.stats) for line in held if line.client is not None]
    for name, help_ in _COUNTERS.items():
        samples = [({"link": link}, getattr(stats, name)) for link, stats in counted]
        add(f"link_{name}_total", "counter", help_, [each for each in samples if each[1] is not None])
    everyone = [({"link": each.line.name, **_address(each.address)}, each) for each in hub.followed]
    add(
        "component_up",
        "gauge",
        "1 while the component is heard, and its link is open.",
        [
            (labels, int(each.line.state == "open" and each.component.state != "lost"))
            for labels, each in everyone
        ],
    )
    add(
        "component_synced",
        "gauge",
        "1 while its table is known to be the vehicle's.",
        [
            (labels, int(each.line.state == "open" and each.component.sync_state == "synced"))
            for labels, each in everyone
        ],
    )
    add(
        "component_parameters",
        "gauge",
        "Parameters that are known.",
        [(labels, len(each.component.params)) for labels, each in everyone],
    )
    add(
        "component_round_trip_seconds",
        "gauge",
        "The measured round trip, smoothed.",
        [
            (labels, each.component.round_trip)
            for labels, each in everyone
            if each.component.round_trip is not None
        ],
    )
    return "\n".join(lines) + "\n"


def _address(address: tuple[int, int]) -> dict[str, object]:
    return {"system": address[0], "component": address[1]}


def _labels(labels: Mapping[str, object]) -> str:
    told = ",".join(f'{name}="{_escaped(str(value))}"' for name, value in labels.items())
    return f"{{{told}}}" if told else ""


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
