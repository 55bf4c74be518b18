"""The report of a recorded run: one self-contained HTML page. Text from the log is escaped where it enters HTML."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from html import escape
from itertools import pairwise

import numpy as np

from calib import se3
from omnid.formats.plan import Lines, between, draw_plan, drawn_heights, image_of, shares_of
from omnid.formats.tum import Trajectory
from omnid.plain_text import MAX_ENTRIES, utc
from omnid.recordings.evaluation import associate, evaluate
from omnid.recordings.recording import DRIVE, TWIST_COMMAND
from omnid.report.page import Array, Curve, chart, colours, embedded, grid, note, page, style_and_script, table
from omnid.report.recorded_run import LEVELS, STATES, UNKNOWN, Event, RecordedRun
from omnid.transport import status_names
from omnid.transport.status_names import CAPTURE_TO_POSE, ODOMETRY, STAGE_PREFIX, WORK, Key, short_name
from omnid.version import __version__


def report_html(run: RecordedRun, true: Trajectory | None = None) -> str:
    """Return the page; true: T_world_rig of the rig. Raise OmnidError where its stamps match no pose."""
    events = run.events()
    end_s = max(run.end_s, 1e-2)
    # The spans with one state, which are shaded in the charts: begin, end and rank.
    begins = np.flatnonzero(np.diff(run.ranks, prepend=UNKNOWN))
    ends_s = np.append(run.t_s[begins[1:]], run.end_s)
    spans = zip(run.t_s[begins].tolist(), ends_s.tolist(), run.ranks[begins].tolist(), strict=False)
    shown = {"start": 0.0, "end": end_s, "spans": [span for span in spans if span[2] > 0]}
    parts = [
        f"<main data-run='{json.dumps(shown)}'>",
        *_head(run),
        *_plan(run, events),
        "<p class='note'>Point at a chart: values, and the place on the plan. Drag across a chart: zoom; double-click: "
        "all.</p>",
        "<h2>Events</h2>",
        *(() if (run.ranks != UNKNOWN).any() else [note("The log does not hold the state of the odometry.")]),
        *_events_table(events),
        *(f"<h2>{title}</h2>{''.join(section)}" for title, section in _sections(run, true)),
        f"<p><small>Made by omnid {__version__}.</small></p></main>",
    ]
    style, script = style_and_script()
    return page(f"{run.robot}: {run.path.name}", parts, style, script)


def _head(run: RecordedRun) -> list[str]:
    """Return the title, the key figures, and warnings."""
    count, end_s = len(run.t_s), run.end_s
    source = (
        f"{run.path}, {run.log.size_bytes / 1e6:.1f} MB, {run.log.state}. Poses of {run.frames[1]} in "
        f"{run.frames[0]} on {run.topic}, from {utc(run.start_ns)}."
    )
    rate = f", {(count - 1) / end_s:.1f}/s" if end_s > 0 else ""
    tiles = [("duration", _time(end_s)), ("path", f"{run.length_m():.2f} m"), ("poses", f"{count}{rate}")]
    known = run.ranks[run.ranks != UNKNOWN]
    if len(known):
        tiles += [(name, f"{100 * (known == rank).mean():.1f} %") for rank, name in enumerate(STATES)]
        tiles.append(("resets", str(run.resets)))
    cells = "".join(f"<div><b>{escape(value)}</b><span>{escape(name)}</span></div>" for name, value in tiles)
    # What is missing or doubtful in the log.
    lines = {
        f"The log is cut or corrupt: {run.log.cut}.": run.log.cut,
        f"{len(run.log.faults)} corrupt chunks or records were skipped.": run.log.faults,
        f"{run.left_out} messages were left out: not of their type, out of range, or not in order.": run.left_out,
    }
    return [
        f"<h1>Run of {escape(run.robot)}</h1><p class='sub'>{escape(source)}</p>",
        f"<div class='numbers'>{cells}</div>",
        *(f"<p class='warn'>{escape(line)}</p>" for line, applies in lines.items() if applies),
    ]


def _truth_section(run: RecordedRun, truth: Trajectory) -> list[str]:
    """Return the errors of the rig's poses, as `omnid eval` prints them, and over time; the first pose is aligned."""
    T_rig_base, tolerance_s = se3.inverse(run.T_base_rig), 0.01
    stamps_ns = run.start_ns + np.rint(run.t_s * 1e9).astype(np.int64)
    T_estimate = T_rig_base @ run.T_odom_base @ run.T_base_rig
    metrics = evaluate(Trajectory(stamps_ns, T_estimate), truth, tolerance_s)
    of_run, of_truth = associate(stamps_ns, truth.stamps_ns, round(tolerance_s * 1e9))
    T_estimate, T_true, t_s = T_estimate[of_run], truth.T[of_truth], run.t_s[of_run]
    T_true = T_estimate[0] @ se3.inverse(T_true[0]) @ T_true
    position_m = np.linalg.norm((T_estimate - T_true)[:, :, -1], axis=1)
    heading_rad = se3.yaw(se3.inverse(T_true) @ T_estimate)
    figures = [
        chart("Error of the position", [Curve("", t_s, position_m)], unit="m"),
        chart("Error of the heading, to the left", [Curve("", t_s, np.rad2deg(heading_rad))], "deg"),
    ]
    facts = table(("", ""), [re.split(" {2,}", line, maxsplit=1) for line in escape(str(metrics)).splitlines()])
    return [f"<div class='words facts'>{facts}</div>", grid(figures)]


def _plan(run: RecordedRun, events: Sequence[Event]) -> list[str]:
    """Return the figure of map and path, with crosses where the pose was lost; the pointer relates it to the charts."""
    # 1. The points of the map between the floor and what is above the robot.
    points, confidence = np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
    if run.cloud is not None and run.cloud.frame == run.frames[0]:
        points, confidence = run.cloud.points, np.clip(np.nan_to_num(run.cloud.confidence), 0.0, 1.0)
    height_m = float((run.T_odom_base[0] @ run.T_base_rig)[2, -1])
    low_m, high_m = drawn_heights(run.height_m)
    points_xy, confidence = between(points, confidence, (height_m + low_m, height_m + high_m))
    # 2. The lines: a stretch of the path for each state; the worse the state, the thicker the line.
    xy, colour = run.xyz[:, :2], colours()
    stretches: dict[int, list[Array]] = {}
    breaks = {0, len(xy), *(np.flatnonzero(np.diff(run.ranks)) + 1).tolist()}
    for first, last in pairwise(sorted(breaks)):
        stretches.setdefault(int(run.ranks[first]), []).append(xy[max(0, first - 1) : last])
    lines = [Lines([run.map_xy], colour["map"], 1.5), Lines([xy], "white", 6.5)]
    lines += [
        Lines(parts, colour[_path_name(rank)], 2 + 1.5 * max(rank, 0)) for rank, parts in sorted(stretches.items())
    ]
    axes = draw_plan(points_xy, confidence, lines, xy)
    # 3. Losses.
    lost_s = [event.start_s for event in events if (event.source, event.text) == ("state", STATES[-1])]
    axes.plot(*xy[np.searchsorted(run.t_s, lost_s[:MAX_ENTRIES])].T, "kx", markersize=11, markeredgewidth=2)
    # 4. The figure, with the positions of at most 1000 poses for the pointer.
    chosen = np.unique(np.linspace(0, len(xy) - 1, 1000).astype(int))
    places = np.column_stack([run.t_s[chosen], shares_of(axes, xy[chosen])]).round(4).tolist()
    named = {_path_name(rank): f"the path, {STATES[rank]}" if rank >= 0 else "the path" for rank in stretches}
    is_hidden = run.map_xy.shape == xy.shape and np.allclose(run.map_xy, xy)  # below the path of odometry
    named |= {"map": "in the map"} if len(run.map_xy) and not is_hidden else {}
    keys = [f"<span class='key'><i class='p-{name}'></i>{words}</span>" for name, words in named.items()]
    keys += ["<span class='key'>✕ lost here</span>"] if lost_s else []
    footnote = (
        f"Grey: {len(points_xy)} of the map's {len(points)} points, those from {-low_m:g} m below the rig's height at "
        f"the start to {high_m:g} m above it; they stand out by their confidence and number in a column."
    )
    return [
        f"<figure class='plan'><figcaption><b>Path and map</b>{''.join(keys)}</figcaption><div class='sheet' "
        f"data-plan='{json.dumps(places, separators=(',', ':'))}'>{embedded(image_of(axes), 'png')}<i hidden></i></div>"
        f"<small>{footnote if len(points) else 'The log holds no map that can be drawn.'}</small></figure>"
    ]


def _path_name(rank: int) -> str:
    """Return the name of the path's colour in the style sheet, by the rank of a state."""
    return str(STATES[rank]) if rank >= 0 else "tracking"


def _events_table(events: Sequence[Event]) -> list[str]:
    """Return the table of events in the order of time."""
    if not events:
        return ["<p>No events: no change of state, no gap, no loss.</p>"]
    rows = []
    for event in events[:MAX_ENTRIES]:
        start, end = (_time(at_s) for at_s in (event.start_s, event.end_s))
        text = f"{event.text} ({event.count})" if event.count else event.text
        times = start if start == end else f"{start} to {end}"
        rows.append((times, LEVELS[event.level], escape(event.source), escape(text)))
    more = [note(f"and {len(events) - MAX_ENTRIES} more")] if len(events) > MAX_ENTRIES else []
    return ["<div class='events'>", table(("time", "", "part", "event (count)"), rows), "</div>", *more]


def _time(seconds: float) -> str:
    """Return a time as the charts show it."""
    return f"{seconds:.2f}".rstrip("0").rstrip(".") + " s"


def _rounded(text: str) -> str:
    """Return a number with fewer digits; "" for a text that is no number."""
    value = status_names.number(text)
    return "" if value is None else f"{value:.3g}" if value < 100 else f"{value:.0f}"


def _sections(run: RecordedRun, true: Trajectory | None) -> Iterator[tuple[str, list[str]]]:
    """Yield title and parts of each section of charts and tables; a part is HTML, "" where the log has nothing."""
    # 1. Errors of the path.
    if true is not None:
        yield "Against the truth", _truth_section(run, true)
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
    position_m, heading_rad = (
        np.sqrt(np.where(variance > 0, variance, np.nan))  # A variance that is not positive was not set.
        for variance in (run.variances[:, :3].sum(axis=1), run.variances[:, -1])
    )
    title, landmarks = "Standard deviation of the", {"tracked": Key.TRACKED, "inliers of the pose": Key.INLIERS}
    figures = [
        chart(f"{title} position, all axes", [Curve("", run.t_s, position_m)], "m", log=True),
        chart(f"{title} heading", [Curve("", run.t_s, np.rad2deg(heading_rad))], "deg", log=True),
    ]
    figures.append(chart("Landmarks", [run.curve(name, ODOMETRY, key) for name, key in landmarks.items()]))
    yield "Uncertainty", [grid(figures)]
    # 4. Rates, latencies, the stages' times, and counters of all other parts.
    stages = {name.removeprefix(STAGE_PREFIX): run.values(name) for name in run.newest if name.startswith(STAGE_PREFIX)}
    rows = []
    for name, values in stages.items():
        times = (_rounded(values.get(f"{WORK}_{statistic}_ms", "")) for statistic in ("p50", "p99", "max"))
        counts = (values.get(key, "") for key in (Key.PROCESSED, Key.RATE_HZ, Key.DROPPED))
        rows.append((name, *counts, *times))
    titles = ("stage", "messages", "per second, last", "dropped", "p50 ms", "p99 ms", "max ms")
    latency = {"median": "p50", "99th percentile": "p99"}
    curves = [run.curve(name, ODOMETRY, f"{CAPTURE_TO_POSE}_{p}_ms") for name, p in latency.items()]
    figures = [
        chart("Poses per second", [run.curve("", ODOMETRY, Key.RATE_HZ)]),
        chart("From the image to its pose", curves, "ms", note="Of all messages since the start of the run."),
    ]
    if rows or any(figures):
        yield "Times and losses", [_text_table(titles, rows) if rows else "", grid(figures)]
    if rows := [
        (short_name(name), entry.message, ", ".join(f"{key} {value}" for key, value in entry.values.items()))
        for name, entry in run.newest.items()
        if name != ODOMETRY and not name.startswith(STAGE_PREFIX)
    ]:
        yield "Cameras, pairing, wheels", [_text_table(("part", "at the last report", "counters"), rows)]


def _text_table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table of texts of the log."""
    cells = [[escape(cell) for cell in row] for row in rows]
    return f"<div class='words scroll'>{table(titles, cells)}</div>"
