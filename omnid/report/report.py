"""The report of a recorded run: one self-contained HTML page. Text from the log is escaped where it enters HTML."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from html import escape
from itertools import islice, pairwise
from typing import Any, Final

import cv2
import numpy as np

from calib import se3
from calib.errors import CalibError
from calib.models.names import model_in_words
from calib.panorama import fit_cylinder, remap_tables
from calib.typed_toml import parse_toml
from drivers.errors import DriverError
from drivers.logs.log_reader import LogReader
from drivers.logs.open_log import LogState
from drivers.logs.ros_messages import IMAGE_TYPES
from omnid.config import Config
from omnid.formats.plan import BLACK, WHITE, Lines, between, draw_ends, draw_plan, drawn_heights, sheet_of
from omnid.formats.tum import Trajectory
from omnid.plain_text import plain
from omnid.recordings.evaluation import Metrics, associate, evaluate
from omnid.recordings.recording import DRIVE, TWIST_COMMAND
from omnid.report.charts import Array, Curve, chart, colours, grid, style_and_script
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
MAX_EVENTS, MAX_ROWS, MAX_LANES = 400, 60, 14  # of the table of events, of other tables, of parts with events
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
        *_warnings(run, true),
        *_plan(run, events, truth),
        "<p class='note'>Point at a chart: values, and the place on the plan. Drag across a chart: zoom; double-click: "
        "all.</p>",
        "<h2>Events</h2>",
        *_timeline(spans, events, start_s, end_s),
        *(() if (run.ranks != UNKNOWN).any() else [note("The log does not hold the state of the odometry.")]),
        *_events_table(events, end_s),
        *(f"<h2>{title}</h2>{''.join(section)}" for title, section in _sections(run, truth)),
        *_images(run, events),
        *_setup(run),
        *_contents(run),
        f"<p><small>Made by omnid {__version__}.</small></p></main>",
    ]
    style, script = style_and_script()
    return page(f"{run.robot}: {run.path.name}", parts, style, script)


def _head(run: RecordedRun) -> list[str]:
    """Return the title and the key figures."""
    found, count, end_s = run.info, len(run.t_s), run.end_s
    state = LogState.BROKEN if run.corrupt and found.state is LogState.WHOLE else found.state
    source = (
        f"{run.path}, {found.size_bytes / 1e6:.1f} MB, {state.value}. Poses of {run.frames[1]} in {run.frames[0]} on "
        f"{run.topic}, from {utc(run.start_ns)}."
    )
    rate = f", {(count - 1) / end_s:.1f}/s" if end_s > 0 else ""
    tiles = [("duration", _clock(end_s, end_s)), ("path", f"{run.length_m():.2f} m"), ("poses", f"{count}{rate}")]
    known = run.ranks[run.ranks != UNKNOWN]
    if len(known):
        tiles += [(name, _share(int((known == rank).sum()), len(known))) for rank, name in enumerate(STATES)]
        tiles.append(("resets", str(sum(count for _, count in run.resets))))
    p50, p99 = (_rounded(run.values(ODOMETRY).get(time_key(CAPTURE_TO_POSE, p), "")) for p in ("p50", "p99"))
    if p50:
        tiles.append(("image to pose, p50 / p99", f"{p50} / {p99} ms"))
    cells = "".join(f"<div><b>{escape(value)}</b><span>{escape(name)}</span></div>" for name, value in tiles)
    return [
        f"<h1>Run of {escape(run.robot)}</h1><p class='sub'>{escape(source)}</p>",
        f"<div class='numbers'>{cells}</div>",
    ]


def _warnings(run: RecordedRun, true: Trajectory | None) -> list[str]:
    """Return what is missing or doubtful in the log."""
    found = run.info
    lines = {
        f"The log is cut or corrupt: {found.fault}.": found.state is LogState.BROKEN,
        f"{run.corrupt} corrupt chunks or records were skipped.": run.corrupt,
        f"{run.unreadable} messages were left out: not of their type, with a stamp far from the time of logging, or "
        "with a pose out of range.": run.unreadable,
        f"{run.late} poses were left out: not later than the one before.": run.late,
        f"The truth is compared as if the rig's frame were base_link: {run.rig_fault}.": true and run.rig is None,
    }
    return [f"<p class='warn'>{escape(line)}</p>" for line, is_so in lines.items() if is_so]


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
        self.position_m = np.linalg.norm((T_estimate - T_true)[:, :, -1], axis=1)
        self.heading_rad = se3.yaw(se3.inverse(T_true) @ T_estimate)
        self.base_xy: Array = (run.T_base_rig @ T_true @ T_rig_base)[:, :2, -1]


def _plan(run: RecordedRun, events: Sequence[Event], truth: _Truth | None) -> list[str]:
    """Return the figure of map and path, with crosses where the pose was lost; the pointer relates it to the charts."""
    # 1. The points of the map between the floor and what is above the robot.
    points, confidence = np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
    if run.cloud is not None and run.cloud.frame == run.frames[0]:
        finite = np.isfinite(run.cloud.points).all(axis=1)
        points = run.cloud.points[finite]
        confidence = np.clip(np.nan_to_num(run.cloud.confidence[finite]), 0.0, 1.0)
    height_m = float((run.T_odom_base[0] @ run.T_base_rig)[2, -1])
    low_m, high_m = drawn_heights((run.rig and run.rig.height_m()) or 0.0)
    points_xy, confidence = between(points, confidence, (height_m + low_m, height_m + high_m))
    # 2. The lines: a stretch of the path for each state; none leads from one odom to the next.
    xy, in_map, colour = run.xyz[:, :2], _map_path(run), colours()
    stretches: dict[int, list[Array]] = {}
    breaks = {0, len(xy), *run.restarts, *(np.flatnonzero(np.diff(run.ranks)) + 1).tolist()}
    for first, last in pairwise(sorted(breaks)):
        begins_odom = first == 0 or first in run.restarts
        stretches.setdefault(int(run.ranks[first]), []).append(xy[first if begins_odom else first - 1 : last])
    beside = {"truth": ([truth.base_xy] if truth else [], "the true path"), "map": ([in_map], "in the map")}
    lines = [Lines(parts, colour[name], 2) for name, (parts, _) in beside.items()]
    lines.append(Lines([part for parts in stretches.values() for part in parts], WHITE, 9))
    # The worse the state, the thicker the line.
    lines += [Lines(parts, colour[_path_name(rank)], 3 + 2 * max(rank, 0)) for rank, parts in sorted(stretches.items())]
    sheet = sheet_of(points_xy, np.vstack([xy, in_map, truth.base_xy if truth else np.zeros((0, 2))]))
    image = draw_plan(sheet, points_xy, confidence, lines)

    # 3. Losses, start and end.
    losses = [event for event in events if _is_loss(event)]
    at = np.searchsorted(run.t_s, [event.start_s for event in losses[:MAX_ROWS]])
    for x, y in sheet.pixels(xy[at]).astype(int).tolist():
        cv2.drawMarker(image, (x, y), BLACK, cv2.MARKER_TILTED_CROSS, 16, 3)
    draw_ends(image, sheet, xy[0], xy[-1])
    # 4. The figure; the places of at most 1000 poses are for the pointer.
    chosen = np.unique(np.linspace(0, len(xy) - 1, 1000).astype(int))
    shares = sheet.pixels(xy[chosen]) / np.array(image.shape[1::-1])
    places = np.column_stack([run.t_s[chosen], shares]).round(4).tolist()
    keys = [
        _key(f"p-{_path_name(rank)}", f"the path, {STATES[rank]}" if rank >= 0 else "the path") for rank in stretches
    ]
    keys += [_key(f"p-{name}", words) for name, (parts, words) in beside.items() if sum(map(len, parts))]
    keys += ["<span class='key'>✕ lost here</span>"] if losses else []
    footnote = (
        f"Grey: {len(points_xy)} of the map's {len(points)} points, those from {-low_m:g} m below the rig's height at "
        f"the start to {high_m:g} m above it; they stand out by their confidence and number in a column."
    )
    return [
        f"<figure class='plan'><figcaption><b>Path and map</b>{''.join(keys)}</figcaption><div class='sheet' "
        f"data-plan='{json.dumps(places, separators=(',', ':'))}'>{embedded(image, 'png')}<i hidden></i></div>"
        f"<small>{footnote if len(points) else 'The log holds no map that can be drawn.'}</small></figure>"
    ]


def _path_name(rank: int) -> str:
    """Return the name of the path's colour in the style sheet, by the rank of a state."""
    return str(STATES[rank]) if rank >= 0 else "tracking"


def _key(style: str, name: str) -> str:
    return f"<span class='key'><i class='{style}'></i>{name}</span>"


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
        return f"<i class='{style}' style='left:{left:.2%};width:{right - left:.2%}' title='{escape(title)}'></i>"

    names = (*STATES, "unknown")
    lanes = {"state": "".join(mark(f"s{rank}", a, b, names[rank]) for a, b, rank in spans[:MAX_EVENTS])}
    sources = sorted({event.source for event in events} - {"state", "poses"}, key=lambda name: ("stage" in name, name))
    for source in sources[:MAX_LANES]:
        own = [event for event in events if event.source == source][:MAX_EVENTS]
        lanes[source] = "".join(mark(f"e{event.level}", event.start_s, event.end_s, event.text) for event in own)
    styles = {"s0": "tracking", "s1": "degraded, warning", "s2": "lost, error"}
    keys = "".join(_key(style, name) for style, name in styles.items())
    rows = "".join(f"<div class='lane'><b>{escape(name)}</b><div>{marks}</div></div>" for name, marks in lanes.items())
    return [f"<figure><figcaption><b>States and events</b>{keys}</figcaption>{rows}</figure>"]


def _events_table(events: Sequence[Event], end_s: float) -> list[str]:
    """Return the table of events in the order of time."""
    if not events:
        return ["<p>No events: no change of state, no gap, no loss.</p>"]
    rows = []
    for event in events[:MAX_EVENTS]:
        start, end = (_clock(at_s, end_s) for at_s in (event.start_s, event.end_s))
        text = f"{event.text} ({event.count})" if event.count else event.text
        times = start if start == end else f"{start} to {end}"
        rows.append((times, LEVELS[event.level], escape(event.source), escape(text)))
    more = [note(f"and {len(events) - MAX_EVENTS} more")] if len(events) > MAX_EVENTS else []
    return ["<div class='events'>", table(("time", "", "part", "event (count)"), rows), "</div>", *more]


def _clock(seconds: float, end_s: float) -> str:
    """Return a time in words; end_s: of the run: of a short one in seconds, as in the charts."""
    if end_s < 300:
        return f"{seconds:.2f}".rstrip("0").rstrip(".") + " s"
    minutes, rest_s = divmod(abs(seconds), 60)
    return f"{'-' if seconds < 0 else ''}{minutes // 60:.0f}:{minutes % 60:02.0f}:{rest_s:04.1f}"


def _share(count: int, total: int) -> str:
    """Return the share in per cent; a small one is not rounded to 0, a large one not to 100."""
    if count in (0, total):
        return "always" if count else "never"
    return f"{100 * min(max(count / total, 0.001), 0.999):.1f} %"


def _rounded(text: str) -> str:
    """Return a number with fewer digits; "" for a text that is no number."""
    value = status_names.number(text)
    return "" if value is None else f"{value:.3g}" if value < 100 else f"{value:.0f}"


def _sections(run: RecordedRun, truth: _Truth | None) -> Iterator[tuple[str, list[str]]]:
    """Yield title and parts of each section of charts and tables; a part is HTML, "" where the log has nothing."""
    # 1. Errors of the path, as `omnid eval` prints them.
    if truth is not None:
        errors = [re.split(" {2,}", line, maxsplit=1) for line in escape(str(truth.metrics)).splitlines()]
        footnote = "<small>Of the rig; the first pose is aligned and nothing else, as `omnid eval` does.</small>"
        figures = [
            chart("Error of the position", [Curve("", truth.t_s, truth.position_m)], unit="m"),
            chart("Error of the heading, to the left", [Curve("", truth.t_s, np.rad2deg(truth.heading_rad))], "deg"),
        ]
        yield "Against the truth", [facts(errors), footnote, grid(figures)]
    # 2. Speed, yaw rate and height, and the commands.
    named = {DRIVE: "sent to the wheels", TWIST_COMMAND: "commanded"}
    moved = [("measured", run.t_s, run.velocity[:, 0], run.velocity[:, -1])]
    moved += [(name, *run.drives[topic].T) for topic, name in named.items() if topic in run.drives]
    figures = [
        chart("Forward speed", [Curve(name, t_s, speed) for name, t_s, speed, _ in moved], "m/s"),
        chart("Yaw rate, to the left", [Curve(name, t_s, np.rad2deg(w)) for name, t_s, _, w in moved], "deg/s"),
        chart("Height of the robot", [Curve("", run.t_s, run.xyz[:, 2])], "m"),
    ]
    yield "Motion", [grid(figures), "" if run.drives else note("The log holds no commands.")]
    # 3. Standard deviations of the covariances, and the landmarks.
    position_m, heading_rad = root(run.variances[:, :3].sum(axis=1)), root(run.variances[:, -1])
    title, landmarks = "Standard deviation of the", {"tracked": Key.TRACKED, "inliers of the pose": Key.INLIERS}
    figures = [
        chart(f"{title} position, all axes", [Curve("", run.t_s, position_m)], "m", log=True),
        chart(f"{title} heading", [Curve("", run.t_s, np.rad2deg(heading_rad))], "deg", log=True),
    ]
    unset = "" if any(figures) else note("The covariances in the log are zero or negative: they were not set.")
    curves = [run.curve(name, ODOMETRY, key) for name, key in landmarks.items()]
    tracked = curves[0].values
    few = (
        f"Landmarks at the last report: {tracked[-1]:.0f}."
        if len(tracked)
        else "The log holds no numbers of landmarks."
    )
    if len(tracked) > 2:
        figures.append(chart("Landmarks", curves, note="One value per report, not per pose."))
    yield "Uncertainty", [grid(figures), unset, "" if len(tracked) > 2 else note(few)]
    # 4. The map of places: its sizes, and the correction of odometry, where there was one.
    if len(_map_path(run)):
        t_s, moved_m, turned_rad, sigma_m = run.map_poses.T
        title, what = "From odometry's", "The correction map -> odom, where the robot is: odom does not jump."
        figures = [
            chart(f"{title} position to that in the map", [Curve("", t_s, moved_m)], "m", note=what),
            chart(f"{title} heading to that in the map", [Curve("", t_s, np.rad2deg(turned_rad))], "deg"),
            chart("Standard deviation of the position in the map, all axes", [Curve("", t_s, sigma_m)], "m", log=True),
            chart("Keyframes and loops", [run.curve(name, PLACES, name) for name in ("keyframes", "loops")]),
        ]
        yield "In the map", [*_counters(run, PLACES), grid(figures)]
    # 5. Rates, latencies, the stages' times; counters of the other parts at the end.
    yield "Times and losses", _timing(run)
    names = [name for name in run.newest if name not in (ODOMETRY, SUMMARY) and not name.startswith(STAGE_PREFIX)]
    if names:
        rows = [
            (short_name(name), run.newest[name].message, ", ".join(f"{k} {v}" for k, v in run.values(name).items()))
            for name in names
        ]
        titles = ("part", "at the last report", "counters")
        late = [run.curve(p, WHEELS, time_key(TICK_LATE, p)) for p in ("p99", "max")]
        figures = [
            chart("Images per second", [run.curve(short_name(name), name, Key.RATE_HZ) for name in names]),
            chart("Lateness of the wheels' tick, so far", late, "ms"),
        ]
        yield "Cameras, pairing, wheels", [_words(titles, rows), grid(figures)]


def _words(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table of texts of the log."""
    cells = [[escape(cell) for cell in row] for row in rows]
    return f"<div class='words scroll'>{table(titles, cells)}</div>"


def _map_path(run: RecordedRun) -> Array:
    """Return the path in the map; empty where it is that of odometry, to a hundredth of a metre."""
    return run.map_xy if len(run.map_poses) and run.map_poses[:, 1].max() >= 0.01 else np.zeros((0, 2))


def _counters(run: RecordedRun, name: str) -> list[str]:
    """Return the newest values of a part that are not 0 as a table; nothing where it has no values."""
    values = {key: value for key, value in run.values(name).items() if value != "0"}
    rows = [(escape(key.replace("_", " ")), escape(value)) for key, value in values.items()]
    return [facts(rows), "<small>All other counters are 0.</small>"] if run.values(name) else []


def _timing(run: RecordedRun) -> list[str]:
    """Return the table of stages, and the charts of rates, latencies and losses."""
    parts = ["<p>Counters at the end of the run:</p>", *summary] if (summary := _counters(run, SUMMARY)) else []
    if not run.reports:
        what = "rates, times of stages, latencies, drops and camera faults are unknown"
        return [*parts, note(f"The log holds no status of the daemon's parts, so {what}; omnid's own recordings do.")]
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
        parts.append(f"<div class='scroll'>{table(titles, rows)}</div>")
        parts.append("<small>At the last report. The work of a camera's stage is its wait for the next image.</small>")
    if run.reports == 1:  # a replay, which reports at its end only
        return parts
    # 2. The charts.
    of_all, by_rank = "Of all messages since the start of the run.", {"median": "p50", "99th percentile": "p99"}
    latency = [run.curve(name, ODOMETRY, time_key(CAPTURE_TO_POSE, p)) for name, p in by_rank.items()]
    work = [run.curve(name, stage_name(name), time_key(WORK, "p50")) for name in stages]
    losses = [
        run.curve(f"{name}, {key}", stage_name(name), key) for name in stages for key in (Key.DROPPED, Key.MISSED)
    ]
    risen = [curve for curve in highest(losses) if curve.values[-1] > 0]
    figures = [
        chart("Poses per second", [run.curve("", ODOMETRY, Key.RATE_HZ)]),
        chart("Age of the newest pose at each report", [run.curve("", ODOMETRY, Key.AGE_S)], "s"),
        chart("From the image to its pose", latency, "ms", note=of_all),
        chart("Median work of a stage", highest(work), "ms", log=True, note=of_all),
        chart("Messages dropped, deadlines missed, so far", risen),
    ]
    return [*parts, grid(figures)]


def highest(curves: Sequence[Curve]) -> list[Curve]:
    """Return the curves that have values, those with the highest last one first."""
    return sorted((curve for curve in curves if len(curve.values)), key=lambda curve: -curve.values[-1])


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
                    panorama = cv2.remap(image, *maps, cv2.INTER_LINEAR)
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
        place = "not stated: the rig's frame is base_link"
        if not np.allclose(rig.T_base_rig, np.eye(4)):
            pose = se3.log(rig.T_base_rig)
            x_y_z, rotation = rig.T_base_rig[:-1, -1], np.rad2deg(pose[3:])
            at, turned = (", ".join(f"{value:.3g}" for value in values) for values in (x_y_z, rotation))
            place = f"at {at} m, rotated by {turned} deg"
        rows = [("baseline", f"{1e3 * rig.baseline_m:.2f} mm")]
        for name, one in (("lower", rig.lower), ("upper", rig.upper)):
            size = "x".join(map(str, one.camera.size))
            mask = "with a mask" if one.mask else "without a mask"
            rows.append((f"{name} camera", f"{model_in_words(one.camera)}, {size} px, {mask}"))
        parts.append(facts([(name, escape(value)) for name, value in (*rows, ("on the robot", place))]))
    settings = run.attachments.get("omnid.toml")
    if settings is None:
        return [*parts, note("No settings are attached.")]
    try:
        defaults = dict(_flat(parse_toml(dump(Config()))))
        given = [(name, value, defaults.get(name, "unknown")) for name, value in _flat(parse_toml(settings.decode()))]
    except (ValueError, RecursionError):
        return [*parts, note("The attached settings cannot be read.")]
    changed = [[plain(str(cell), 120) for cell in row] for row in given if row[1] != row[2]][:MAX_ROWS]
    if not changed:
        return [*parts, "<p>All settings are at their defaults.</p>"]
    return [*parts, _words(("setting", "value", "default"), changed)]


def _flat(table: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, object]]:
    for name, value in table.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{above}{name}.")
        else:
            yield f"{above}{name}", value


def _contents(run: RecordedRun) -> list[str]:
    """Return the section with the topics of the file."""
    rows = [(name, kind, str(count)) for name, (kind, count) in run.info.topics.items()]
    more = [note(f"and {len(rows) - MAX_ROWS} more topics")] if len(rows) > MAX_ROWS else []
    attached = ", ".join(f"{name} ({size} bytes)" for name, size in run.info.attachments.items())
    content = _words(("topic", "type", "messages"), rows[:MAX_ROWS])
    return ["<h2>Content of the file</h2>", content, *more, f"<p>Attached: {escape(attached or 'nothing')}.</p>"]
