"""Metrics in the text format of Prometheus (exposition format 0.0.4)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Final

from omnid.engine.telemetry import Histogram
from omnid.monitor.robot_state import RobotState
from omnid.plain_text import plain
from omnid.tracking_state import TrackingState
from omnid.transport.status_names import number, short_name
from omnid.web.browsers import Browsers
from omnid.web.snapshot import LONGEST_VALUE, MOST_VALUES

CONTENT_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"
_QUANTILES: Final = (0.5, 0.99)
_TEXTS: Final = {
    "dropped": "Messages of the robot that the inbox dropped",
    "stops": "Stops asked for",
    "arms": "Requests to arm",
}
Sample = tuple[Mapping[str, str], float]  # labels and value


def metrics(state: RobotState, browsers: Browsers, refused: Mapping[str, int], counts: Mapping[str, int]) -> str:
    """Return all metrics; refused: requests by reason; counts: further counters, by name."""
    return "".join(_lines(state, browsers, refused, counts))


def _lines(
    state: RobotState, browsers: Browsers, refused: Mapping[str, int], counts: Mapping[str, int]
) -> Iterator[str]:
    yield from _metric("omnid_up", "gauge", "1 if the daemon's token is on the bus", [({}, float(state.alive is True))])
    yield from _metric("omnid_pose_rate_hz", "gauge", "Poses received per second", [({}, state.rate_hz)])
    yield from _metric("omnid_poses_total", "counter", "Poses received", [({}, state.poses)])
    yield from _metric("omnid_poses_missed_total", "counter", "Skipped sequence numbers", [({}, state.missed)])
    yield from _metric(
        "omnid_messages_broken_total", "counter", "Messages that could not be decoded", [({}, state.broken)]
    )
    yield from _metric(
        "omnid_tracking_state",
        "gauge",
        "1 for the state of the newest pose",
        [({"state": str(name)}, float(state.state == name)) for name in TrackingState],
    )
    for name, text, histogram in (
        ("omnid_pose_age_seconds", "From the images to the arrival of a pose", state.age),
        ("omnid_network_seconds", "From the robot's network to the arrival of a pose", state.network),
    ):
        yield from _quantiles(name, text, histogram)
    yield from _metric(
        "omnid_status_level",
        "gauge",
        "0 good, 1 warning, 2 error, 3 stale",
        [({"part": short_name(part.name)}, part.level) for part in state.statuses.values()],
    )
    yield from _metric("omnid_status_value", "gauge", "Numbers of the status", _values(state))
    yield from _server(browsers, refused, counts)


def _server(browsers: Browsers, refused: Mapping[str, int], counts: Mapping[str, int]) -> Iterator[str]:
    for name, count in counts.items():
        yield from _metric(f"omnid_web_{name}_total", "counter", _TEXTS[name], [({}, count)])
    yield from _quantiles(
        "omnid_web_answer_seconds", "From a message to the answer of a browser that has drawn it", browsers.answer
    )
    yield from _metric("omnid_web_browsers", "gauge", "Open pages", [({}, len(browsers))])
    for name, text, label, counts in (
        ("omnid_web_sent_total", "Messages sent to browsers", "channel", browsers.sent),
        ("omnid_web_skipped_total", "Messages that a newer one replaced", "channel", browsers.skipped),
        ("omnid_web_closed_total", "Pages that were disconnected", "reason", browsers.closed),
        ("omnid_web_refused_total", "Requests that were refused", "reason", refused),
    ):
        yield from _metric(name, "counter", text, [({label: key}, count) for key, count in counts.items()])


def _quantiles(name: str, text: str, histogram: Histogram) -> Iterator[str]:
    yield from _metric(name, "gauge", text, [({"quantile": str(q)}, histogram.p(q)) for q in _QUANTILES])


def _values(state: RobotState) -> Iterator[Sample]:
    for part in state.statuses.values():
        for key, text in list(part.values.items())[:MOST_VALUES]:
            value = number(text)
            if value is not None:
                yield {"part": short_name(part.name), "key": key}, value


def _metric(name: str, kind: str, text: str, samples: Iterable[Sample]) -> Iterator[str]:
    """Yield a metric; values that are not finite and labels that were there before are left out."""
    yield f"# HELP {name} {text}\n# TYPE {name} {kind}\n"
    seen = set()
    for labels, value in samples:
        shown = ",".join(f'{key}="{_escaped(label)}"' for key, label in labels.items())
        if math.isfinite(value) and shown not in seen:
            seen.add(shown)
            yield f"{name}{{{shown}}} {value:.10g}\n" if shown else f"{name} {value:.10g}\n"


def _escaped(label: str) -> str:
    return plain(label)[:LONGEST_VALUE].replace("\\", r"\\").replace('"', r"\"")
