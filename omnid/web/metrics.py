"""Metrics for Prometheus: whether the robot is there, its poses, and every number of its status."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any

from prometheus_client import Metric, generate_latest
from prometheus_client.core import CounterMetricFamily as Counter
from prometheus_client.core import GaugeMetricFamily as Gauge

from omnid.monitor.robot_state import RobotState
from omnid.plain_text import MOST_ENTRIES, plain
from omnid.transport.status_names import number, short_name


def metrics(state: RobotState) -> bytes:
    """Return all metrics as text."""
    registry: Any = SimpleNamespace(collect=lambda: _of_robot(state))
    return generate_latest(registry)


def _of_robot(state: RobotState) -> Iterator[Metric]:
    yield Gauge("omnid_up", "1 if the daemon's token is on the bus", float(state.alive is True))
    yield Gauge("omnid_pose_rate_hz", "Poses received per second", state.rate_hz)
    yield Counter("omnid_poses", "Poses received", state.poses)
    yield Counter("omnid_poses_missed", "Skipped sequence numbers", state.missed)
    parts = list(state.statuses.values())
    levels = (((part.name,), part.level) for part in parts)
    yield _labelled("omnid_status_level", "0 good, 1 warning, 2 error, 3 stale", ["part"], levels)
    values = (
        ((part.name, key), value)
        for part in parts
        for key, text in list(part.values.items())[:MOST_ENTRIES]
        if (value := number(text)) is not None
    )
    yield _labelled("omnid_status_value", "Numbers of the status", ["part", "key"], values)


def _labelled(name: str, text: str, labels: Sequence[str], samples: Iterable[tuple[tuple[str, ...], float]]) -> Metric:
    """Return a metric with a sample for each set of labels; those that come again are left out."""
    found: dict[tuple[str, ...], float] = {}
    for given, value in samples:
        found.setdefault(tuple(plain(short_name(label)) for label in given), value)
    metric = Gauge(name, text, labels=labels)
    for given, value in found.items():
        metric.add_metric(given, value)
    return metric
