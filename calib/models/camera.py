"""The interface of central omnidirectional cameras: project, lift, and the mask of the image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
# Newton steps that invert a distortion: mild ones take 3 to 5, strong ones 10. Points whose relative error is larger
# than CONVERGED_PART after them have no ray; a millionth of the error of a corner is allowed.
NEWTON_STEPS, CONVERGED_PART = 12, 1e-9


class OmniCamera(Protocol):
    """A central omnidirectional camera; pixel centres are integers, u right, v down."""

    @property
    def size(self) -> tuple[int, int]:
        """Return the image's (width, height) [px]."""

    @property
    def center(self) -> tuple[float, float]:
        """Return the pixel (u, v) of the model's axis."""

    def project(self, points: Array) -> Array:
        """Return pixels (N, 2) of points (N, 3) in the camera frame; NaN for points without an image."""

    def lift(self, pixels: Array) -> Array:
        """Return unit rays (N, 3) in the camera frame of pixels (N, 2); NaN for pixels without a ray."""


@dataclass(frozen=True, slots=True)
class Mask:
    """The part of an image that shows the world: a ring about a centre, without the pixels that are 0 in image.

    center (u, v) [px]; inner_px and outer_px bound the radius; image (H, W) uint8, 0 = not the world.
    """

    center: tuple[float, float]
    inner_px: float = 0.0
    outer_px: float = float("inf")
    image: NDArray[np.uint8] | None = None

    def contains(self, pixels: Array, margin_px: float = 0.0) -> NDArray[np.bool_]:
        """True (N,) for pixels (N, 2) inside, at least margin_px away from rim and hub."""
        radius = np.hypot(pixels[:, 0] - self.center[0], pixels[:, 1] - self.center[1])
        inner = self.inner_px + margin_px if self.inner_px > 0 else 0.0
        inside = (radius >= inner) & (radius <= self.outer_px - margin_px)
        if self.image is None:
            return inside
        height, width = self.image.shape
        finite = np.asarray(np.isfinite(pixels).all(axis=1))
        column, row = np.rint(np.where(finite[:, None], pixels, -1)).astype(int).T
        inside &= finite & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        return np.asarray(inside & (self.image[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)] > 0))


def inside_image(camera: OmniCamera, pixels: Array) -> NDArray[np.bool_]:
    """True (N,) for pixels (N, 2) on the camera's image; False for NaN."""
    width, height = camera.size
    u, v = pixels[:, 0], pixels[:, 1]
    return np.asarray((u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1))


def undistorted(
    distort: Callable[[Array, Array], tuple[Array, Array]],
    jacobian: Callable[[Array, Array], tuple[Array, Array, Array]],
    target: tuple[Array, Array],
) -> tuple[Array, Array]:
    """Return x, y (N,) that a distortion moves to a target, by Newton steps; NaN for points without convergence.

    jacobian: the terms xx, xy, yy of the symmetric derivative of the distortion.
    """
    x, y = (part.copy() for part in target)
    with np.errstate(all="ignore"):
        for _ in range(NEWTON_STEPS):
            bent_x, bent_y = distort(x, y)
            off_x, off_y = bent_x - target[0], bent_y - target[1]
            xx, xy, yy = jacobian(x, y)
            determinant = xx * yy - xy * xy
            x, y = x - (yy * off_x - xy * off_y) / determinant, y - (xx * off_y - xy * off_x) / determinant
        bent_x, bent_y = distort(x, y)
        found = np.hypot(bent_x - target[0], bent_y - target[1]) < CONVERGED_PART * (1 + np.hypot(*target))
    return np.where(found, x, np.nan), np.where(found, y, np.nan)
