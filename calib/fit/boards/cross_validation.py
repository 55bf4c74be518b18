"""Cross-validation of a fitted camera on held-out views."""

from __future__ import annotations

import numpy as np

from calib.errors import CalibError
from calib.fit.boards.bundle import CameraFactory, Observations, Prior, Projection, adjust_bundle
from calib.fit.parameterisation import parameterise
from calib.models.camera import Array, OmniCamera

# Number of folds, so that three quarters of the views remain for each fit, and the least number of views with which a
# fold is fitted, because one wrong view among fewer is not noticed.
FOLDS = 4
MIN_TRAINING_VIEWS = 3
NO_PARAMETERS = np.zeros(0)


def held_out_error_px(camera: OmniCamera, T_cam_board: Array, observed: Observations) -> float:
    """Return the mean error [px] of views that were left out of the fit; infinite if no fold can be fitted.

    Every fold refits the camera's parameters, starting from the fit to all views with poses T_cam_board (K, 4, 4), and
    then only the poses of the views left out.
    """
    parameters = parameterise(camera)
    return cross_validated_px(parameters.camera_at, len(parameters.names), T_cam_board, observed)


def cross_validated_px(
    camera_of: CameraFactory, count: int, T_cam_board: Array, observed: Observations, prior: Prior | None = None
) -> float:
    """Return the mean error [px] of views left out, for cameras of count parameters, 0 at the fit to all views."""
    numbers, errors = np.arange(len(observed.pixels)), list[Array]()
    for fold in range(FOLDS):
        held_out = numbers % FOLDS == fold
        if (~held_out).sum() < MIN_TRAINING_VIEWS or not held_out.any():
            continue
        try:
            trained = adjust_bundle(
                camera_of,
                np.zeros(count),
                T_cam_board[~held_out],
                observed.select(~held_out),
                kernel_rounds=1,
                prior=prior,
            )
            fitted = camera_of(trained.parameters)
        except (CalibError, np.linalg.LinAlgError):
            return float("inf")
        errors.append(_pose_errors_px(fitted, T_cam_board[held_out], observed.select(held_out)))
    return float(np.nanmean(np.concatenate(errors))) if errors else float("inf")


def _pose_errors_px(camera: Projection, T_cam_board: Array, observed: Observations) -> Array:
    """Return the errors (N,) of a fixed camera after the poses have been adjusted."""
    found = adjust_bundle(lambda _: camera, NO_PARAMETERS, T_cam_board, observed, kernel_rounds=1)
    return found.errors_px.ravel()
