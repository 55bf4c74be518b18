"""The plan of a report."""

from __future__ import annotations

from pathlib import Path

import pytest

from calib.rig_file import rig_toml
from omnid.report.report import _plan
from omnid.report.report_data import collect_report_data
from tests.omnid.report.pages import attached_rig_of_sample
from tests.omnid.report.recorded_logs import (
    run,
    save,
)


def test_the_plan_draws_what_is_above_the_floor_where_the_rig_states_its_height(tmp_path: Path) -> None:
    """The floor filled the plans of robots whose cameras are lower than a metre."""
    rig = attached_rig_of_sample()
    for height_m, low_m in ((0.9, -0.8), (1.5, -1.0)):
        files = {"rig.toml": rig_toml(rig.at_height(height_m)).encode()}
        data = collect_report_data(save(tmp_path / "a.mcap", run(3), files))
        assert _plan(data, None).heights_m == pytest.approx((low_m, 1.5))
    without = collect_report_data(save(tmp_path / "a.mcap", run(3)))
    assert _plan(without, None).heights_m == (-1.0, 1.5)
