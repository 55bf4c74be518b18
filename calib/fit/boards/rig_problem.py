"""The unknowns of a rig that saw boards: both cameras, the transform between them, the shape of the print."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from calib import se3
from calib.boards.board import CalibrationBoard
from calib.boards.print_shape import PrintShape
from calib.fit.boards.bundle import Observations, Prior
from calib.fit.boards.relative_pose import ViewPair
from calib.fit.boards.telecentric_mirror import RADIUS_NAME, TelecentricMirror
from calib.fit.parameterisation import CameraParameterisation, parameterise
from calib.models.camera import Array, OmniCamera
from calib.models.ocam import ASTIGMATISM_NAMES, has_wavefront, project_near
from calib.models.wavefront import WAVEFRONT_NAMES
from calib.rig_covariance import TRANSFORM_NAMES

# Prior of the terms of real mirrors, because they are about one step: secondary astigmatism by about a pixel,
# wavefronts by a millimetre, or by what a TelecentricMirror says.
MIRROR_NAMES, MIRROR_SIGMA_STEPS = (*ASTIGMATISM_NAMES, *WAVEFRONT_NAMES, RADIUS_NAME), 1.0
# The lower and the upper camera.
Sides = tuple[OmniCamera, OmniCamera]
SideParameterisation = CameraParameterisation | TelecentricMirror
# A board, and the shape of its print whose free modes are fitted.
Printed = tuple[CalibrationBoard, PrintShape]


@dataclass(frozen=True, slots=True)
class PairView:
    """The views of a board at one instant by both cameras, or by only one of them."""

    name: str
    seen: ViewPair  # by the lower and the upper camera


@dataclass(frozen=True, slots=True)
class PairCamera:
    """Both cameras as one: of every 2N points of a view the lower camera projects the first N, the upper the others."""

    lower: OmniCamera
    upper: OmniCamera
    T_upper_lower: Array
    corners: int

    def project(self, points: Array) -> Array:
        """Return pixels (M, 2) of points (M, 3) in the lower camera's frame."""
        both = points.reshape(-1, 2, self.corners, 3)
        lower = project_near(self.lower, both[:, 0].reshape(-1, 3))
        upper = project_near(self.upper, se3.apply(self.T_upper_lower, both[:, 1].reshape(-1, 3)))
        return np.stack([pixels.reshape(-1, self.corners, 2) for pixels in (lower, upper)], axis=1).reshape(-1, 2)


@dataclass(frozen=True, slots=True)
class RigParameterisation:
    """Parameterisation of a rig: steps of both cameras and of the transform between them."""

    parameterisations: tuple[SideParameterisation, SideParameterisation]
    T_upper_lower: Array
    units: Array  # (6,) one step of the transform [m, rad]
    corners: int

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the steps."""
        lower, upper = self.parameterisations
        return (*lower.names, *upper.names, *TRANSFORM_NAMES)

    @property
    def ends(self) -> tuple[int, int, int]:
        """Return the end indices of the lower camera's, the upper camera's and the transform's steps."""
        lower, upper = (len(side.names) for side in self.parameterisations)
        return lower, lower + upper, lower + upper + 6

    @property
    def prior(self) -> Prior:
        """Return the prior of the terms of real mirrors, about 0."""
        center, sigma = np.zeros(self.ends[-1]), np.full(self.ends[-1], np.inf)
        for side, first in zip(self.parameterisations, (0, self.ends[0]), strict=True):
            for k, name in enumerate(side.names):
                if name in MIRROR_NAMES:
                    center[first + k], sigma[first + k] = -side.start[k] / side.units[k], MIRROR_SIGMA_STEPS
        return Prior(center, sigma)

    def derivatives(self, steps: Array, points: Array) -> tuple[Array, Array]:
        """Return the derivatives of both cameras' pixels by points (M, 3), (M, 2, 3), and by the steps, (M, 2, P).

        The transform's are those of a further small motion: its own steps differ from it by an invertible matrix.
        """
        lower_end, upper_end, end = self.ends
        lower, upper = self.parameterisations
        T_upper_lower = se3.exp(steps[upper_end:] * self.units) @ self.T_upper_lower
        both = points.reshape(-1, 2, self.corners, 3)
        own = both[:, 0].reshape(-1, 3), se3.apply(T_upper_lower, both[:, 1].reshape(-1, 3))
        by_point, by_steps = np.zeros((*both.shape[:3], 2, 3)), np.zeros((*both.shape[:3], 2, end))
        shape = (len(both), self.corners, 2, -1)
        lower_by_point, lower_by_steps = lower.derivatives(steps[:lower_end], own[0])
        upper_by_point, upper_by_steps = upper.derivatives(steps[lower_end:upper_end], own[1])
        by_point[:, 0] = lower_by_point.reshape(shape)
        by_point[:, 1] = (upper_by_point @ T_upper_lower[:3, :3]).reshape(shape)
        by_steps[:, 0, ..., :lower_end] = lower_by_steps.reshape(shape)
        by_steps[:, 1, ..., lower_end:upper_end] = upper_by_steps.reshape(shape)
        by_twist = np.concatenate([upper_by_point, -upper_by_point @ se3.hat(own[1])], axis=2) * self.units
        by_steps[:, 1, ..., upper_end:] = by_twist.reshape(shape)
        return by_point.reshape(-1, 2, 3), by_steps.reshape(-1, 2, end)

    def camera_at(self, steps: Array) -> PairCamera:
        """Return both cameras at the steps."""
        lower_end, upper_end, _ = self.ends
        lower, upper = self.parameterisations
        T_upper_lower = se3.exp(steps[upper_end:] * self.units) @ self.T_upper_lower
        return PairCamera(
            lower.camera_at(steps[:lower_end]), upper.camera_at(steps[lower_end:upper_end]), T_upper_lower, self.corners
        )

    def plain_values(self, steps: Array) -> list[tuple[tuple[str, float], ...]]:
        """Return names and values of the parameters of the lower and the upper camera at the steps."""
        lower_end, upper_end, _ = self.ends
        parts = (steps[:lower_end], steps[lower_end:upper_end])
        return [
            tuple(zip(side.names, side.plain_values(part).tolist(), strict=False))
            for side, part in zip(self.parameterisations, parts, strict=True)
        ]

    def plain_by_steps(self, steps: Array) -> Array:
        """Return the derivatives of the plain values and of the transform's twist [m, rad] by the steps."""
        lower_end, upper_end, _ = self.ends
        parts = (steps[:lower_end], steps[lower_end:upper_end])
        sides = [side.plain_by_steps(part) for side, part in zip(self.parameterisations, parts, strict=True)]
        return np.asarray(scipy.linalg.block_diag(*sides, np.diag(self.units)))


def rig_unknowns(
    board: CalibrationBoard,
    cameras: Sides,
    T_upper_lower: Array,
    T_lower_board: Array,
    *,
    telecentric: bool,
) -> RigParameterisation:
    """Return the parameterisation about cameras and T_upper_lower.

    telecentric: the cameras are those of mirrors below telecentric lenses. T_lower_board (K, 4, 4): poses of the board,
    whose median distance gives the size of a step.
    """
    reach = float(np.median(np.linalg.norm(T_lower_board[:, :3, 3], axis=1)))
    # One step of the transform moves the image by about a pixel: the focal length is about a quarter of the image.
    units = np.repeat([reach, 1.0], 3) / (min(cameras[0].size) / 4)
    sides: list[SideParameterisation] = [
        TelecentricMirror.about(camera) if telecentric else parameterise(camera, wavefront=has_wavefront(camera))
        for camera in cameras
    ]
    return RigParameterisation((sides[0], sides[1]), T_upper_lower, units, len(board.points))


def rig_observations(good: Sequence[PairView], printed: Printed, *, fixed: bool = False) -> Observations:
    """Return the corners (K, 2N, 2) of both cameras, the lower one's first; fixed: the print has no unknown modes."""
    board, shape = printed
    none = np.full((len(board.points), 2), np.nan)
    pixels = np.array([np.concatenate([none if seen is None else seen.pixels for seen in view.seen]) for view in good])
    modes = None if fixed else shape.modes(board.points)
    return Observations(
        pixels,
        np.tile(shape.points(board.points), (2, 1)),
        cameras=2,
        modes=None if modes is None else np.tile(modes, (2, 1, 1)),
    )
