"""Cross-validation of a fitted camera on held-out views."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from calib.errors import CalibError
from calib.fit.boards.bundle import Observations, Parameters, Prior, Projection, adjust_bundle
from calib.fit.least_squares import Ending
from calib.fit.parameterisation import parameterise
from calib.models.camera import Array, OmniCamera

# Number of folds, so that three quarters of the views remain for each fit, and the least number of views with which a
# fold is fitted, because one wrong view among fewer is not noticed.
FOLDS = 4
MIN_TRAINING_VIEWS = 3


# A fold's search begins at the fit to all views, and scores are compared by a hundredth.
_fit_fold = partial(adjust_bundle, kernel_rounds=1, ending=Ending(steps=20, gain=1e-4), has_covariance=False)


def held_out_error_px(camera: OmniCamera, T_cam_board: Array, observed: Observations) -> float:
    """Return the mean error [px] of views that were left out of the fit; infinite if no fold can be fitted.

    Every fold refits the camera's parameters, starting from the fit to all views with poses T_cam_board (K, 4, 4), and
    then only the poses of the views left out.
    """
    return cross_validated_px(parameterise(camera), T_cam_board, observed)


def cross_validated_px(
    parameters: Parameters, T_cam_board: Array, observed: Observations, prior: Prior | None = None
) -> float:
    """Return the mean error [px] of views left out, for parameters about the fit to all views."""
    numbers, errors = np.arange(len(observed.pixels)), list[Array]()
    for fold in range(FOLDS):
        held_out = numbers % FOLDS == fold
        if (~held_out).sum() < MIN_TRAINING_VIEWS or not held_out.any():
            continue
        seen, left = observed.select(~held_out), observed.select(held_out)
        try:
            trained = _fit_fold(parameters, T_cam_board[~held_out], seen, prior=prior)
            fixed = FixedParameters(parameters, trained.parameters)
            found = _fit_fold(fixed, T_cam_board[held_out], left)
        except (CalibError, np.linalg.LinAlgError):
            return float("inf")
        errors.append(found.errors_px.ravel())
    return float(np.nanmean(np.concatenate(errors))) if errors else float("inf")


@dataclass(frozen=True, slots=True)
class FixedParameters:
    """A camera without unknowns: that of parameters at given steps."""

    parameters: Parameters
    steps: Array  # (P,)
    names: tuple[str, ...] = ()

    def camera_at(self, steps: Array) -> Projection:
        """Return the camera."""
        return self.parameters.camera_at(self.steps)

    def derivatives(self, steps: Array, points: Array) -> tuple[Array, Array]:
        """Return the derivatives by points (N, 3), (N, 2, 3), and by no steps, (N, 2, 0)."""
        return self.parameters.derivatives(self.steps, points)[0], np.zeros((len(points), 2, 0))
