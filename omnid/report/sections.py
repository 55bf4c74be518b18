"""The sections about what the robot did, each a list of HTML; what comes from the log is escaped here."""

from __future__ import annotations

import math
from collections.abc import Iterator
from html import escape
from typing import Final

from omnid.report.chart import ChartLine, Clock, chart, line
from omnid.report.downsampling import Downsampled
from omnid.report.events import Event, Events
from omnid.report.health import number
from omnid.report.page import facts, grid, note, table
from omnid.report.poses import STATES
from omnid.report.report_data import ReportData
from omnid.report.statuses import ODOMETRY
from omnid.report.svg import label
from omnid.report.truth_comparison import TruthComparison

_LEVELS: Final = ("", "warning", "error")


def key_figures(recording: ReportData) -> str:
    """The run in a few numbers."""
    poses, statuses = recording.poses, recording.statuses
    rate_hz = (poses.poses - 1) / poses.end_s if poses.end_s > 0 else math.nan
    tiles = [("duration", _duration(poses.end_s)), ("path", f"{poses.length_m:.2f} m"),
             ("poses", f"{poses.poses}, {rate_hz:.1f}/s" if rate_hz > 0 else str(poses.poses)),
             *_shares(recording)]
    p50, p99 = (number(statuses.values(ODOMETRY).get(f"capture_to_pose_{p}_ms", "")) for p in ("p50", "p99"))
    if p50:
        tiles.append(("image to pose, p50 / p99", f"{p50} / {p99} ms"))
    cells = "".join(f"<div><b>{escape(value)}</b><span>{escape(name)}</span></div>" for name, value in tiles)
    return f"<div class='tiles'>{cells}</div>"


def _shares(recording: ReportData) -> Iterator[tuple[str, str]]:
    poses = recording.poses
    if poses.states[-1] < poses.poses:
        told = poses.poses - poses.states[-1]
        for rank, name in enumerate(STATES):
            count = poses.states[rank]
            yield name, _share(count, told)
        yield "resets", str(recording.statuses.resets)


def _share(count: int, of: int) -> str:
    """Per cent, such that what happened at all does not look like never."""
    if count in (0, of):
        return "always" if count else "never"
    percent = 100 * count / of
    return f"{percent:.1f} %" if 0.1 <= percent <= 99.9 else "< 0.1 %" if percent < 0.1 else "> 99.9 %"


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.1f} min" if seconds < 7200 else f"{seconds / 3600:.2f} h"


def events_table(events: Events, clock: Clock) -> list[str]:
    """What happened, in the order of time."""
    found = events.in_order()
    if not found:
        return ["<p>Nothing: no change of state, no gap, no loss.</p>"]
    rows = [(_when(event, clock), _LEVELS[event.level], escape(event.source), escape(_what(event))) for event in found]
    beyond = sum(events.beyond.values())
    said = ", ".join(f"{source}: {count}" for source, count in events.beyond.most_common(20))
    more = [note(f"and {beyond} more: {said}")] if beyond else []
    return ["<div class='events'>", table(("when", "", "who", "what (how often)"), rows), "</div>", *more]


def _when(event: Event, clock: Clock) -> str:
    """In seconds, or as h:mm:ss where the charts are in minutes or hours."""
    short = clock.unit[1] == "s"
    start, end = (f"{at:.2f}" if short else _hms(at) for at in (event.start_s, event.end_s))
    said = start if start == end else f"{start} to {end}"
    return f"{said} s" if short else said


def _hms(seconds: float) -> str:
    sign, whole = "-" if seconds < 0 else "", abs(seconds)
    return f"{sign}{int(whole // 3600)}:{int(whole // 60) % 60:02}:{whole % 60:04.1f}"


def _what(event: Event) -> str:
    return f"{event.text} ({event.count})" if event.count else event.text


def motion(recording: ReportData, clock: Clock) -> list[str]:
    """Speed, yaw rate and height; what the wheels were told along with it."""
    course, drives = recording.poses.course, recording.drives
    speed, yaw_rate = [line("measured", course["speed"])], [line("measured", course["yaw_rate"])]
    for kind, name in (("told", "told to the wheels"), ("asked", "asked of the robot")):
        if kind in drives:
            speed.append(line(name, drives[kind].speed))
            yaw_rate.append(line(name, drives[kind].yaw_rate))
    figures = [chart("Forward speed", speed, clock, unit="m/s", zero=True),
               chart("Yaw rate, to the left", yaw_rate, clock, unit="deg/s", zero=True),
               chart("Height of the robot", [line("", course["height"])], clock, unit="m")]
    missing = [] if drives else [note("The log holds no commands to the wheels (…/drive, …/cmd/twist).")]
    return ["<h2>Motion</h2>", grid(figures), *missing]


def sureness(recording: ReportData, clock: Clock) -> list[str]:
    """Deviations out of the covariances, and the landmarks."""
    course, statuses = recording.poses.course, recording.statuses
    found, agree = (statuses.series(ODOMETRY, name) for name in ("found", "agree"))
    position, heading = [line("", course["sigma_position"])], [line("", course["sigma_heading"])]
    figures = [chart("Standard deviation of the position, all axes", position, clock, unit="m", log=True),
               chart("Standard deviation of the heading", heading, clock, unit="deg", log=True)]
    missing = [] if any(figures) else [note("The covariances in the log are zero or negative: nobody set them.")]
    if found.count > 2 and statuses.reports:
        figures.append(chart("Landmarks", [line("found", found), line("that agree with the pose", agree)], clock,
                             zero=True, note="Once for each report, not for each pose."))
    else:
        missing.append(note(_few_landmarks(found, agree)))
    return ["<h2>How sure it is</h2>", grid(figures), *missing]


def _few_landmarks(found: Downsampled, agree: Downsampled) -> str:
    if not found.count:
        return "The log holds no numbers of landmarks."
    told = ", ".join(f"{a:.0f} of {f:.0f} at {label(round(t, 2))} s" for (t, a), (_, f) in
                     list(zip(agree.points(), found.points(), strict=False))[:12])
    return f"Landmarks that agree with the pose are told only where the state changes: {told}."


def truth(comparison: TruthComparison, clock: Clock) -> list[str]:
    """How far the path is from the true one."""
    m = comparison.metrics
    ratio = "" if math.isnan(m.length_error_ratio) else f" ({100 * m.length_error_ratio:+.3f} %)"
    rows = [("compared poses", f"{m.pairs}, {m.coverage:.1%} of the truth"),
            ("length", f"{m.length_estimate_m:.4f} m, true {m.length_truth_m:.4f} m{ratio}"),
            ("position (ATE)", f"rmse {_mm(m.ate_rmse_m)}, most {_mm(m.ate_max_m)}, at the end {_mm(m.end_error_m)}"),
            ("heading", f"rmse {_deg(m.heading_rmse_rad)}, most {_deg(m.heading_max_rad)}, at the end "
             f"{_deg(m.heading_end_rad)}"),
            ("from pose to pose (RPE)", f"rmse {_mm(m.rpe_translation_rmse_m)}, {_deg(m.rpe_rotation_rmse_rad)}")]
    heading = [(t, math.degrees(rad)) for t, rad in comparison.heading_rad.points()]
    position = [(t, 1e3 * error_m) for t, error_m in comparison.position_m.points()]
    figures = [chart("Error of the position", [ChartLine("", position)], clock, unit="mm", zero=True),
               chart("Error of the heading, to the left", [ChartLine("", heading)], clock, unit="deg", zero=True)]
    remark = "<small>Of the rig; the first pose is aligned and nothing else, as `omnid eval` does.</small>"
    return ["<h2>Against the truth</h2>", facts(rows), remark, grid(figures)]


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.2f} mm" if abs(metres) < 1 else f"{metres:.3f} m"


def _deg(rad: float) -> str:
    return f"{math.degrees(rad):.3f}°"
