"""The cost of a rig's errors: named in per cent of length and degrees, and nothing where they cost nothing."""

from __future__ import annotations

import math

import pytest

from calib.fit.residual_structure import ResidualStructure
from calib.fit.rig_uncertainty import DriveUncertainty
from omnid.calibration.accuracy_notes import accuracy_warnings

NOISE, MISFIT = ResidualStructure(0.01, 0.2), ResidualStructure(0.14, 0.2)


def lines(scale: float | None, *structures: ResidualStructure) -> list[str]:
    drives = None if scale is None else DriveUncertainty(scale, math.radians(0.01))
    return accuracy_warnings(structures, drives, "add 6 pairs with the board higher")


def test_what_costs_nothing_is_no_warning() -> None:
    assert lines(0.0005, MISFIT, MISFIT) == [] and lines(0.0005, NOISE, NOISE) == []


@pytest.mark.parametrize(("scale", "part"), [(0.001, "0.2 %"), (0.0015, "0.3 %"), (0.01, "2 %")])
def test_a_misfit_is_named_by_what_it_costs(scale: float, part: str) -> None:
    (line,) = lines(scale, NOISE, MISFIT)
    assert line.startswith("upper camera: ") and "systematic residuals of 0.140 px" in line
    assert f"wrong by {part} of their length and by 0.02 degree of heading per metre" in line
    assert line.endswith("do not use it where that matters") == (scale >= 0.0015)


@pytest.mark.parametrize(("scale", "part"), [(0.0006, "0.12 %"), (0.002, "0.4 %")])
def test_noise_that_costs_more_than_a_thousandth_says_which_views_are_missing(scale: float, part: str) -> None:
    (line,) = lines(scale, NOISE, NOISE)
    assert line.startswith(f"the images leave something open: drives may be wrong by {part}")
    assert line.endswith("; add 6 pairs with the board higher")


def test_given_cameras_are_judged_by_their_residuals() -> None:
    assert lines(None, NOISE, NOISE) == []
    assert lines(None, MISFIT, NOISE)[0].startswith("lower camera: the camera model does not describe this camera")
