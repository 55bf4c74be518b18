"""Content of a recording for the report, collected in one pass and in bounded memory."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from calib import se3
from omnid.report.chart import Clock
from omnid.report.plan import plan_figure
from omnid.report.report import _plan, report_html
from omnid.report.report_data import ReportData, collect_report_data
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import ODOMETRY, Key
from tests.omnid.report.recorded_logs import (
    Entry,
    corrupt_chunks,
    map_pose,
    odom,
    run,
    save,
    state,
    status,
)


def event_texts(data: ReportData) -> list[tuple[str, str]]:
    return [(event.source, event.text) for event in data.events.in_order()]


def test_corrupt_chunks_of_a_log_with_an_index_are_counted(tmp_path: Path) -> None:
    log = save(tmp_path / "a.mcap", run(60))
    assert collect_report_data(log).corrupt == 0
    corrupt_chunks(log)
    data = collect_report_data(log)
    assert data.corrupt == 2 and 40 < data.poses.poses < 60
    page = report_html(log, data)
    assert "2 corrupt chunks or records were skipped." in page and "MB, cut or corrupt. Poses" in page


STARTED_AGAIN = ("state", "the robot was started again, with a new odom")


def straight(first: int, count: int) -> list[Entry]:
    """A drive of 0.1 m from pose to pose, from the origin of a new odom on; first: number of its first pose."""
    return [odom(first + k, se3.transform(np.eye(3), [0.1 * k, 0.0, 0.0])) for k in range(count)]


def length(pose: float, length_m: float, resets: int = 0) -> Entry:
    """A periodic report."""
    values: dict[str, str] = {Key.RESETS: str(resets), Key.LENGTH_M: f"{length_m:.2f}"}
    return status(pose, DiagnosticStatus(ODOMETRY, 0, "tracking", values))


@pytest.mark.parametrize(
    ("before", "after", "resets"),
    [
        # The length falls, a while after the start, and as the first pose comes.
        ([length(9, 0.9)], {9: length(69, 0.85), 10: length(70, 0.95)}, 0),
        ([length(9, 0.9)], {0: length(60, 0.0)}, 0),
        # The number of resets falls, and is that of the new run.
        ([state(9, "tracking", 2)], {0: state(60, "tracking", 0)}, 0),
        ([state(9, "tracking", 2)], {0: state(60, "tracking", 0), 5: state(65, "tracking", 1)}, 1),
        # Both kinds of report say so.
        ([length(9, 0.9, 2), state(9, "tracking", 2)], {0: state(60, "tracking", 0), 9: length(69, 0.3)}, 0),
    ],
)
def test_a_robot_that_was_started_again_during_the_recording_has_not_jumped_to_its_new_origin(
    tmp_path: Path, before: list[Entry], after: dict[int, Entry], resets: int
) -> None:
    """A path of 1.9 m, a pause without poses, and one of 1.9 m from the origin of a new odom."""
    entries = [*straight(-10, 20), *before]
    for k, pose in enumerate(straight(60, 20)):
        entries += [pose, *([after[k]] if k in after else [])]
    data = collect_report_data(save(tmp_path / "a.mcap", entries))
    assert data.poses.length_m == pytest.approx(2 * 1.9)
    assert event_texts(data).count(STARTED_AGAIN) == 1 and data.statuses.resets == resets
    # The plan has a line for each path, and none from one to the other.
    shown = plan_figure(_plan(data, None), Clock(0.0, data.poses.end_s))
    assert [len(re.findall("[ML]", d)) for d in re.findall(r"class='p\d' d='([^']*)'", shown)][-2:] == [20, 20]
    assert re.findall("[ML]", re.findall("class='halo' d='([^']*)'", shown)[0]).count("M") == 2


def test_a_pose_in_the_map_without_its_pose_of_odometry_is_left_out(tmp_path: Path) -> None:
    data = collect_report_data(save(tmp_path / "a.mcap", [odom(0), map_pose(1, np.eye(4)), odom(2)]))
    assert not data.map_poses.path.vertices
