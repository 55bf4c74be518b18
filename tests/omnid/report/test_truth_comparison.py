"""The comparison with a truth is that of `omnid eval`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib import se3
from calib.rig import Rig
from calib.rig_file import rig_toml
from omnid.cli import main
from omnid.formats.tum import Trajectory, read_tum, tum_row
from omnid.recordings.evaluation import evaluate
from omnid.report.report import report_html
from omnid.report.report_data import collect_report_data
from omnid.report.truth_comparison import compare_with_truth
from tests.omnid.report.pages import Page, attached_rig_of_sample
from tests.omnid.report.recorded_logs import (
    T_odom_base,
    at,
    run,
    save,
)


def test_compares_with_the_truth_as_eval_does(tmp_path: Path) -> None:
    """The rig is displaced and rotated on its base, and the truth has another world frame."""
    rig = attached_rig_of_sample()
    T_base_rig, T_world_odom = se3.exp([0.3, -0.1, 0.5, 0.1, 0.2, 1.0]), se3.exp([5, -3, 1, 0, 0, 2.0])
    text = rig_toml(Rig(rig.lower, rig.upper, T_base_rig, rig.topics)).encode()
    log = save(tmp_path / "log.mcap", run(100), {"rig.toml": text})
    drift = [se3.exp([0.001 * k, 0, 0, 0, 0, 0.0005 * k]) for k in range(100)]
    T_odom_rig = np.array([se3.inverse(T_base_rig) @ T_odom_base(k) @ T_base_rig for k in range(100)])
    truth = Trajectory(np.array([at(k) for k in range(100)]), T_world_odom @ T_odom_rig @ np.array(drift))
    data = collect_report_data(log, keep_poses=True)
    found = compare_with_truth(data.poses, data.T_base_rig, truth)
    expected = evaluate(Trajectory(truth.stamps_ns, T_odom_rig), truth)
    assert found.metrics.ate_rmse_m == pytest.approx(expected.ate_rmse_m, rel=1e-6)
    assert max(error for _, error in found.position_m.points()) == pytest.approx(expected.ate_max_m, rel=1e-6)
    assert found.heading_rad.newest == pytest.approx(expected.heading_end_rad, rel=1e-6)
    assert found.path[0] == pytest.approx((0, 0), abs=1e-9)
    assert found.path[-1] == pytest.approx(T_odom_base(99)[:2, 3], abs=0.2)
    assert "Against the truth" in Page(report_html(log, data, truth)).text


def test_refuses_a_truth_of_another_time(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, truth = save(tmp_path / "log.mcap", run(9)), tmp_path / "truth.txt"
    truth.write_text("\n".join(tum_row(k * 10**9, np.eye(4)) for k in range(5)))
    assert main(["report", str(log), "--truth", str(truth), "-o", str(tmp_path / "out.html")]) == 2
    assert "do both use the same clock" in capsys.readouterr().err
    assert read_tum(truth).stamps_ns.size == 5
