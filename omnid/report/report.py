"""The report of a recorded run: one self-contained HTML page. Text from the log is escaped where it enters HTML."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from html import escape
from itertools import islice, pairwise
from typing import Any, Final

import cv2
import numpy as np

from calib import se3
from calib.bounded_toml import parse_toml
from calib.errors import CalibError
from calib.models.names import model_in_words
from calib.panorama import fit_cylinder, remap_tables
from drivers.errors import DriverError
from drivers.logs.log_reader import LogReader
from drivers.logs.open_log import LogState
from drivers.logs.ros_messages import IMAGE_TYPES
from omnid.config import Config
from omnid.formats.plan import Lines, between, draw_ends, draw_plan, drawn_heights, sheet_of, write
from omnid.formats.tum import Trajectory
from omnid.recordings.evaluation import Metrics, associate, evaluate
from omnid.recordings.recording import DRIVE, TWIST_COMMAND
from omnid.report.charts import Array, Curve, chart, grid, style_and_script
from omnid.report.page import embedded, facts, figure, note, page, table
from omnid.report.recorded_run import STATES, UNKNOWN, Event, RecordedRun, root
from omnid.settings import dump
from omnid.stages.synchronise import Decoder
from omnid.transport import status_names
from omnid.transport.status_names import (
    CAPTURE_TO_POSE,
    ODOMETRY,
    PLACES,
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
from omnid.utc import utc
from omnid.version import __version__

MAX_BEFORE_S: Final = 30.0  # time before the first pose that is shown, where there are events in it
MAX_EVENTS, MAX_ROWS, MAX_CROSSES = 400, 60, 40  # of the table of events, of other tables, of losses on the plan
# Of the path (BGR) and its width in px: the worse the state, the thicker.
PATH: Final = {UNKNOWN: ((60, 60, 60), 3), 0: ((60, 60, 60), 3), 1: ((0, 159, 230), 5), 2: ((0, 94, 213), 7)}
TRUTH_COLOUR, MAP_COLOUR = (150, 150, 150), (200, 100, 0)
LEVELS: Final = ("", "warning", "error")


def report_html(run: RecordedRun, true: Trajectory | None = None) -> str:
    """Return the page; true: T_world_rig of the rig. Raise OmnidError where its times are others."""
    events = run.events()
    start_s = min([0.0, *(event.start_s for event in events if event.start_s >= -MAX_BEFORE_S)])
    end_s = max(run.end_s, 1e-2)
    spans = _spans(run)
    shown = {"start": start_s, "end": end_s, "spans": [span for span in spans if span[2] > 0]}
    truth = None if true is None else _Truth(run, true)
    parts = [
        f"<main data-run='{json.dumps(shown)}'>",
        *_head(run),
        _key_figures(run),
        *_warnings(run, true),
        *_plan(run, events, truth),
        "<p class='note'>Point at a chart: values, and the place on the plan. Drag across a chart: zoom; double-click: "
        "all.</p>",
        "<h2>Events</h2>",
        *_timeline(spans, events, start_s, end_s),
        *(
            []
            if (run.ranks != UNKNOWN).any()
            else [note("The log does not hold the state of the odometry (…/status of omnid).")]
        ),
        *_events_table(events, in_seconds=end_s - start_s < 300),
        *(_against_truth(truth) if truth else ()),
        *_motion(run),
        *_uncertainty(run),
        *_in_map(run),
        *_timing(run),
        *_parts(run),
        *_images(run, events),
        *_setup(run),
        *_contents(run),
        f"<p><small>Made by omnid {__version__}.</small></p></main>",
    ]
    style, script = style_and_script()
    return page(f"{run.robot}: {run.path.name}", parts, style, script)


def _head(run: RecordedRun) -> list[str]:
    found = run.info
    state = LogState.BROKEN if run.corrupt and found.state is LogState.WHOLE else found.state
    facts_text = (
        f"{run.path}, {found.size_bytes / 1e6:.1f} MB, {state.value}. Poses of {run.frames[1]} in {run.frames[0]} on "
        f"{run.topic}, from {utc(run.start_ns)}."
    )
    return [f"<h1>Run of {escape(run.robot)}</h1><p class='sub'>{escape(facts_text)}</p>"]


def _key_figures(run: RecordedRun) -> str:
    count, end_s = len(run.t_s), run.end_s
    rate = f", {(count - 1) / end_s:.1f}/s" if end_s > 0 else ""
    minutes, hours = f"{end_s / 60:.1f} min", f"{end_s / 3600:.2f} h"
    duration = f"{end_s:.1f} s" if end_s < 120 else minutes if end_s < 7200 else hours
    tiles = [("duration", duration), ("path", f"{run.length_m():.2f} m"), ("poses", f"{count}{rate}")]
    known = run.ranks[run.ranks != UNKNOWN]
    if len(known):
        tiles += [(name, _share(int((known == rank).sum()), len(known))) for rank, name in enumerate(STATES)]
        tiles.append(("resets", str(sum(count for _, count in run.resets))))
    p50, p99 = (_rounded(run.values(ODOMETRY).get(time_key(CAPTURE_TO_POSE, p), "")) for p in ("p50", "p99"))
    if p50:
        tiles.append(("image to pose, p50 / p99", f"{p50} / {p99} ms"))
    cells = "".join(f"<div><b>{escape(value)}</b><span>{escape(name)}</span></div>" for name, value in tiles)
    return f"<div class='numbers'>{cells}</div>"


def _warnings(run: RecordedRun, true: Trajectory | None) -> list[str]:
    """Return what is missing or doubtful in the log."""
    found, lines = run.info, []
    if found.state is LogState.BROKEN:
        lines.append(f"The log is cut or corrupt: {found.fault}.")
    if run.corrupt:
        lines.append(f"{run.corrupt} corrupt chunks or records were skipped.")
    if run.unreadable:
        lines.append(
            f"{run.unreadable} messages were left out: not of their type, with a stamp far from the time of logging, "
            "or with a pose out of range."
        )
    if run.late:
        lines.append(f"{run.late} poses were left out: not later than the one before.")
    if true is not None and run.rig is None:
        lines.append(f"The truth is compared as if the rig's frame were base_link: {run.rig_fault}.")
    return [f"<p class='warn'>{escape(line)}</p>" for line in lines]


class _Truth:
    """Errors of the rig's poses; only the first pose is aligned."""

    def __init__(self, run: RecordedRun, truth: Trajectory) -> None:
        T_rig_base, tolerance_s = se3.inverse(run.T_base_rig), 0.01
        stamps_ns = run.start_ns + np.rint(run.t_s * 1e9).astype(np.int64)
        T_estimate = T_rig_base @ run.T_odom_base @ run.T_base_rig
        self.metrics: Metrics = evaluate(Trajectory(stamps_ns, T_estimate), truth, tolerance_s)
        of_run, of_truth = associate(stamps_ns, truth.stamps_ns, round(tolerance_s * 1e9))
        T_estimate, T_true = T_estimate[of_run], truth.T[of_truth]
        T_true = T_estimate[0] @ se3.inverse(T_true[0]) @ T_true
        self.t_s = run.t_s[of_run]
        self.position_m = np.linalg.norm(T_estimate[:, :3, 3] - T_true[:, :3, 3], axis=1)
        self.heading_rad = se3.yaw(se3.inverse(T_true) @ T_estimate)
        self.base_xy: Array = (run.T_base_rig @ T_true @ T_rig_base)[:, :2, 3]


def _plan(run: RecordedRun, events: Sequence[Event], truth: _Truth | None) -> list[str]:
    """Return the figure of map and path, with dots of time, and crosses where the pose was lost."""
    # 1. The points of the map between the floor and what is above the robot.
    cloud = run.cloud if run.cloud is not None and run.cloud.frame == run.frames[0] else None
    xyz, confidence = np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
    if cloud is not None:
        finite = np.isfinite(cloud.points).all(axis=1)
        xyz, confidence = cloud.points[finite], np.clip(np.nan_to_num(cloud.confidence[finite]), 0.0, 1.0)
    height_m = float((run.T_odom_base[0] @ run.T_base_rig)[2, 3])
    low_m, high_m = drawn_heights((run.rig and run.rig.height_m()) or 0.0)
    points_xy, confidence = between(xyz, confidence, (height_m + low_m, height_m + high_m))
    # 2. The lines: a stretch of the path for each state; none leads from one odom to the next.
    xy, in_map = run.T_odom_base[:, :2, 3], _map_path(run)
    stretches: dict[int, list[Array]] = {}
    breaks = {0, len(xy), *run.restarts, *(np.flatnonzero(np.diff(run.ranks)) + 1).tolist()}
    for first, last in pairwise(sorted(breaks)):
        begins_odom = first == 0 or first in run.restarts
        stretches.setdefault(int(run.ranks[first]), []).append(xy[first if begins_odom else first - 1 : last])
    lines = [Lines([truth.base_xy], TRUTH_COLOUR, 2)] if truth else []
    lines += [Lines([in_map], MAP_COLOUR, 2)] if len(in_map) else []
    lines.append(Lines([part for parts in stretches.values() for part in parts], (255, 255, 255), 9))
    lines += [Lines(parts, *PATH[rank]) for rank, parts in sorted(stretches.items())]
    sheet = sheet_of(points_xy, np.vstack([xy, in_map, truth.base_xy if truth else np.zeros((0, 2))]))
    image = draw_plan(sheet, points_xy, confidence, lines)
    # 3. Times, losses, start and end.
    # Some six round times relate the path to the charts.
    steps_s = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200)
    step_s = next((step_s for step_s in steps_s if run.end_s <= 6 * step_s), 14400)
    for t_s in np.arange(step_s, run.end_s, step_s):
        x, y = (int(v) for v in sheet.pixels(xy[np.searchsorted(run.t_s, t_s)][None])[0])
        cv2.circle(image, (x, y), 4, (0, 0, 0), cv2.FILLED, cv2.LINE_AA)
        write(image, _clock(t_s, run.end_s < 300), (x + 22, y - 8))
    for event in [event for event in events if _is_loss(event)][:MAX_CROSSES]:
        x, y = (int(v) for v in sheet.pixels(xy[np.searchsorted(run.t_s, event.start_s)][None])[0])
        cv2.drawMarker(image, (x, y), (0, 0, 0), cv2.MARKER_TILTED_CROSS, 16, 3)
    draw_ends(image, sheet, xy[0], xy[-1])
    # 4. The figure; the places of at most 1000 poses are for the pointer.
    chosen = np.unique(np.linspace(0, len(xy) - 1, 1000).astype(int))
    shares = sheet.pixels(xy[chosen]) / np.array(image.shape[1::-1])
    places = [[round(t, 3), round(x, 4), round(y, 4)] for t, (x, y) in zip(run.t_s[chosen], shares, strict=True)]
    keys = [_key(PATH[rank][0], ("the path, tracking", "degraded", "lost")[rank]) for rank in stretches if rank >= 0]
    keys += [_key(PATH[UNKNOWN][0], "the path")] if UNKNOWN in stretches else []
    keys += [_key(MAP_COLOUR, "in the map")] if len(in_map) else []
    keys += [_key(TRUTH_COLOUR, "the true path")] if truth else []
    keys += ["<span class='key'>✕ lost here</span>"] if any(map(_is_loss, events)) else []
    footnote = "The log holds no map that can be drawn."
    if len(xyz):
        footnote = (
            f"Grey: {len(points_xy)} of the map's {len(xyz)} points, those from {-low_m:g} m below the rig's height at "
            f"the start to {high_m:g} m above it; they stand out by their confidence and number in a column."
        )
    return [
        f"<figure class='plan'><figcaption><b>Path and map</b>{''.join(keys)}</figcaption><div class='sheet' "
        f"data-plan='{json.dumps(places, separators=(',', ':'))}'>{embedded(image, 'png')}<i hidden></i></div>"
        f"<small>{footnote}</small></figure>"
    ]


def _key(colour: tuple[int, int, int], name: str) -> str:
    b, g, r = colour
    return f"<span class='key'><i style='background:rgb({r},{g},{b})'></i>{name}</span>"


def _spans(run: RecordedRun) -> list[tuple[float, float, int]]:
    """Return begin, end and rank of each time with one state; a gap without poses belongs to none."""
    ends_s, gap_ends = np.append(run.t_s[1:], run.end_s), dict(map(tuple, run.gaps()))
    spans: list[tuple[float, float, int]] = []
    for t_s, until_s, rank in zip(run.t_s.tolist(), ends_s.tolist(), run.ranks.tolist(), strict=True):
        if spans and spans[-1][1] == t_s and spans[-1][2] == rank and t_s not in gap_ends:
            spans[-1] = (spans[-1][0], until_s, rank)
        elif t_s not in gap_ends:
            spans.append((t_s, until_s, rank))
    return spans


def _is_loss(event: Event) -> bool:
    return (event.source, event.text) == ("state", STATES[-1])


def _timeline(
    spans: Sequence[tuple[float, float, int]], events: Sequence[Event], start_s: float, end_s: float
) -> list[str]:
    """Return a band with the states, and below it a lane of events for each part that has any."""

    def mark(style: str, from_s: float, to_s: float, title: str) -> str:
        left, right = ((min(max(t_s, start_s), end_s) - start_s) / (end_s - start_s) for t_s in (from_s, to_s))
        place = f"left:{100 * left:.2f}%;width:{100 * (right - left):.2f}%"
        return f"<i class='{style}' style='{place}' title='{escape(title)}'></i>"

    names = (*STATES, "unknown")
    lanes = {"state": "".join(mark(f"s{rank}", a, b, names[rank]) for a, b, rank in spans[:1000])}
    sources = sorted({event.source for event in events} - {"state", "poses"}, key=lambda name: ("stage" in name, name))
    for source in sources[:14]:
        own = [event for event in events if event.source == source][:MAX_EVENTS]
        lanes[source] = "".join(mark(f"e{event.level}", event.start_s, event.end_s, event.text) for event in own)
    keys = "".join(
        f"<span class='key'><i class='{style}'></i>{name}</span>"
        for style, name in (("s0", "tracking"), ("s1", "degraded, warning"), ("s2", "lost, error"))
    )
    rows = "".join(f"<div class='lane'><b>{escape(name)}</b><div>{marks}</div></div>" for name, marks in lanes.items())
    return [f"<figure><figcaption><b>States and events</b>{keys}</figcaption>{rows}</figure>"]


def _events_table(events: Sequence[Event], in_seconds: bool) -> list[str]:
    """Return the table of events in the order of time."""
    if not events:
        return ["<p>No events: no change of state, no gap, no loss.</p>"]
    rows = []
    for event in events[:MAX_EVENTS]:
        start, end = (_clock(at_s, in_seconds) for at_s in (event.start_s, event.end_s))
        text = f"{event.text} ({event.count})" if event.count else event.text
        times = start if start == end else f"{start} to {end}"
        rows.append((times, LEVELS[event.level], escape(event.source), escape(text)))
    more = [note(f"and {len(events) - MAX_EVENTS} more")] if len(events) > MAX_EVENTS else []
    return ["<div class='events'>", table(("time", "", "part", "event (count)"), rows), "</div>", *more]


def _clock(seconds: float, in_seconds: bool) -> str:
    if in_seconds:
        return f"{seconds:.2f}".rstrip("0").rstrip(".") + " s"
    whole = abs(seconds)
    return f"{'-' if seconds < 0 else ''}{int(whole // 3600)}:{int(whole // 60) % 60:02}:{whole % 60:04.1f}"


def _share(count: int, total: int) -> str:
    """Return the share in per cent; a small one is not rounded to 0, a large one not to 100."""
    if count in (0, total):
        return "always" if count else "never"
    percent = 100 * count / total
    return "< 0.1 %" if percent < 0.1 else f"{percent:.1f} %" if percent <= 99.9 else "> 99.9 %"


def _rounded(text: str) -> str:
    """Return a number with fewer digits; "" for a text that is no number."""
    value = status_names.number(text)
    return "" if value is None else f"{value:.3g}" if value < 100 else f"{value:.0f}"


def _against_truth(truth: _Truth) -> list[str]:
    """Return the section with the errors of the path, as `omnid eval` prints them."""
    rows = [(escape(line[:21]), escape(line[21:])) for line in str(truth.metrics).splitlines()]
    figures = [
        chart("Error of the position", [Curve("", truth.t_s, 1e3 * truth.position_m)], unit="mm"),
        chart("Error of the heading, to the left", [Curve("", truth.t_s, np.rad2deg(truth.heading_rad))], unit="deg"),
    ]
    footnote = "<small>Of the rig; the first pose is aligned and nothing else, as `omnid eval` does.</small>"
    return ["<h2>Against the truth</h2>", facts(rows), footnote, grid(figures)]


def _motion(run: RecordedRun) -> list[str]:
    """Return the section with speed, yaw rate and height, and the commands."""
    speed = [Curve("measured", run.t_s, run.velocity[:, 0])]
    yaw_rate = [Curve("measured", run.t_s, np.rad2deg(run.velocity[:, 5]))]
    for topic, name in ((DRIVE, "sent to the wheels"), (TWIST_COMMAND, "commanded")):
        if topic in run.drives:
            t_s, velocity_mps, rate_radps = run.drives[topic].T
            speed.append(Curve(name, t_s, velocity_mps))
            yaw_rate.append(Curve(name, t_s, np.rad2deg(rate_radps)))
    figures = [
        chart("Forward speed", speed, unit="m/s"),
        chart("Yaw rate, to the left", yaw_rate, unit="deg/s"),
        chart("Height of the robot", [Curve("", run.t_s, run.T_odom_base[:, 2, 3])], unit="m"),
    ]
    return ["<h2>Motion</h2>", grid(figures), *([] if run.drives else [note("The log holds no commands.")])]


def _uncertainty(run: RecordedRun) -> list[str]:
    """Return the section with the standard deviations of the covariances, and the landmarks."""
    position_m, heading_rad = root(run.variances[:, :3].sum(axis=1)), root(run.variances[:, 5])
    title = "Standard deviation of the"
    figures = [
        chart(f"{title} position, all axes", [Curve("", run.t_s, position_m)], unit="m", log=True),
        chart(f"{title} heading", [Curve("", run.t_s, np.rad2deg(heading_rad))], unit="deg", log=True),
    ]
    missing = [] if any(figures) else [note("The covariances in the log are zero or negative: they were not set.")]
    (t_s, tracked), (_, inliers) = (run.series(ODOMETRY, key) for key in (Key.TRACKED, Key.INLIERS))
    if len(tracked) > 2 and run.reports and len(tracked) == len(inliers):
        curves = [Curve("tracked", t_s, tracked), Curve("inliers of the pose", t_s, inliers)]
        figures.append(chart("Landmarks", curves, note="One value per report, not per pose."))
    elif not len(tracked):
        missing.append(note("The log holds no numbers of landmarks."))
    else:
        rows = list(zip(inliers, tracked, t_s, strict=False))[:12]
        counts = ", ".join(f"{count:.0f} of {total:.0f} at {at_s:.6g} s" for count, total, at_s in rows)
        missing.append(note(f"Landmarks are reported only where the state changes; inliers of the pose: {counts}."))
    return ["<h2>Uncertainty</h2>", grid(figures), *missing]


def _map_path(run: RecordedRun) -> Array:
    """Return the path in the map; empty where it is that of odometry, to a hundredth of a metre."""
    return run.map_xy if len(run.map_poses) and run.map_poses[:, 1].max() >= 0.01 else np.zeros((0, 2))


def _in_map(run: RecordedRun) -> list[str]:
    """Return the section with the map of places: its sizes, and the correction of odometry, where there was one."""
    if not len(_map_path(run)):
        return []
    rows = [(escape(name.replace("_", " ")), escape(value)) for name, value in run.values(PLACES).items()]
    t_s, moved_m, turned_rad, sigma_m = run.map_poses.T
    title, what = (
        "Standard deviation of the position in the map, all axes",
        "The correction map -> odom, where the robot is",
    )
    figures = [
        chart(
            "From odometry's position to that in the map",
            [Curve("", t_s, moved_m)],
            unit="m",
            note=f"{what}: odom does not jump.",
        ),
        chart("From odometry's heading to that in the map", [Curve("", t_s, np.rad2deg(turned_rad))], unit="deg"),
        chart(title, [Curve("", t_s, sigma_m)], unit="m", log=True),
        chart("Keyframes and loops", [Curve(name, *run.series(PLACES, name)) for name in ("keyframes", "loops")]),
    ]
    return ["<h2>In the map</h2>", *([facts(rows)] if rows else []), grid(figures)]


def _timing(run: RecordedRun) -> list[str]:
    """Return the section with rates, latencies and the stages' times."""
    summary = [(escape(name), escape(value)) for name, value in run.values(SUMMARY).items()]
    head = [
        "<h2>Times and losses</h2>",
        *(["<p>Counters at the end of the run:</p>", facts(summary)] if summary else []),
    ]
    if not run.reports:
        what = "rates, times of stages, latencies, drops and camera faults are unknown"
        return [
            *head,
            note(f"The log holds no status of the daemon's parts, so {what}; omnid's own recordings hold it."),
        ]
    # 1. The table of stages.
    stages = {name.removeprefix(STAGE_PREFIX): run.values(name) for name in run.newest if name.startswith(STAGE_PREFIX)}
    rows = []
    for name, values in stages.items():
        lost = escape(values.get(Key.DROPPED, values.get(Key.MISSED, "")))
        times = (_rounded(values.get(time_key(WORK, statistic), "")) for statistic in ("p50", "p99", "max"))
        counts = (escape(values.get(key, "")) for key in (Key.PROCESSED, Key.RATE_HZ))
        rows.append((escape(name), *counts, f"<b>{lost}</b>" if lost not in ("", "0") else lost, *times))
    titles = ("stage", "messages", "per second, last", "dropped or missed", "p50 ms", "p99 ms", "max ms")
    if rows:
        head.append(f"<div class='scroll'>{table(titles, rows)}</div>")
        head.append("<small>At the last report. The work of a camera's stage is its wait for the next image.</small>")
    if run.reports == 1:  # a replay, which reports at its end only
        return head
    # 2. The charts.
    since_start = "since the start of the run."
    percentiles = {"median": "p50", "99th percentile": "p99"}
    latency = [Curve(n, *run.series(ODOMETRY, time_key(CAPTURE_TO_POSE, p))) for n, p in percentiles.items()]
    work = {name: run.series(stage_name(name), time_key(WORK, "p50")) for name in stages}
    losses = [
        Curve(f"{name}, {key}", *series)
        for name in stages
        for key in (Key.DROPPED, Key.MISSED)
        if len((series := run.series(stage_name(name), key))[1]) and series[1][-1] > 0
    ]
    slowest = sorted((values[-1], name) for name, (_, values) in work.items() if len(values))[::-1]
    figures = [
        chart("Poses per second", [Curve("", *run.series(ODOMETRY, Key.RATE_HZ))]),
        chart("Age of the newest pose at each report", [Curve("", *run.series(ODOMETRY, Key.AGE_S))], unit="s"),
        chart("From the image to its pose", latency, unit="ms", note=f"Of all poses {since_start}"),
        chart(
            "Median work of a stage",
            [Curve(name, *work[name]) for _, name in slowest],
            unit="ms",
            log=True,
            note=f"Of all messages {since_start}",
        ),
        chart("Messages dropped, deadlines missed, so far", sorted(losses, key=lambda curve: -curve.values[-1])),
    ]
    return [*head, grid(figures)]


def _parts(run: RecordedRun) -> list[str]:
    """Return the section with cameras, pairing and wheels: counters at the end, and rates."""
    names = [name for name in run.newest if name not in (ODOMETRY, SUMMARY) and not name.startswith(STAGE_PREFIX)]
    if not names:
        return []
    rows = []
    for name in names:
        counters = ", ".join(f"{escape(key)} {escape(value)}" for key, value in run.values(name).items())
        rows.append((escape(short_name(name)), escape(run.newest[name].message), counters))
    rates = [Curve(short_name(name), *run.series(name, Key.RATE_HZ)) for name in names]
    late = [Curve(p, *run.series(WHEELS, time_key(TICK_LATE, p))) for p in ("p99", "max")]
    parts = table(("part", "at the last report", "counters"), rows)
    figures = [chart("Images per second", rates), chart("Lateness of the wheels' tick, so far", late, unit="ms")]
    return ["<h2>Cameras, pairing, wheels</h2>", f"<div class='words scroll'>{parts}</div>", grid(figures)]


def _images(run: RecordedRun, events: Sequence[Event]) -> list[str]:
    """Return the lower camera's panoramas at the first pose and when the pose was first lost."""
    head = ["<h2>Images</h2>"]
    if not any(schema in IMAGE_TYPES for schema, _ in run.info.topics.values()):
        return [*head, note("The log holds no images.")]
    if run.rig is None:
        return [*head, note(f"Images, but {run.rig_fault}.")]
    wanted = [(run.start_ns, "The lower camera's panorama at the first pose; forward is in the middle.")]
    for event in [event for event in events if _is_loss(event)][:1]:
        at_ns = run.start_ns + round(event.start_s * 1e9)
        wanted.append((at_ns, f"The same when the pose was first lost, at {event.start_s:.2f} s."))
    shown = []
    try:
        maps, decode = remap_tables(run.rig, run.rig.lower, fit_cylinder(run.rig, 1200)), Decoder(run.rig)
        with closing(LogReader(run.path)) as reader:
            for frame in islice(reader.frames(), 40_000):  # the first loss in a long log may be hours away
                is_next = wanted and frame.camera == "lower" and frame.stamp_ns >= wanted[0][0]
                if is_next and (image := decode(frame)) is not None:
                    panorama = cv2.remap(image, *maps, cv2.INTER_LINEAR)[:500]
                    shown.append(figure(np.asarray(panorama, np.uint8), wanted.pop(0)[1]))
                if not wanted:
                    break
    except (CalibError, DriverError, cv2.error) as error:
        shown.append(note(f"The images in the log cannot be shown: {' '.join(str(error).split())}"))
    return [*head, *(shown or [note("No image could be decoded.")])]


def _setup(run: RecordedRun) -> list[str]:
    """Return the section with the rig and the settings that are not at their defaults."""
    parts, rig = ["<h2>Rig and settings</h2>"], run.rig
    if rig is None:
        parts.append(note(f"{run.rig_fault[:1].upper()}{run.rig_fault[1:]}."))
    else:
        T, place = rig.T_base_rig, "not stated: the rig's frame is base_link"
        if not np.allclose(T, np.eye(4)):
            rotation = ", ".join(f"{value:.3g}" for value in np.rad2deg(se3.rotation_log(T[:3, :3])))
            place = f"at {', '.join(f'{value:.3g}' for value in T[:3, 3])} m, rotated by {rotation} deg"
        cameras = []
        for name, one in (("lower", rig.lower), ("upper", rig.upper)):
            size = f"{one.camera.size[0]}x{one.camera.size[1]} px"
            mask = "with a mask" if one.mask else "without a mask"
            cameras.append((f"{name} camera", f"{model_in_words(one.camera)}, {size}, {mask}"))
        rows = [("baseline", f"{rig.baseline_m * 1e3:.2f} mm"), *cameras, ("on the robot", place)]
        parts.append(facts([(name, escape(value)) for name, value in rows]))
    settings = run.attachments.get("omnid.toml")
    found = None if settings is None else _changed(settings)
    if settings is None or found is None:
        parts.append(note("No settings are attached." if settings is None else "The attached settings cannot be read."))
    elif not found:
        parts.append("<p>All settings are at their defaults.</p>")
    else:
        cells = [tuple(map(escape, row)) for row in found]
        parts.append(f"<div class='words scroll'>{table(('setting', 'value', 'default'), cells)}</div>")
    return parts


def _changed(settings: bytes) -> list[tuple[str, str, str]] | None:
    """Return name, value and default of the settings that differ from the defaults; None where they cannot be read."""
    try:
        given = parse_toml(settings.decode()) if len(settings) <= 1 << 18 else None
    except (ValueError, RecursionError):
        given = None
    if given is None:
        return None
    defaults = dict(_flat(parse_toml(dump(Config()))))
    return [
        (name[:120], str(value)[:120], str(defaults[name])[:120] if name in defaults else "unknown to this omnid")
        for name, value in _flat(given)
        if name not in defaults or defaults[name] != value
    ][:MAX_ROWS]


def _flat(table: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, object]]:
    for name, value in table.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{above}{name}.")
        else:
            yield f"{above}{name}", value


def _contents(run: RecordedRun) -> list[str]:
    """Return the section with the topics of the file."""
    topics = list(run.info.topics.items())
    rows = [(escape(name), escape(kind), str(count)) for name, (kind, count) in topics[:MAX_ROWS]]
    more = [note(f"and {len(topics) - MAX_ROWS} more topics")] if len(topics) > MAX_ROWS else []
    attached = ", ".join(f"{name} ({size} bytes)" for name, size in run.info.attachments.items())
    content = f"<div class='words scroll'>{table(('topic', 'type', 'messages'), rows)}</div>"
    return ["<h2>Content of the file</h2>", content, *more, f"<p>Attached: {escape(attached or 'nothing')}.</p>"]
