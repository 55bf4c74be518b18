"""What limits a calibrated rig: the cost of its errors."""

from __future__ import annotations

import math

import pytest

from calib.fit.residual_structure import ResidualStructure
from calib.fit.rig_uncertainty import DriveUncertainty
from omnid.calibration.rig import accuracy_warnings

NOISE, MISFIT = ResidualStructure(0.01, 0.2), ResidualStructure(0.14, 0.2)


def lines(scale: float | None, *structures: ResidualStructure) -> list[str]:
    drives = None if scale is None else DriveUncertainty(scale, math.radians(0.01))
    return accuracy_warnings(structures, drives)


@pytest.mark.parametrize(("scale", "part"), [(0.001, "0.2 %"), (0.0015, "0.3 %"), (0.01, "2 %")])
def test_a_misfit_is_named_by_what_it_costs(scale: float, part: str) -> None:
    (line,) = lines(scale, NOISE, MISFIT)
    assert line.startswith("upper camera: ") and "systematic residuals of 0.140 px" in line
    assert f"wrong by {part} of their length and by 0.02 degree of heading per metre" in line
    assert line.endswith("do not use it where that matters") == (scale >= 0.0015)


def test_errors_that_cost_little_are_no_warning_and_others_ask_for_pairs() -> None:
    assert lines(0.0005, MISFIT, MISFIT) == lines(0.0005, NOISE, NOISE) == lines(None, NOISE, NOISE) == []
    assert lines(None, MISFIT, NOISE)[0].startswith("lower camera: the camera model does not describe this camera")
    (line,) = lines(0.0006, NOISE, NOISE)
    assert line.startswith("the images leave something open: drives may be wrong by 0.12 %")
    assert line.endswith("; add pairs where the tables say `no board`")
