"""Prior of a drive's calibration: nominal tolerances, the covariance of a board's calibration, and its baseline."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.fit.drive.rig_parameters import RigParameters
from calib.fit.drive.rig_prior import RULER_SIGMA_M, baseline_by_prior, nominal_sigmas, prior_information
from calib.rig import Rig
from calib.rig_covariance import TRANSFORM_NAMES, RigCovariance
from omnid.simulation.rendering.rigs import make_rig

NOMINAL = make_rig()
NAMES = ("lower xi", "lower fu", *TRANSFORM_NAMES)
SIGMAS = np.array([2e-3, 0.3, *[1e-4] * 5, 4e-4])


def measured_rig(correlation: float) -> Rig:
    """Return a rig whose lower xi is correlated with its baseline."""
    matrix = np.diag(SIGMAS**2)
    matrix[0, -1] = matrix[-1, 0] = correlation * SIGMAS[0] * SIGMAS[-1]
    return replace(NOMINAL, covariance=RigCovariance.of_matrix(NAMES, matrix))


def test_a_nominal_rig_has_the_tolerances_of_its_builder() -> None:
    parameters = RigParameters.about(NOMINAL, ("p1", "p2"))
    sigmas = dict(zip(parameters.names, nominal_sigmas(parameters) * parameters.units, strict=True))
    assert sigmas["lower xi"] == pytest.approx(0.02)
    assert sigmas["upper fv"] == pytest.approx(0.02 * 207.5676)
    assert sigmas["upper pu"] == pytest.approx(3.0)
    assert sigmas["r_z"] == pytest.approx(np.deg2rad(1.5))
    np.testing.assert_allclose(prior_information(parameters, NOMINAL), np.diag(nominal_sigmas(parameters) ** -2.0))


def test_a_covariance_replaces_the_tolerances_of_its_parameters() -> None:
    parameters = RigParameters.about(NOMINAL, ("p1", "p2"))
    matrix = np.linalg.inv(prior_information(parameters, measured_rig(0.0)))
    sigmas = dict(zip(parameters.names, np.sqrt(np.diag(matrix)) * parameters.units, strict=True))
    assert sigmas["lower xi"] == pytest.approx(2e-3, rel=1e-3)
    assert sigmas["r_x"] == pytest.approx(1e-4, rel=0.05)
    assert sigmas["upper xi"] == pytest.approx(0.02)


def test_the_baseline_follows_the_parameters_with_which_it_is_correlated() -> None:
    rig, names = measured_rig(0.8), ("lower xi", "lower fu", "r_x")
    change = np.array([1e-3, 0.1, 0.0])
    length, matrix = baseline_by_prior(rig, names, change, np.diag([1e-4, 0.01, 1e-5]) ** 2)
    assert length - rig.baseline_m == pytest.approx(0.8 * 4e-4 / 2e-3 * 1e-3)
    assert matrix[-1, -1] == pytest.approx((1 - 0.8**2) * 4e-4**2 + (0.8 * 4e-4 / 2e-3 * 1e-4) ** 2)
    assert matrix[0, -1] == pytest.approx(0.16 * 1e-8)


def test_the_baseline_of_a_nominal_rig_stays_with_the_error_of_a_ruler() -> None:
    length, matrix = baseline_by_prior(NOMINAL, ("lower xi",), np.array([0.01]), np.array([[1e-8]]))
    assert length == NOMINAL.baseline_m
    assert matrix[-1, -1] == pytest.approx(RULER_SIGMA_M**2)
