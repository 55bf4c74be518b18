"""Report sections about the daemon: times, losses, cameras, wheels. Text from the log is escaped here."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Final

from omnid.report.chart import ChartLine, Clock, chart, curve
from omnid.report.page import facts, grid, note, table
from omnid.report.report_data import ReportData
from omnid.report.status_history import StatusHistory
from omnid.transport import status_names
from omnid.transport.status_names import (
    CAPTURE_TO_POSE,
    ODOMETRY,
    STAGE_PREFIX,
    SUMMARY,
    TICK_LATE,
    WHEELS,
    WORK,
    Key,
    short_name,
    stage_name,
    time_key,
)

_STAGES: Final = ("pair", "dewarp", "stereo", "odometry", "mapping", "record")  # whose times are drawn
_MAX_LOSSES: Final = 6  # curves
_NO_STATUS: Final = (
    "The log holds no status of the daemon's parts, so rates, times of stages, latencies, drops and "
    "camera faults are unknown; omnid's own recordings hold it."
)


def timing(data: ReportData, clock: Clock) -> list[str]:
    """Return the section with rates, latencies and the stages' times."""
    statuses = data.statuses
    head = ["<h2>Times and losses</h2>", *_summary(statuses)]
    if not statuses.reports:
        return [*head, note(_NO_STATUS)]
    if statuses.reports == 1:  # a replay, which reports at its end only
        return [*head, _stage_table(statuses)]
    p50, p99 = (statuses.series(ODOMETRY, time_key(CAPTURE_TO_POSE, p)) for p in ("p50", "p99"))
    work = {name: statuses.series(stage_name(name), time_key(WORK, "p50")) for name in _STAGES}
    figures = [
        chart("Poses per second", [curve("", statuses.series(ODOMETRY, Key.RATE_HZ))], clock, zero=True),
        chart(
            "Age of the newest pose at each report",
            [curve("", statuses.series(ODOMETRY, Key.AGE_S))],
            clock,
            unit="s",
            zero=True,
        ),
        chart(
            "From the image to its pose",
            [curve("median", p50), curve("99th percentile", p99)],
            clock,
            unit="ms",
            zero=True,
            note="Of all poses since the start of the run.",
        ),
        chart(
            "Median work of a stage",
            [curve(name, series) for name, series in work.items() if series.count],
            clock,
            unit="ms",
            log=True,
            note="Of all messages since the start of the run.",
        ),
        chart("Messages dropped, deadlines missed, so far", _losses(statuses), clock, zero=True),
    ]
    return [*head, _stage_table(statuses), grid(figures)]


def _losses(statuses: StatusHistory) -> list[ChartLine]:
    found = [
        (statuses.series(stage_name(name), key), f"{name}, {key}")
        for name, _ in statuses.stages()
        for key in (Key.DROPPED, Key.MISSED)
    ]
    worst = sorted((series.newest, name, series) for series, name in found if series.newest > 0)[::-1]
    return [curve(name, series) for _, name, series in worst[:_MAX_LOSSES]]


def _stage_table(statuses: StatusHistory) -> str:
    rows = [
        (
            escape(name),
            *(escape(values.get(key, "")) for key in (Key.PROCESSED, Key.RATE_HZ)),
            _lost(values),
            *(rounded(values.get(time_key(WORK, statistic), "")) for statistic in ("p50", "p99", "max")),
        )
        for name, values in statuses.stages()
    ]
    head = ("stage", "messages", "per second, last", "dropped or missed", "p50 ms", "p99 ms", "max ms")
    footnote = "<small>At the last report. The work of a camera's stage is its wait for the next image.</small>"
    return f"<div class='scroll'>{table(head, rows)}</div>{footnote}" if rows else ""


def _lost(values: Mapping[str, str]) -> str:
    found = values.get(Key.DROPPED, values.get(Key.MISSED, ""))
    return f"<b>{escape(found)}</b>" if found not in ("", "0") else escape(found)


def _summary(statuses: StatusHistory) -> list[str]:
    """Return the counters that a replay reports at its end."""
    rows = [(escape(name), escape(value)) for name, value in statuses.values(SUMMARY).items()]
    return ["<p>Counters at the end of the run:</p>", facts(rows)] if rows else []


def parts(data: ReportData, clock: Clock) -> list[str]:
    """Return the section with cameras, pairing and wheels: counters at the end, and rates."""
    statuses = data.statuses
    names = [name for name in statuses.newest if name not in (ODOMETRY, SUMMARY) and not name.startswith(STAGE_PREFIX)]
    if not names:
        return []
    rows = [
        (
            escape(short_name(name)),
            escape(statuses.newest[name].message),
            ", ".join(f"{escape(key)} {escape(value)}" for key, value in statuses.values(name).items()),
        )
        for name in names
    ]
    rates = [
        curve(short_name(name), statuses.series(name, Key.RATE_HZ))
        for name in names
        if statuses.series(name, Key.RATE_HZ).count
    ]
    late = [
        curve(title, statuses.series(WHEELS, time_key(TICK_LATE, statistic)))
        for title, statistic in (("99th percentile", "p99"), ("maximum", "max"))
    ]
    figures = [
        chart("Images per second", rates, clock, zero=True),
        chart("Lateness of the wheels' tick, so far", late, clock, unit="ms", zero=True),
    ]
    return [
        "<h2>Cameras, pairing, wheels</h2>",
        "<div class='words scroll'>",
        table(("part", "at the last report", "counters"), rows),
        "</div>",
        grid(figures),
    ]


def rounded(text: str) -> str:
    """Return a number with fewer digits; "" for a text that is no number."""
    value = status_names.number(text)
    if value is None:
        return ""
    return f"{value:.3g}" if value < 100 else f"{value:.0f}"
