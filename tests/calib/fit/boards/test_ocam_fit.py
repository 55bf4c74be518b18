"""Fit of polynomial cameras: of the toolbox's degree, of a higher one, with tangential terms."""

from __future__ import annotations

import numpy as np
import pytest

from calib.fit.boards.ocam_fit import (
    DEGREE,
    add_tangential,
    fit_ocam,
    ocam_factory,
    ocam_parameters,
    ocam_structure,
    raise_degree,
)
from tests.calib.fit.boards.seen_boards import OCAM, SIZE, observed_boards


def test_exact_corners_give_the_camera_back() -> None:
    poses, observed = observed_boards()
    fit = fit_ocam(observed, SIZE)
    camera = ocam_factory(SIZE, "mirror")(fit.parameters)
    assert fit.mean_px < 1e-3 and np.allclose(camera.center, OCAM.center, atol=1e-2)
    assert np.allclose(camera.polynomial, OCAM.polynomial, rtol=1e-2, atol=1e-12)
    assert np.allclose(fit.T_cam_board[:, :3, 3], poses[:, :3, 3], atol=1e-4)
    names = [name for name, _, _ in ocam_parameters(fit, SIZE)]
    values = dict(zip(names, [value for _, value, _ in ocam_parameters(fit, SIZE)], strict=True))
    assert names == ["a0", "a2", "a3", "a4", "center_row", "center_column", "c", "d = e"]
    assert values["c"] == pytest.approx(OCAM.affine[0], abs=1e-4) and values["a0"] == pytest.approx(
        OCAM.polynomial[0], rel=1e-3
    )


def test_more_terms_start_from_the_fit_without_them() -> None:
    _, observed = observed_boards(noise_px=0.1)
    fit = fit_ocam(observed, SIZE)
    camera = ocam_factory(SIZE, "mirror")(fit.parameters)
    assert ocam_structure(camera) == (DEGREE, False)
    higher, tangential = raise_degree(fit, observed, camera), add_tangential(fit, observed, camera)
    assert len(higher.parameters) == len(fit.parameters) + 1 and len(tangential.parameters) == len(fit.parameters) + 2
    assert ocam_structure(ocam_factory(SIZE, "mirror", DEGREE + 1)(higher.parameters)) == (DEGREE + 1, False)
    assert ocam_structure(ocam_factory(SIZE, "mirror", tangential=True)(tangential.parameters)) == (DEGREE, True)
    assert max(higher.cost, tangential.cost) <= fit.cost * 1.01
