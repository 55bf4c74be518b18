"""The report of a recorded run: one self-contained HTML page."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Final

import numpy as np

from drivers.logs.log import LogState
from omnid.errors import OmnidError
from omnid.formats.plan import drawn_heights
from omnid.formats.tum import Trajectory
from omnid.report import chart, health, plan, sections, setup, svg
from omnid.report.chart import Clock
from omnid.report.downsampling import Corner
from omnid.report.page import figure, note, page
from omnid.report.page_script import chart_script
from omnid.report.panorama_images import WantedImages, panoramas
from omnid.report.poses import MAX_KEPT
from omnid.report.report_data import ReportData
from omnid.report.timeline import timeline
from omnid.report.truth_comparison import TruthComparison, compare_with_truth
from omnid.utc import utc
from omnid.version import __version__

_MOST_CROSSES: Final = 40
_MAX_BEFORE_S: Final = 30.0  # time before the first pose that is shown, where there are events in it
_JPEG_QUALITY: Final = 70
_STYLE: Final = """.sub{color:#444;overflow-wrap:anywhere;margin-top:0}
.numbers{display:flex;flex-wrap:wrap;gap:.6em 2em;margin:1em 0}.numbers b{display:block;font-size:1.35em}
.numbers span{color:#444}.grid2{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(100%,400px),1fr));
gap:0 1.5em;align-items:end}
.key{white-space:nowrap;margin-left:.9em;font-size:.92em}.key svg{display:inline-block;width:34px;height:12px;
vertical-align:middle;margin-right:.3em}.scroll{overflow-x:auto}
.words td,.words th,.events td,.events th{text-align:left;vertical-align:top}
.events td:nth-child(-n+3){white-space:nowrap}.events{max-height:40em;overflow:auto;border:1px solid #ccc}
.facts tr:first-child{display:none}.events td:nth-child(2){font-weight:bold}
.lanes{overflow-x:auto}
@media(max-width:640px){.plan svg text{font-size:calc(22px*var(--px,1))}.chart svg text{font-size:16px}
.events td:nth-child(-n+3){white-space:normal}.lanes>svg{min-width:620px}}
@media print{@page{margin:14mm}body{font-size:10pt;margin:0;padding:0;max-width:none;-webkit-print-color-adjust:exact;
print-color-adjust:exact}.plan>svg{max-height:150mm}.events{font-size:8.5pt}
h2{break-after:avoid}tr{break-inside:avoid}.grid2{grid-template-columns:1fr 1fr}
.scroll{break-inside:avoid}.scroll,.events{overflow:visible;max-height:none;border:0}td,th{padding:.1em .5em}}"""


def report_html(path: Path, data: ReportData, true: Trajectory | None = None) -> str:
    """Return the page; true: T_world_rig of the rig."""
    events = data.events.in_order()
    before_s = min((event.start_s for event in events if event.start_s >= -_MAX_BEFORE_S), default=0.0)
    clock = Clock(min(0.0, before_s), max(data.poses.end_s, 1e-2))
    spans = chart.spans_of(data.poses.series["state"].points(), data.poses.end_s)
    comparison = None if true is None else compare_with_truth(data.poses, data.T_base_rig, true)
    top = [
        svg.hidden(svg.PATTERNS),
        chart.shades(spans, clock),
        *_head(path, data),
        sections.key_figures(data),
        *_warnings(data, true),
        plan.plan_figure(_plan(data, comparison), clock),
    ]
    story = [
        "<h2>Events</h2>",
        timeline(spans, data.poses.gaps, events, clock),
        *_states_missing(data),
        *sections.events_table(data.events, clock),
    ]
    measured = [
        *(sections.truth(comparison, clock) if comparison else ()),
        *sections.motion(data, clock),
        *sections.uncertainty(data, clock),
        *sections.in_map(data, clock),
        *health.timing(data, clock),
        *health.parts(data, clock),
    ]
    rest = [
        *_images(path, data),
        *setup.setup(data),
        *setup.contents(data),
        f"<p><small>Made by omnid {__version__}.</small></p>",
    ]
    parts = [*top, *story, *measured, *rest]
    return page(f"{data.robot}: {path.name}", parts, svg.STYLE + plan.STYLE + _STYLE, chart_script())


def _head(path: Path, data: ReportData) -> list[str]:
    found, frames = data.info, data.frames
    state = LogState.BROKEN if data.corrupt and found.state is LogState.WHOLE else found.state
    facts = (
        f"{path}, {found.size_bytes / 1e6:.1f} MB, {state.value}. Poses of {frames[1]} in {frames[0]} on "
        f"{data.topic}, from {utc(data.poses.start_ns)}."
    )
    return [f"<h1>Run of {escape(data.robot)}</h1><p class='sub'>{escape(facts)}</p>"]


def _warnings(data: ReportData, true: Trajectory | None) -> list[str]:
    """Return what is missing or doubtful in the log."""
    found, poses = data.info, data.poses
    lines = []
    if found.state is LogState.BROKEN:
        lines.append(
            f"The log is cut or corrupt after byte {found.readable_bytes} of {found.size_bytes}; "
            "this is what could be read."
        )
    if data.corrupt:
        lines.append(f"{data.corrupt} corrupt chunks or records were skipped.")
    if data.unreadable or poses.out_of_range:
        lines.append(
            f"{data.unreadable + poses.out_of_range} messages were left out: not of their type, with a stamp "
            "far from the time of logging, or with a pose out of range."
        )
    if poses.late:
        lines.append(f"{poses.late} poses were left out: not later than the one before.")
    if true is not None and data.rig is None:
        lines.append(f"The truth is compared as if the rig's frame were base_link: {data.rig_fault}.")
    if true is not None and poses.poses > MAX_KEPT:
        lines.append(f"The truth is compared for the first {MAX_KEPT} of {poses.poses} poses.")
    return [f"<p class='warn'>{escape(line)}</p>" for line in lines]


def _states_missing(data: ReportData) -> list[str]:
    if data.poses.states[-1] < data.poses.poses:
        return []
    return [note("The log does not hold the state of the odometry (…/status of omnid).")]


def _plan(data: ReportData, comparison: TruthComparison | None) -> plan.Plan:
    corners, cloud = data.poses.path.with_end(), data.cloud
    drawn = cloud is not None and cloud.frame == data.frames[0]
    points = cloud.points if cloud and drawn else np.empty((0, 3), np.float32)
    finite = np.isfinite(points).all(axis=1)
    confidence = cloud.confidence if cloud and drawn else np.empty(0, np.float32)
    height_m = float((data.poses.first @ data.T_base_rig)[2, 3])
    return plan.Plan(
        corners,
        points[finite],
        confidence[finite],
        height_m,
        drawn_heights((data.rig and data.rig.height_m()) or 0.0),
        comparison.path if comparison else (),
        sections.path_in_map(data),
        _losses(data, corners),
        data.poses.restarts_s,
    )


def _losses(data: ReportData, corners: list[Corner]) -> list[tuple[float, float]]:
    """Return the positions on the path at which the pose was lost."""
    times = np.array([corner.t_s for corner in corners])
    places = [corners[max(0, int(np.searchsorted(times, t_s, "right")) - 1)] for t_s in _lost_s(data)[:_MOST_CROSSES]]
    return [(corner.x_m, corner.y_m) for corner in places]


def _lost_s(data: ReportData) -> list[float]:
    """Return the times at which the pose was lost."""
    return [event.start_s for event in data.events.in_order() if (event.source, event.text) == ("state", "lost")]


def _images(path: Path, data: ReportData) -> list[str]:
    if not data.has_images:
        return ["<h2>Images</h2>", note("The log holds no images.")]
    if data.rig is None:
        return ["<h2>Images</h2>", note(f"Images, but {data.rig_fault}.")]
    start_ns = data.poses.start_ns
    wanted = [WantedImages(start_ns, "The lower camera's panorama at the first pose; forward is in the middle.")]
    wanted += [
        WantedImages(start_ns + round(t_s * 1e9), f"The same when the pose was first lost, at {t_s:.2f} s.")
        for t_s in _lost_s(data)[:1]
    ]
    try:
        shown = [figure(image, caption, _JPEG_QUALITY) for image, caption in panoramas(path, data.rig, wanted)]
    except OmnidError as error:
        shown = [note(f"The images in the log cannot be shown: {error}")]
    return ["<h2>Images</h2>", *(shown or [note("No image could be decoded.")])]
