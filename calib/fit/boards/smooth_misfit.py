"""Covariance of a fit whose model does not describe the cameras exactly.

The error of a camera model is a smooth function of the image position, the same in all views. Most of it is absorbed
by the parameters, which it shifts; what remains correlates the residuals, and this correlation shows its size. So
residuals have the covariance sigma^2 I + tau^2 F F^T, where the columns of F are smooth fields: gradients of Gaussian
functions on a grid. A mirror or lens whose surface is not the model's deflects rays by the gradient of the
difference of the surfaces, so such fields have no swirl: they move elevations, and hardly turn a camera about its axis.

tau^2 is the mean of its posterior distribution by the restricted likelihood (Patterson and Thompson 1971) with a flat
prior of tau / sigma (Gelman 2006): the most likely value of few data is often 0.
"""

from __future__ import annotations

import numpy as np

from calib.models.camera import Array

# Nodes of the fields along the diameter of the seen part of an image: five follow three waves over the azimuth and a
# turning point over the radius. Each field is as wide as the distance of two nodes.
NODES = 5
# Values of tau / sigma over which the posterior is summed: steps of 4 % are fine enough for any ratio.
RATIOS = np.concatenate([[0.0], np.geomspace(1e-3, 30.0, 240)])
# Smaller eigenvalues of what the fields explain beyond the parameters, as a fraction of the largest, are rounding.
MIN_EIGENVALUE_RATIO = 1e-3


def smooth_fields(pixels: Array, cameras: int) -> Array:
    """Return the fields (K, N, 2, F) at pixels (K, N, 2), of which equal parts belong to each camera.

    Rows of unknown pixels (NaN) are 0. The sum of all fields has about unit size.
    """
    K, N, _ = pixels.shape
    own, width = [], 2 / (NODES - 1)
    for part in np.split(pixels, cameras, axis=1):
        known = part[np.isfinite(part).all(axis=2)]
        center = known.mean(axis=0)
        radius = float(np.linalg.norm(known - center, axis=1).max())
        line = np.linspace(-1, 1, NODES)
        nodes = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
        away = ((part[:, :, None] - center) / radius - nodes) / width
        gaussian = np.exp(-0.5 * (away**2).sum(axis=3, keepdims=True))
        own.append(np.nan_to_num(-away * gaussian).swapaxes(2, 3))
    counts = [each.shape[3] for each in own]
    fields = np.zeros((K, N, 2, sum(counts)))
    first, size = 0, N // cameras
    for camera, values in enumerate(own):
        fields[:, camera * size : (camera + 1) * size, :, first : first + counts[camera]] = values
        first += counts[camera]
    return fields


def covariance_with_misfit(normal: Array, gradient: Array, parameters: int, variance: float) -> Array:
    """Return the covariance (P, P) of the parameters.

    normal (P + F, P + F), gradient (P + F,): of the weighted residuals by parameters and fields, poses eliminated, at
    the fit's minimum; variance: sigma^2 of a coordinate [px^2].
    """
    P = parameters
    inverse = np.linalg.pinv(normal[:P, :P], rcond=1e-14, hermitian=True)
    # What the fields explain beyond the parameters: y ~ N(0, sigma^2 d + tau^2 d^2) along each eigenvector.
    by_field = normal[P:, :P] @ inverse
    unexplained = normal[P:, P:] - by_field @ normal[:P, P:]
    d, axes = np.linalg.eigh((unexplained + unexplained.T) / 2)
    known = d > MIN_EIGENVALUE_RATIO * max(float(d[-1]), 1.0)
    d, y = d[known], (axes.T @ (gradient[P:] - by_field @ gradient[:P]))[known]
    # The posterior mean of (tau / sigma)^2.
    spread = variance * (d + RATIOS[:, None] ** 2 * d**2)
    cost = (np.log(spread) + y**2 / spread).sum(axis=1)
    weight = np.exp(-0.5 * (cost - cost.min())) * np.gradient(RATIOS)
    ratio2 = float(weight @ RATIOS**2 / weight.sum()) if len(d) else 0.0
    # The fit does not know the fields: each shifts the parameters by its row of by_field, which has the prior tau.
    return np.asarray(variance * (inverse + ratio2 * by_field.T @ by_field))
