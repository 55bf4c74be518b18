"""The report of a recorded run: one self-contained HTML page. Text from the log is escaped where it enters HTML."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from itertools import pairwise
from typing import Any, Final

import cv2
import numpy as np

from calib import se3
from drivers.logs.open_log import LogState
from omnid.config import Config
from omnid.formats.plan import BLACK, WHITE, Lines, between, draw_ends, draw_plan, drawn_heights, sheet_of
from omnid.formats.tum import Trajectory
from omnid.plain_text import MOST_ENTRIES, plain
from omnid.recordings.evaluation import Metrics, associate, evaluate
from omnid.recordings.recording import DRIVE, TWIST_COMMAND
from omnid.report.charts import Array, Curve, chart, colours, grid, style_and_script
from omnid.report.page import embedded, facts, note, page, table
from omnid.report.recorded_run import STATES, UNKNOWN, Event, RecordedRun, root
from omnid.settings import dump
from omnid.transport import status_names
from omnid.transport.status_names import (
    CAPTURE_TO_POSE,
    ODOMETRY,
    PLACES,
    STAGE_PREFIX,
    SUMMARY,
    WORK,
    Key,
    short_name,
    stage_name,
    time_key,
)
from omnid.utc import utc
from omnid.version import __version__

MAX_EVENTS: Final = 400  # of the table of events
LEVELS: Final = ("", "warning", "error")


def report_html(run: RecordedRun, true: Trajectory | None = None) -> str:
    """Return the page; true: T_world_rig of the rig. Raise OmnidError where its times are others."""
    events = run.events()
    end_s = max(run.end_s, 1e-2)
    shown = {"start": 0.0, "end": end_s, "spans": [span for span in _spans(run) if span[2] > 0]}
    truth = None if true is None else _Truth(run, true)
    parts = [
        f"<main data-run='{json.dumps(shown)}'>",
        *_head(run),
        *_warnings(run, true),
        *_plan(run, events, truth),
        "<p class='note'>Point at a chart: values, and the place on the plan. Drag across a chart: zoom; double-click: "
        "all.</p>",
        "<h2>Events</h2>",
        *(() if (run.ranks != UNKNOWN).any() else [note("The log does not hold the state of the odometry.")]),
        *_events_table(events, end_s),
        *(f"<h2>{title}</h2>{''.join(section)}" for title, section in _sections(run, truth)),
        *_settings(run),
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
        tiles.append(("resets", str(run.resets)))
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
        f"{run.left_out} messages were left out: not of their type, out of range, or not in order.": run.left_out,
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
    # 2. The lines: a stretch of the path for each state.
    xy, in_map, colour = run.xyz[:, :2], _map_path(run), colours()
    stretches: dict[int, list[Array]] = {}
    breaks = {0, len(xy), *(np.flatnonzero(np.diff(run.ranks)) + 1).tolist()}
    for first, last in pairwise(sorted(breaks)):
        stretches.setdefault(int(run.ranks[first]), []).append(xy[max(0, first - 1) : last])
    beside = {"truth": ([truth.base_xy] if truth else [], "the true path"), "map": ([in_map], "in the map")}
    lines = [Lines(parts, colour[name], 2) for name, (parts, _) in beside.items()]
    lines.append(Lines([part for parts in stretches.values() for part in parts], WHITE, 9))
    # The worse the state, the thicker the line.
    lines += [Lines(parts, colour[_path_name(rank)], 3 + 2 * max(rank, 0)) for rank, parts in sorted(stretches.items())]
    sheet = sheet_of(points_xy, np.vstack([xy, in_map, truth.base_xy if truth else np.zeros((0, 2))]))
    image = draw_plan(sheet, points_xy, confidence, lines)

    # 3. Losses, start and end.
    losses = [event for event in events if _is_loss(event)]
    at = np.searchsorted(run.t_s, [event.start_s for event in losses[:MOST_ENTRIES]])
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
    figures.append(chart("Landmarks", [run.curve(name, ODOMETRY, key) for name, key in landmarks.items()]))
    yield "Uncertainty", [grid(figures), unset]
    # 4. The correction of odometry by the map of places, where there was one.
    if len(_map_path(run)):
        t_s, moved_m, turned_rad = run.map_poses.T
        title, what = "From odometry's", "The correction map -> odom, where the robot is: odom does not jump."
        figures = [
            chart(f"{title} position to that in the map", [Curve("", t_s, moved_m)], "m", note=what),
            chart(f"{title} heading to that in the map", [Curve("", t_s, np.rad2deg(turned_rad))], "deg"),
        ]
        yield "In the map", [*_counters(run, PLACES), grid(figures)]
    # 5. Rates, latencies, the stages' times; counters of the other parts at the end.
    if any(timing := _timing(run)):
        yield "Times and losses", timing
    names = [name for name in run.newest if name not in (ODOMETRY, SUMMARY) and not name.startswith(STAGE_PREFIX)]
    if names:
        rows = [
            (short_name(name), run.newest[name].message, ", ".join(f"{k} {v}" for k, v in run.values(name).items()))
            for name in names
        ]
        titles = ("part", "at the last report", "counters")
        rates = chart("Images per second", [run.curve(short_name(name), name, Key.RATE_HZ) for name in names])
        yield "Cameras, pairing, wheels", [_words(titles, rows), rates]


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
    # 2. The charts.
    of_all, by_rank = "Of all messages since the start of the run.", {"median": "p50", "99th percentile": "p99"}
    latency = [run.curve(name, ODOMETRY, time_key(CAPTURE_TO_POSE, p)) for name, p in by_rank.items()]
    work = [run.curve(name, stage_name(name), time_key(WORK, "p50")) for name in stages]
    losses = [
        run.curve(f"{name}, {key}", stage_name(name), key) for name in stages for key in (Key.DROPPED, Key.MISSED)
    ]
    risen = [curve for curve in losses if len(curve.values) and curve.values[-1] > 0]
    figures = [
        chart("Poses per second", [run.curve("", ODOMETRY, Key.RATE_HZ)]),
        chart("From the image to its pose", latency, "ms", note=of_all),
        chart("Median work of a stage", work, "ms", log=True, note=of_all),
        chart("Messages dropped, deadlines missed, so far", risen),
    ]
    return [*parts, grid(figures)]


def _settings(run: RecordedRun) -> list[str]:
    """Return the section with the settings that are not at their defaults."""
    head, settings = "<h2>Settings</h2>", run.attachments.get("omnid.toml")
    if settings is None:
        return [head, note("No settings are attached.")]
    try:
        defaults = dict(_flat(tomllib.loads(dump(Config()))))
        given = [
            (name, value, defaults.get(name, "unknown")) for name, value in _flat(tomllib.loads(settings.decode()))
        ]
    except (ValueError, RecursionError):
        return [head, note("The attached settings cannot be read.")]
    changed = [[plain(str(cell), 120) for cell in row] for row in given if row[1] != row[2]][:MOST_ENTRIES]
    if not changed:
        return [head, "<p>All settings are at their defaults.</p>"]
    return [head, _words(("setting", "value", "default"), changed)]


def _flat(table: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, object]]:
    for name, value in table.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{above}{name}.")
        else:
            yield f"{above}{name}", value
