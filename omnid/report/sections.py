"""The sections of the report, each a list of HTML; what comes from the log is escaped here."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import Final

from omnid.report.against_truth import Comparison
from omnid.report.chart import Clock, Line, chart
from omnid.report.events import Event, Events
from omnid.report.page import table
from omnid.report.poses import STATES
from omnid.report.recording import Recording
from omnid.report.setup import rig_rows, unusual
from omnid.report.statuses import ODOMETRY, STAGE, SUMMARY, StatusCourse, short
from omnid.report.svg import label
from omnid.report.thinned import Thinned

MOST_TOPICS: Final = 60
_FLOW: Final = ("pair", "dewarp", "stereo", "odometry", "mapping", "record")  # whose times are drawn
_TIMES: Final = ("work_p50_ms", "work_p99_ms", "work_max_ms")
_LEVELS: Final = ("", "warning", "error")
NO_STATUS: Final = ("No reports of the daemon's parts are in this log, so rates, times of stages, latencies, drops and "
                    "camera faults are not known: `omnid replay --record` writes none, `omnid run` with record.enabled "
                    "does.")


def grid(figures: Sequence[str]) -> str:
    """Figures side by side where there is room."""
    return f"<div class='grid2'>{''.join(figures)}</div>" if any(figures) else ""


def note(words: str) -> str:
    """A remark about what is missing."""
    return f"<p class='note'>{escape(words)}</p>"


def key_figures(recording: Recording) -> str:
    """The run in a few numbers."""
    poses, statuses = recording.poses, recording.statuses
    rate_hz = (poses.poses - 1) / poses.end_s if poses.end_s > 0 else math.nan
    tiles = [("duration", _duration(poses.end_s)), ("path", f"{poses.length_m:.2f} m"),
             ("poses", f"{poses.poses}, {rate_hz:.1f}/s" if rate_hz > 0 else str(poses.poses)),
             *_shares(recording)]
    odometry = statuses.values(ODOMETRY)
    if "capture_to_pose_p50_ms" in odometry:
        p50, p99 = (_number(odometry.get(f"capture_to_pose_{p}_ms", "")) for p in ("p50", "p99"))
        tiles.append(("picture to pose, p50 / p99", f"{p50} / {p99} ms"))
    cells = "".join(f"<div><b>{escape(value)}</b><span>{escape(name)}</span></div>" for name, value in tiles)
    return f"<div class='tiles'>{cells}</div>"


def _shares(recording: Recording) -> Iterator[tuple[str, str]]:
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
    return ["<div class='events'>", table(("when", "", "who", "what"), rows), "</div>", *more]


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
    if not event.count:
        return event.text
    return f"{event.text}, {event.count} times" if event.count > 1 else f"{event.text}, once"


def motion(recording: Recording, clock: Clock) -> list[str]:
    """Speed, yaw rate and height; what the wheels were told along with it."""
    course, drives = recording.poses.course, recording.drives
    speed, yaw_rate = [_line("measured", course["speed"])], [_line("measured", course["yaw_rate"])]
    for kind, name in (("told", "told to the wheels"), ("asked", "asked of the robot")):
        if kind in drives:
            speed.append(_line(name, drives[kind].speed))
            yaw_rate.append(_line(name, drives[kind].yaw_rate))
    figures = [chart("Forward speed", speed, clock, unit="m/s", zero=True),
               chart("Yaw rate, to the left", yaw_rate, clock, unit="deg/s", zero=True),
               chart("Height of the robot", [_line("", course["height"])], clock, unit="m")]
    missing = [] if drives else [note("The log holds no commands to the wheels (…/drive, …/cmd/twist).")]
    return ["<h2>Motion</h2>", grid(figures), *missing]


def sureness(recording: Recording, clock: Clock) -> list[str]:
    """Deviations out of the covariances, and the landmarks."""
    course, statuses = recording.poses.course, recording.statuses
    found, agree = (statuses.series(ODOMETRY, name) for name in ("found", "agree"))
    position, heading = [_line("", course["sigma_position"])], [_line("", course["sigma_heading"])]
    figures = [chart("Standard deviation of the position, all axes", position, clock, unit="m", log=True),
               chart("Standard deviation of the heading", heading, clock, unit="deg", log=True)]
    missing = [] if any(figures) else [note("The covariances in the log are zero or negative: nobody set them.")]
    if found.count > 2 and statuses.reports:
        figures.append(chart("Landmarks", [_line("found", found), _line("that agree with the pose", agree)], clock,
                             zero=True, note="Once for each report, not for each pose."))
    else:
        missing.append(note(_few_landmarks(found, agree)))
    return ["<h2>How sure it is</h2>", grid(figures), *missing]


def _few_landmarks(found: Thinned, agree: Thinned) -> str:
    if not found.count:
        return "The log holds no numbers of landmarks."
    told = ", ".join(f"{a:.0f} of {f:.0f} at {label(round(t, 2))} s" for (t, a), (_, f) in
                     list(zip(agree.points(), found.points(), strict=False))[:12])
    return f"Landmarks that agree with the pose are told only where the state changes: {told}."


def timing(recording: Recording, clock: Clock) -> list[str]:
    """Rates, latencies and the stages' times."""
    statuses = recording.statuses
    if not statuses.reports:
        return ["<h2>Times and losses</h2>", *_summary(statuses), note(NO_STATUS)]
    p50, p99 = (statuses.series(ODOMETRY, f"capture_to_pose_{p}_ms") for p in ("p50", "p99"))
    stages = [name for name in _FLOW if statuses.series(STAGE + name, "work_p50_ms").count]
    figures = [
        chart("Poses a second", [_line("", statuses.series(ODOMETRY, "rate_hz"))], clock, zero=True),
        chart("Age of the newest pose at each report", [_line("", statuses.series(ODOMETRY, "age_s"))], clock,
              unit="s", zero=True),
        chart("From the picture to its pose", [_line("median", p50), _line("99 of 100", p99)], clock, unit="ms",
              zero=True, note="Of all poses from the start of the run until then."),
        chart("Median work of a stage", [_line(name, statuses.series(STAGE + name, "work_p50_ms")) for name in stages],
              clock, unit="ms", log=True, note="Of all messages from the start of the run until then."),
        chart("Messages dropped, deadlines missed, so far", _losses(statuses), clock, zero=True)]
    return ["<h2>Times and losses</h2>", *_summary(statuses), _stage_table(statuses), grid(figures)]


def _losses(statuses: StatusCourse) -> list[Line]:
    found = [(statuses.series(STAGE + name, key), f"{name}, {key}") for name, _ in statuses.stages()
             for key in ("dropped", "missed")]
    worst = sorted((course.newest, name, course) for course, name in found if course.newest > 0)[::-1][:6]
    return [_line(name, course) for _, name, course in worst]


def _stage_table(statuses: StatusCourse) -> str:
    rows = [(escape(name), *(escape(values.get(key, "")) for key in ("processed", "rate_hz")),
             _lost(values), *(_number(values.get(key, "")) for key in _TIMES)) for name, values in statuses.stages()]
    head = ("stage", "messages", "a second, last", "dropped or missed", "p50 ms", "p99 ms", "max ms")
    remark = "<small>At the last report. The work of a camera's stage is its wait for the next picture.</small>"
    return f"<div class='scroll'>{table(head, rows)}</div>{remark}" if rows else ""


def _lost(values: Mapping[str, str]) -> str:
    found = values.get("dropped", values.get("missed", ""))
    return f"<b>{escape(found)}</b>" if found not in ("", "0") else escape(found)


def _summary(statuses: StatusCourse) -> list[str]:
    """What a replay counted up at its end."""
    rows = [(escape(name), escape(value)) for name, value in statuses.values(SUMMARY).items()]
    return ["<p>Counted at the end of the run:</p>", _facts(rows)] if rows else []


def parts(recording: Recording, clock: Clock) -> list[str]:
    """Cameras, pairing and wheels: counters at the end, and rates."""
    statuses = recording.statuses
    names = [name for name in statuses.newest if name not in (ODOMETRY, SUMMARY) and not name.startswith(STAGE)]
    if not names:
        return []
    rows = [(escape(short(name)), escape(statuses.newest[name].message),
             ", ".join(f"{escape(key)} {escape(value)}" for key, value in statuses.values(name).items()))
            for name in names]
    rates = [_line(short(name), statuses.series(name, "rate_hz")) for name in names
             if statuses.series(name, "rate_hz").count]
    late = [_line(name, statuses.series("omnid: wheels", f"{key}_ms")) for name, key in
            (("99 of 100", "tick_late_p99"), ("the worst", "tick_late_max"))]
    figures = [chart("Pictures a second", rates, clock, zero=True),
               chart("Lateness of the wheels' tick, so far", late, clock, unit="ms", zero=True)]
    return ["<h2>Cameras, pairing, wheels</h2>", "<div class='words scroll'>",
            table(("part", "at the last report", "counters then"), rows), "</div>", grid(figures)]


def truth(comparison: Comparison, clock: Clock) -> list[str]:
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
    figures = [chart("Error of the position", [Line("", position)], clock, unit="mm", zero=True),
               chart("Error of the heading, to the left", [Line("", heading)], clock, unit="deg", zero=True)]
    remark = "<small>Of the rig; the first pose is aligned and nothing else, as `omnid eval` does.</small>"
    return ["<h2>Against the truth</h2>", _facts(rows), remark, grid(figures)]


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.2f} mm" if abs(metres) < 1 else f"{metres:.3f} m"


def _deg(rad: float) -> str:
    return f"{math.degrees(rad):.3f}°"


def setup(recording: Recording) -> list[str]:
    """The rig, and the settings that are not the usual ones."""
    rig = [_facts([(name, escape(value)) for name, value in rig_rows(recording.rig)])] if recording.rig else \
        [note(recording.rig_fault)]
    settings = recording.attachments.get("omnid.toml")
    found = None if settings is None else unusual(settings)
    if found is None:
        told = [note("No settings are attached." if settings is None else "The attached settings cannot be read.")]
    elif not found:
        told = ["<p>All settings are the usual ones.</p>"]
    else:
        rows = [tuple(map(escape, row)) for row in found]
        told = ["<div class='words scroll'>", table(("setting", "here", "usual"), rows), "</div>"]
    return ["<h2>Rig and settings</h2>", *rig, *told]


def contents(recording: Recording) -> list[str]:
    """The topics of the file."""
    topics = list(recording.survey.topics.items())
    rows = [(escape(name), escape(kind), str(count)) for name, (kind, count) in topics[:MOST_TOPICS]]
    more = [note(f"and {len(topics) - MOST_TOPICS} more topics")] if len(topics) > MOST_TOPICS else []
    attached = ", ".join(f"{name} ({size} bytes)" for name, size in recording.survey.attachments.items())
    return ["<h2>What is in the file</h2>", "<div class='words scroll'>", table(("topic", "type", "messages"), rows),
            "</div>", *more, f"<p>Attached: {escape(attached or 'nothing')}.</p>"]


def _facts(rows: Sequence[tuple[str, str]]) -> str:
    return f"<div class='words facts'>{table(('', ''), rows)}</div>"


def _line(name: str, course: Thinned) -> Line:
    return Line(name, course.points())


def _number(told: str) -> str:
    """A number as the daemon told it, a little shorter."""
    try:
        return f"{float(told):.3g}" if float(told) < 100 else f"{float(told):.0f}"
    except ValueError:
        return ""
