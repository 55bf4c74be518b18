"""The sections about how the daemon fared: times, losses, cameras, wheels; what comes from the log is escaped here."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Final

from omnid.report.chart import ChartLine, Clock, chart, line
from omnid.report.page import facts, grid, note, table
from omnid.report.report_data import ReportData
from omnid.report.statuses import ODOMETRY, STAGE, SUMMARY, StatusHistory, short

_FLOW: Final = ("pair", "dewarp", "stereo", "odometry", "mapping", "record")  # whose times are drawn
_TIMES: Final = ("work_p50_ms", "work_p99_ms", "work_max_ms")
_NO_STATUS: Final = ("No reports of the daemon's parts are in this log, so rates, times of stages, latencies, drops "
                     "and camera faults are not known; omnid's own recordings hold them.")


def timing(recording: ReportData, clock: Clock) -> list[str]:
    """Rates, latencies and the stages' times."""
    statuses = recording.statuses
    if not statuses.reports:
        return ["<h2>Times and losses</h2>", *_summary(statuses), note(_NO_STATUS)]
    if statuses.reports == 1:  # a replay: it counts up at its end
        return ["<h2>Times and losses</h2>", *_summary(statuses), _stage_table(statuses)]
    p50, p99 = (statuses.series(ODOMETRY, f"capture_to_pose_{p}_ms") for p in ("p50", "p99"))
    stages = [name for name in _FLOW if statuses.series(STAGE + name, "work_p50_ms").count]
    figures = [
        chart("Poses a second", [line("", statuses.series(ODOMETRY, "rate_hz"))], clock, zero=True),
        chart("Age of the newest pose at each report", [line("", statuses.series(ODOMETRY, "age_s"))], clock,
              unit="s", zero=True),
        chart("From the image to its pose", [line("median", p50), line("99 of 100", p99)], clock, unit="ms",
              zero=True, note="Of all poses from the start of the run until then."),
        chart("Median work of a stage", [line(name, statuses.series(STAGE + name, "work_p50_ms")) for name in stages],
              clock, unit="ms", log=True, note="Of all messages from the start of the run until then."),
        chart("Messages dropped, deadlines missed, so far", _losses(statuses), clock, zero=True)]
    return ["<h2>Times and losses</h2>", *_summary(statuses), _stage_table(statuses), grid(figures)]


def _losses(statuses: StatusHistory) -> list[ChartLine]:
    found = [(statuses.series(STAGE + name, key), f"{name}, {key}") for name, _ in statuses.stages()
             for key in ("dropped", "missed")]
    worst = sorted((course.newest, name, course) for course, name in found if course.newest > 0)[::-1][:6]
    return [line(name, course) for _, name, course in worst]


def _stage_table(statuses: StatusHistory) -> str:
    rows = [(escape(name), *(escape(values.get(key, "")) for key in ("processed", "rate_hz")),
             _lost(values), *(number(values.get(key, "")) for key in _TIMES)) for name, values in statuses.stages()]
    head = ("stage", "messages", "per second, last", "dropped or missed", "p50 ms", "p99 ms", "max ms")
    remark = "<small>At the last report. The work of a camera's stage is its wait for the next image.</small>"
    return f"<div class='scroll'>{table(head, rows)}</div>{remark}" if rows else ""


def _lost(values: Mapping[str, str]) -> str:
    found = values.get("dropped", values.get("missed", ""))
    return f"<b>{escape(found)}</b>" if found not in ("", "0") else escape(found)


def _summary(statuses: StatusHistory) -> list[str]:
    """What a replay counted up at its end."""
    rows = [(escape(name), escape(value)) for name, value in statuses.values(SUMMARY).items()]
    return ["<p>Counted at the end of the run:</p>", facts(rows)] if rows else []


def parts(recording: ReportData, clock: Clock) -> list[str]:
    """Cameras, pairing and wheels: counters at the end, and rates."""
    statuses = recording.statuses
    names = [name for name in statuses.newest if name not in (ODOMETRY, SUMMARY) and not name.startswith(STAGE)]
    if not names:
        return []
    rows = [(escape(short(name)), escape(statuses.newest[name].message),
             ", ".join(f"{escape(key)} {escape(value)}" for key, value in statuses.values(name).items()))
            for name in names]
    rates = [line(short(name), statuses.series(name, "rate_hz")) for name in names
             if statuses.series(name, "rate_hz").count]
    late = [line(name, statuses.series("omnid: wheels", f"{key}_ms")) for name, key in
            (("99 of 100", "tick_late_p99"), ("the worst", "tick_late_max"))]
    figures = [chart("Images a second", rates, clock, zero=True),
               chart("Lateness of the wheels' tick, so far", late, clock, unit="ms", zero=True)]
    return ["<h2>Cameras, pairing, wheels</h2>", "<div class='words scroll'>",
            table(("part", "at the last report", "counters then"), rows), "</div>", grid(figures)]


def number(told: str) -> str:
    """A number as the daemon told it, a little shorter."""
    try:
        return f"{float(told):.3g}" if float(told) < 100 else f"{float(told):.0f}"
    except ValueError:
        return ""
