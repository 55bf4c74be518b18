"""The covariance of a rig in rig.toml: exact round trips, names, hostile tables."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.fit.parameters import central_names
from calib.models.camera import Array
from calib.rig import Rig
from calib.rig_covariance import TRANSFORM_NAMES, RigCovariance
from calib.rig_file import parse_rig, rig_toml


def names_of(rig: Rig) -> tuple[str, ...]:
    sides = (("lower", rig.lower), ("upper", rig.upper))
    return (
        *(f"{side} {name}" for side, mounted in sides for name in central_names(mounted.camera)),
        *TRANSFORM_NAMES,
    )


def random_matrix(count: int) -> Array:
    """Return a covariance whose variances span 16 orders of magnitude."""
    rng = np.random.default_rng(3)
    factor = rng.standard_normal((count, count)) * np.logspace(-8, 0, count)[:, None]
    return np.asarray(factor @ factor.T)


def test_round_trip_is_exact(rig: Rig) -> None:
    names = names_of(rig)
    matrix = random_matrix(len(names))
    text = rig_toml(replace(rig, covariance=RigCovariance.of_matrix(names, matrix)))
    found = parse_rig(text).covariance
    assert found is not None and found.names == names
    np.testing.assert_allclose(found.matrix, matrix, rtol=0, atol=1e-11 * np.diag(matrix).max())
    np.testing.assert_allclose(found.sigmas**2, np.diag(matrix), rtol=1e-12)
    assert rig_toml(parse_rig(text)) == text
    assert parse_rig(rig_toml(rig)).covariance is None
