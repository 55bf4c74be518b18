"""Report sections about the robot, each a list of HTML. Text from the log is escaped here."""

from __future__ import annotations

import math
from collections.abc import Iterator
from html import escape
from typing import Final

from omnid.recordings.recording_reader import DRIVE, TWIST_COMMAND
from omnid.report.chart import ChartLine, Clock, chart, curve
from omnid.report.downsampling import Downsampled
from omnid.report.events import Event, Events
from omnid.report.health import rounded
from omnid.report.page import facts, grid, note, table
from omnid.report.poses import STATES, UNKNOWN
from omnid.report.report_data import ReportData
from omnid.report.svg import label
from omnid.report.truth_comparison import TruthComparison
from omnid.transport.status_names import CAPTURE_TO_POSE, ODOMETRY, PLACES, Key, time_key

_LEVELS: Final = ("", "warning", "error")
_MAX_SOURCES: Final = 20  # Most sources that are named of the events that were left out.
_MAX_LANDMARK_COUNTS: Final = 12
_SAME_PATH_M: Final = 0.01  # Paths that differ by less are drawn as one.


def key_figures(data: ReportData) -> str:
    """Return the key figures of the run."""
    poses, statuses = data.poses, data.statuses
    rate_hz = (poses.poses - 1) / poses.end_s if poses.end_s > 0 else math.nan
    tiles = [
        ("duration", _duration(poses.end_s)),
        ("path", f"{poses.length_m:.2f} m"),
        ("poses", f"{poses.poses}, {rate_hz:.1f}/s" if rate_hz > 0 else str(poses.poses)),
        *_shares(data),
    ]
    p50, p99 = (rounded(statuses.values(ODOMETRY).get(time_key(CAPTURE_TO_POSE, p), "")) for p in ("p50", "p99"))
    if p50:
        tiles.append(("image to pose, p50 / p99", f"{p50} / {p99} ms"))
    cells = "".join(f"<div><b>{escape(value)}</b><span>{escape(name)}</span></div>" for name, value in tiles)
    return f"<div class='numbers'>{cells}</div>"


def _shares(data: ReportData) -> Iterator[tuple[str, str]]:
    poses = data.poses
    if poses.states[UNKNOWN] < poses.poses:
        known = poses.poses - poses.states[UNKNOWN]
        for rank, name in enumerate(STATES):
            yield name, _share(poses.states[rank], known)
        yield "resets", str(data.statuses.resets)


def _share(count: int, total: int) -> str:
    """Return the share in per cent; a small one is not rounded to 0, a large one not to 100."""
    if count in (0, total):
        return "always" if count else "never"
    percent = 100 * count / total
    if percent < 0.1:
        return "< 0.1 %"
    return f"{percent:.1f} %" if percent <= 99.9 else "> 99.9 %"


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.1f} min" if seconds < 7200 else f"{seconds / 3600:.2f} h"


def events_table(events: Events, clock: Clock) -> list[str]:
    """Return the table of events in the order of time."""
    found = events.in_order()
    if not found:
        return ["<p>No events: no change of state, no gap, no loss.</p>"]
    rows = [
        (_time_text(event, clock), _LEVELS[event.level], escape(event.source), escape(_event_text(event)))
        for event in found
    ]
    count = events.left_out.total()
    by_source = ", ".join(f"{source}: {count}" for source, count in events.left_out.most_common(_MAX_SOURCES))
    more = [note(f"and {count} more: {by_source}")] if count else []
    return ["<div class='events'>", table(("time", "", "part", "event (count)"), rows), "</div>", *more]


def _time_text(event: Event, clock: Clock) -> str:
    """Return the time in seconds, or as h:mm:ss where the charts are in minutes or hours."""
    in_seconds = clock.unit[1] == "s"
    start, end = (f"{at_s:.2f}" if in_seconds else _hms(at_s) for at_s in (event.start_s, event.end_s))
    span = start if start == end else f"{start} to {end}"
    return f"{span} s" if in_seconds else span


def _hms(seconds: float) -> str:
    sign, whole = "-" if seconds < 0 else "", abs(seconds)
    return f"{sign}{int(whole // 3600)}:{int(whole // 60) % 60:02}:{whole % 60:04.1f}"


def _event_text(event: Event) -> str:
    return f"{event.text} ({event.count})" if event.count else event.text


def motion(data: ReportData, clock: Clock) -> list[str]:
    """Return the section with speed, yaw rate and height, and the commands."""
    series, drives = data.poses.series, data.drives
    speed, yaw_rate = [curve("measured", series["speed"])], [curve("measured", series["yaw_rate"])]
    for topic, name in ((DRIVE, "sent to the wheels"), (TWIST_COMMAND, "commanded")):
        if topic in drives:
            speed.append(curve(name, drives[topic].speed))
            yaw_rate.append(curve(name, drives[topic].yaw_rate))
    figures = [
        chart("Forward speed", speed, clock, unit="m/s", zero=True),
        chart("Yaw rate, to the left", yaw_rate, clock, unit="deg/s", zero=True),
        chart("Height of the robot", [curve("", series["height"])], clock, unit="m"),
    ]
    missing = [] if drives else [note("The log holds no commands to the wheels (…/drive, …/cmd/twist).")]
    return ["<h2>Motion</h2>", grid(figures), *missing]


def uncertainty(data: ReportData, clock: Clock) -> list[str]:
    """Return the section with the standard deviations of the covariances, and the landmarks."""
    series, statuses = data.poses.series, data.statuses
    tracked, inliers = (statuses.series(ODOMETRY, key) for key in (Key.TRACKED, Key.INLIERS))
    position, heading = [curve("", series["sigma_position"])], [curve("", series["sigma_heading"])]
    figures = [
        chart("Standard deviation of the position, all axes", position, clock, unit="m", log=True),
        chart("Standard deviation of the heading", heading, clock, unit="deg", log=True),
    ]
    missing = [] if any(figures) else [note("The covariances in the log are zero or negative: they were not set.")]
    if tracked.count > 2 and statuses.reports:
        figures.append(
            chart(
                "Landmarks",
                [curve("tracked", tracked), curve("inliers of the pose", inliers)],
                clock,
                zero=True,
                note="One value per report, not per pose.",
            )
        )
    else:
        missing.append(note(_few_landmarks(tracked, inliers)))
    return ["<h2>Uncertainty</h2>", grid(figures), *missing]


def path_in_map(data: ReportData) -> list[tuple[float, float]]:
    """Return the path in the map; empty where it is that of odometry, to a hundredth of a metre."""
    history = data.map_poses
    if max((moved_m for _, moved_m in history.moved_m.points()), default=0.0) < _SAME_PATH_M:
        return []
    return [(corner.x_m, corner.y_m) for corner in history.path.with_end()]


def in_map(data: ReportData, clock: Clock) -> list[str]:
    """Return the section with the map of places: its sizes, and the correction of odometry, where there was one."""
    history, statuses = data.map_poses, data.statuses
    if not path_in_map(data):
        return []
    values = statuses.values(PLACES)
    rows = [(escape(name.replace("_", " ")), escape(value)) for name, value in values.items()]
    loops, keyframes = (statuses.series(PLACES, name) for name in ("loops", "keyframes"))
    figures = [
        chart(
            "From odometry's position to that in the map",
            [curve("", history.moved_m)],
            clock,
            unit="m",
            zero=True,
            note="The correction map -> odom, where the robot is: odom itself does not jump.",
        ),
        chart(
            "From odometry's heading to that in the map", [curve("", history.turned_deg)], clock, unit="deg", zero=True
        ),
        chart(
            "Standard deviation of the position in the map, all axes",
            [curve("", history.sigma_m)],
            clock,
            unit="m",
            log=True,
        ),
        chart("Keyframes and loops", [curve("keyframes", keyframes), curve("loops", loops)], clock, zero=True),
    ]
    return ["<h2>In the map</h2>", *([facts(rows)] if rows else []), grid(figures)]


def _few_landmarks(tracked: Downsampled, inliers: Downsampled) -> str:
    if not tracked.count:
        return "The log holds no numbers of landmarks."
    points = list(zip(inliers.points(), tracked.points(), strict=False))[:_MAX_LANDMARK_COUNTS]
    counts = ", ".join(f"{count:.0f} of {total:.0f} at {label(round(t_s, 2))} s" for (t_s, count), (_, total) in points)
    return f"Landmarks are reported only where the state changes; inliers of the pose: {counts}."


def truth(comparison: TruthComparison, clock: Clock) -> list[str]:
    """Return the section with the errors of the path."""
    m = comparison.metrics
    ratio = "" if math.isnan(m.length_error_ratio) else f" ({100 * m.length_error_ratio:+.3f} %)"
    rows = [
        ("compared poses", f"{m.pairs}, {m.coverage:.1%} of the truth"),
        ("length", f"{m.length_estimate_m:.4f} m, true {m.length_truth_m:.4f} m{ratio}"),
        ("position (ATE)", f"rmse {_mm(m.ate_rmse_m)}, maximum {_mm(m.ate_max_m)}, at the end {_mm(m.end_error_m)}"),
        (
            "heading",
            f"rmse {_deg(m.heading_rmse_rad)}, maximum {_deg(m.heading_max_rad)}, at the end {_deg(m.heading_end_rad)}",
        ),
        ("from pose to pose (RPE)", f"rmse {_mm(m.rpe_translation_rmse_m)}, {_deg(m.rpe_rotation_rmse_rad)}"),
    ]
    heading = [(t, math.degrees(rad)) for t, rad in comparison.heading_rad.points()]
    position = [(t, 1e3 * error_m) for t, error_m in comparison.position_m.points()]
    figures = [
        chart("Error of the position", [ChartLine("", position)], clock, unit="mm", zero=True),
        chart("Error of the heading, to the left", [ChartLine("", heading)], clock, unit="deg", zero=True),
    ]
    footnote = "<small>Of the rig; the first pose is aligned and nothing else, as `omnid eval` does.</small>"
    return ["<h2>Against the truth</h2>", facts(rows), footnote, grid(figures)]


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.2f} mm" if abs(metres) < 1 else f"{metres:.3f} m"


def _deg(rad: float) -> str:
    return f"{math.degrees(rad):.3f}°"
