"""The report of a run: one HTML file with everything in it."""

from __future__ import annotations

from datetime import UTC, datetime
from html import escape
from pathlib import Path
from typing import Final

import numpy as np

from drivers.logs.mcap_info import LogState
from omnid import __version__
from omnid.errors import OmnidError
from omnid.formats.tum import Trajectory
from omnid.report import chart, health, plan, sections, setup, svg
from omnid.report.chart import Clock
from omnid.report.downsampling import Corner
from omnid.report.page import figure, note, page
from omnid.report.panorama_images import WantedImages, panoramas
from omnid.report.poses import MOST_KEPT
from omnid.report.report_data import ReportData
from omnid.report.timeline import timeline
from omnid.report.truth_comparison import TruthComparison, compare

_MOST_CROSSES: Final = 40
_BEFORE_S: Final = 30.0  # that are shown of the time before the first pose, where something happened
_JPEG_QUALITY: Final = 70
_STYLE: Final = """body{max-width:1060px;font-family:system-ui,sans-serif}h1{margin-bottom:.1em;overflow-wrap:anywhere}
h2{margin:1.6em 0 .4em;border-bottom:2px solid #222}.sub{color:#444;overflow-wrap:anywhere;margin-top:0}
.tiles{display:flex;flex-wrap:wrap;gap:.6em 2em;margin:1em 0}.tiles b{display:block;font-size:1.35em}
.tiles span{color:#444}.grid2{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,400px),1fr));
gap:0 1.5em;align-items:end}
figure{margin:.7em 0;position:relative;break-inside:avoid}figcaption{color:#222;min-height:1.5em}
table{margin:.6em 0}small{color:#444}
.key{white-space:nowrap;margin-left:.9em;font-size:.92em}.key svg{display:inline-block;width:34px;height:12px;
vertical-align:middle;margin-right:.3em}.scroll{overflow-x:auto}.note{border-left:4px solid #999;padding-left:.7em;
color:#333}.warn{color:#000;border-left:4px solid #000;padding-left:.7em}table{font-variant-numeric:tabular-nums}
.words td,.words th,.events td,.events th{text-align:left;vertical-align:top}
.events td:nth-child(-n+3){white-space:nowrap}.events{max-height:40em;overflow:auto;border:1px solid #ccc}
.facts tr:first-child{display:none}.events td:nth-child(2){font-weight:bold}
.lanes{overflow-x:auto}
@media(max-width:640px){body{margin:1em auto;padding:0 .7em}td,th{padding:.15em .4em}.plan svg text{font-size:22px}
.events td:nth-child(-n+3){white-space:normal}.lanes>svg{min-width:620px}}
@media print{@page{margin:14mm}body{font-size:10pt;margin:0;padding:0;max-width:none;-webkit-print-color-adjust:exact;
print-color-adjust:exact}.plan>svg{max-height:150mm}.events{font-size:8.5pt}
h2{break-after:avoid}tr{break-inside:avoid}.grid2{grid-template-columns:1fr 1fr}
.scroll{break-inside:avoid}.scroll,.events{overflow:visible;max-height:none;border:0}td,th{padding:.1em .5em}}"""


def report_html(path: Path, recording: ReportData, true: Trajectory | None = None) -> str:
    """The whole page; true: T_world_rig of the rig."""
    events = recording.events.in_order()
    before_s = min((event.start_s for event in events if event.start_s >= -_BEFORE_S), default=0.0)
    clock = Clock(min(0.0, before_s), max(recording.poses.end_s, 1e-2))
    spans = chart.spans_of(recording.poses.course["state"].points(), recording.poses.end_s)
    comparison = None if true is None else compare(recording.poses, recording.T_base_rig, true)
    top = [svg.hidden(svg.PATTERNS), chart.shades(spans, clock), *_head(path, recording),
           sections.key_figures(recording), *_warnings(recording, true),
           plan.plan_figure(_plan(recording, comparison), clock)]
    story = ["<h2>What happened</h2>", timeline(spans, recording.poses.gaps, events, clock),
             *_states_missing(recording), *sections.events_table(recording.events, clock)]
    measured = [*(sections.truth(comparison, clock) if comparison else ()), *sections.motion(recording, clock),
                *sections.sureness(recording, clock), *health.timing(recording, clock),
                *health.parts(recording, clock)]
    rest = [*_images(path, recording), *setup.setup(recording), *setup.contents(recording),
            f"<p><small>Made by omnid {__version__}.</small></p>"]
    parts = [*top, *story, *measured, *rest]
    return page(f"{recording.robot}: {path.name}", parts, svg.STYLE + plan.STYLE + _STYLE)


def _head(path: Path, recording: ReportData) -> list[str]:
    found, frames = recording.survey, recording.frames
    told = (f"{path}, {found.size_bytes / 1e6:.1f} MB, {found.state.value}. Poses of {frames[1]} in {frames[0]} on "
            f"{recording.topic}, from {_utc(recording.poses.start_ns)}.")
    return [f"<h1>Run of {escape(recording.robot)}</h1><p class='sub'>{escape(told)}</p>"]


def _utc(stamp_ns: int) -> str:
    """The time of day; bare seconds where a stamp is no Unix time of this age."""
    seconds, rest_ns = divmod(stamp_ns, 10**9)
    if not 10**9 <= seconds < 2**33:
        return f"{seconds}.{rest_ns // 10**6:03} s"
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d %H:%M:%S}.{rest_ns // 10**6:03} UTC"


def _warnings(recording: ReportData, true: Trajectory | None) -> list[str]:
    """What makes the rest of the page worth less."""
    found, poses = recording.survey, recording.poses
    lines = []
    if found.state is LogState.BROKEN:
        lines.append(f"The log is cut or corrupt after byte {found.readable_bytes} of {found.size_bytes}; "
                     "this is what could be read.")
    if found.broken:
        lines.append(f"{found.broken} corrupt chunks or records were skipped.")
    if recording.unread or poses.absurd:
        lines.append(f"{recording.unread + poses.absurd} messages were left out: not what their type says, a stamp far "
                     "from the time of logging, or a pose beyond all measure.")
    if poses.late:
        lines.append(f"{poses.late} poses were left out: not later than the one before.")
    if true is not None and recording.rig is None:
        lines.append(f"The truth is compared as if the rig were the robot's own frame: {recording.rig_fault}.")
    if true is not None and poses.poses > MOST_KEPT:
        lines.append(f"The truth is compared for the first {MOST_KEPT} of {poses.poses} poses.")
    return [f"<p class='warn'>{escape(line)}</p>" for line in lines]


def _states_missing(recording: ReportData) -> list[str]:
    if recording.poses.states[-1] < recording.poses.poses:
        return []
    return [note("The log does not tell the state of the odometry (…/status of omnid).")]


def _plan(recording: ReportData, comparison: TruthComparison | None) -> plan.Plan:
    corners, cloud = recording.poses.path.corners, recording.cloud
    drawn = cloud is not None and cloud.frame == recording.frames[0]
    points = cloud.points if cloud and drawn else np.empty((0, 3), np.float32)
    finite = np.isfinite(points).all(axis=1)
    confidence = cloud.confidence if cloud and drawn else np.empty(0, np.float32)
    height_m = float((recording.poses.first @ recording.T_base_rig)[2, 3])
    return plan.Plan(corners, points[finite], confidence[finite], height_m, comparison.path if comparison else (),
                     _losses(recording, corners))


def _losses(recording: ReportData, corners: list[Corner]) -> list[tuple[float, float]]:
    """Where the path was when the pose was lost."""
    times = np.array([corner.t_s for corner in corners])
    places = [corners[max(0, int(np.searchsorted(times, t_s, "right")) - 1)]
              for t_s in _lost_s(recording)[:_MOST_CROSSES]]
    return [(corner.x_m, corner.y_m) for corner in places]


def _lost_s(recording: ReportData) -> list[float]:
    """When the pose was lost."""
    return [event.start_s for event in recording.events.in_order() if (event.source, event.text) == ("state", "lost")]


def _images(path: Path, recording: ReportData) -> list[str]:
    if not recording.images:
        return ["<h2>What the cameras saw</h2>", note("The log holds no images.")]
    if recording.rig is None:
        return ["<h2>What the cameras saw</h2>", note(f"Images, but {recording.rig_fault}.")]
    start_ns = recording.poses.start_ns
    wanted = [WantedImages(start_ns, "The lower camera's panorama at the first pose; forward is in the middle.")]
    wanted += [WantedImages(start_ns + round(t_s * 1e9), f"The same when the pose was first lost, at {t_s:.2f} s.")
               for t_s in _lost_s(recording)[:1]]
    try:
        shown = [figure(image, caption, _JPEG_QUALITY) for image, caption in panoramas(path, recording.rig, wanted)]
    except OmnidError as error:
        shown = [note(f"The images in the log cannot be shown: {error}")]
    return ["<h2>What the cameras saw</h2>", *(shown or [note("No image could be decoded.")])]
