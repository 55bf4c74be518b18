"""Metrics for Prometheus."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import SimpleNamespace
from typing import Any, Final

from prometheus_client import Metric, generate_latest
from prometheus_client.core import CounterMetricFamily as Counter
from prometheus_client.core import GaugeMetricFamily as Gauge

from omnid.engine.telemetry import Histogram
from omnid.monitor.robot_state import RobotState
from omnid.plain_text import MOST_ENTRIES, plain
from omnid.tracking_state import TrackingState
from omnid.transport.status_names import number, short_name
from omnid.web.feed import LONGEST_VALUE

_TEXTS: Final = {
    "dropped": "Messages of the robot that the inbox dropped",
    "stops": "Stops asked for",
    "arms": "Requests to arm",
}
Samples = Iterable[tuple[tuple[str, ...], float]]  # values of the labels, and the value


def metrics(state: RobotState, refused: Mapping[str, int], counts: Mapping[str, int]) -> bytes:
    """Return all metrics as text; refused: requests by reason; counts: further counters, by name."""
    samples = (((reason,), count) for reason, count in refused.items())
    families = [
        *_of_robot(state),
        *(Counter(f"omnid_web_{name}", _TEXTS[name], count) for name, count in counts.items()),
        _labelled(Counter, "omnid_web_refused", "Requests that were refused", ["reason"], samples),
    ]
    registry: Any = SimpleNamespace(collect=lambda: families)
    return generate_latest(registry)


def _of_robot(state: RobotState) -> Iterator[Metric]:
    yield _gauge("omnid_up", "1 if the daemon's token is on the bus", float(state.alive is True))
    yield _gauge("omnid_pose_rate_hz", "Poses received per second", state.rate_hz)
    yield Counter("omnid_poses", "Poses received", state.poses)
    yield Counter("omnid_poses_missed", "Skipped sequence numbers", state.missed)
    yield Counter("omnid_messages_broken", "Messages that could not be decoded", state.broken)
    states = [((str(name),), float(state.state == name)) for name in TrackingState]
    yield _labelled(Gauge, "omnid_tracking_state", "1 for the state of the newest pose", ["state"], states)
    yield _quantiles("omnid_pose_age_seconds", "From the images to the arrival of a pose", state.age)
    yield _quantiles("omnid_network_seconds", "From the robot's network to the arrival of a pose", state.network)
    levels = [((short_name(part.name),), part.level) for part in state.statuses.values()]
    yield _labelled(Gauge, "omnid_status_level", "0 good, 1 warning, 2 error, 3 stale", ["part"], levels)
    values = [
        ((short_name(part.name), key), value)
        for part in state.statuses.values()
        for key, text in list(part.values.items())[:MOST_ENTRIES]
        if (value := number(text)) is not None
    ]
    yield _labelled(Gauge, "omnid_status_value", "Numbers of the status", ["part", "key"], values)


def _gauge(name: str, text: str, value: float) -> Metric:
    return Gauge(name, text, value if math.isfinite(value) else None)


def _quantiles(name: str, text: str, histogram: Histogram) -> Metric:
    return _labelled(Gauge, name, text, ["quantile"], (((str(q),), histogram.p(q)) for q in (0.5, 0.99)))


def _labelled(
    kind: type[Gauge] | type[Counter], name: str, text: str, labels: Sequence[str], samples: Samples
) -> Metric:
    """Return a metric with a sample for each set of labels; those that are not finite or come again are left out."""
    found: dict[tuple[str, ...], float] = {}
    for given, value in samples:
        if math.isfinite(value):
            found.setdefault(tuple(plain(label)[:LONGEST_VALUE] for label in given), value)
    metric = kind(name, text, labels=labels)
    for given, value in found.items():
        metric.add_metric(given, value)
    return metric
