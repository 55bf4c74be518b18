"""Two omnidirectional cameras on one rigid body, the frame in which epipolar lines are columns, and the covariance.

Parameters of the covariance: "lower NAME" and "upper NAME" for the intrinsics, in the units of rig.toml (d of an ocam
camera moves d and e together), then TRANSFORM_NAMES. These describe the upper camera in the rectified frame, while the
rig frame stays with the lower camera: R_true = exp(r) R, viewpoint along (e_x, e_y, 1) at the distance of the baseline.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from msgspec import Meta, Struct

from calib import se3
from calib.errors import CalibError
from calib.models.camera import Array, Mask, OmniCamera
from calib.models.names import sees_directly, visible_part

SIDES = ("lower", "upper")
# Rotation [rad] and direction of the baseline [rad], in the rectified frame; length of the baseline [m].
TRANSFORM_NAMES = ("r_x", "r_y", "r_z", "e_x", "e_y", "baseline")
# Correlations and translations [m] are rounded, so that their text is exact, by which an eigenvalue may be negative.
DECIMALS, MIN_EIGENVALUE = 12, -1e-9


@dataclass(frozen=True, slots=True)
class RigCovariance:
    """Standard deviations and correlations of named parameters; parameters that were not estimated are not listed."""

    names: tuple[str, ...]
    sigmas: Array  # (P,) in the parameters' own units
    correlation: Array  # (P, P), symmetric, 1 on the diagonal

    def __post_init__(self) -> None:
        count = len(self.names)
        if not count or len(set(self.names)) != count:
            raise CalibError(f"covariance: expected different parameters, found {count}")
        if self.sigmas.shape != (count,) or self.correlation.shape != (count, count):
            raise CalibError(
                f"covariance: expected {count} sigmas and {count} x {count} correlations, found "
                f"{self.sigmas.shape} and {self.correlation.shape}"
            )
        if not (self.sigmas >= 0).all():
            raise CalibError("covariance: expected sigmas of 0 or more")
        if not (np.abs(self.correlation) <= 1).all():
            raise CalibError("covariance: expected correlations between -1 and 1")
        if np.linalg.eigvalsh(self.correlation)[0] < MIN_EIGENVALUE:
            raise CalibError("covariance: the correlations contradict each other (a negative variance)")

    @staticmethod
    def of_matrix(names: Sequence[str], matrix: Array) -> RigCovariance:
        """Return the covariance of a matrix (P, P) in the parameters' own units."""
        sigmas = np.sqrt(np.maximum(0.0, np.diag(matrix)))
        scale = np.where(sigmas > 0, sigmas, 1.0)
        correlation = np.clip(matrix / np.outer(scale, scale), -1, 1).round(DECIMALS)
        correlation = np.tril(correlation, -1) + np.tril(correlation, -1).T + np.eye(len(names))
        return RigCovariance(tuple(names), sigmas, correlation)

    @property
    def matrix(self) -> Array:
        """Return the covariance matrix (P, P) in the parameters' own units."""
        return np.asarray(self.correlation * np.outer(self.sigmas, self.sigmas))

    def select(self, names: Sequence[str]) -> RigCovariance:
        """Return the (marginal) covariance of some parameters, in their order; CalibError if one is not listed."""
        if unknown := [name for name in names if name not in self.names]:
            raise CalibError(f"covariance: no parameter {unknown[0]!r}; it has {', '.join(self.names)}")
        chosen = [self.names.index(name) for name in names]
        return RigCovariance(tuple(names), self.sigmas[chosen], self.correlation[np.ix_(chosen, chosen)])


MIN_BASELINE_M = 1e-3  # Viewpoints that are closer would show no depth.
MAX_LENGTH_M = 10.0  # of baseline and height of cameras on a robot: a larger number has another unit
# A T_base_rig that puts the cameras on the floor states no height; the identity, used without a measurement, does so.
MIN_HEIGHT_M = 0.1
# Larger numbers are refused: they are probably in ms and us.
MAX_UPPER_DELAY_S, MAX_LINE_TIME_S = 1.0, 1e-3


class ShutterTimes(Struct, frozen=True):
    """Times of exposure against the stamps: of the upper camera, and from one image row of a camera to the next.

    It is the table [times] of a rig file.
    """

    upper_delay_s: Annotated[float, Meta(ge=-MAX_UPPER_DELAY_S, le=MAX_UPPER_DELAY_S)] = 0.0
    line_time_s: Annotated[float, Meta(ge=-MAX_LINE_TIME_S, le=MAX_LINE_TIME_S)] = 0.0


@dataclass(frozen=True, slots=True)
class MountedCamera:
    """A camera on the rig: p_cam = T_cam_rig @ p_rig; mask None if it was not measured."""

    camera: OmniCamera
    T_cam_rig: Array  # (4, 4)
    mask: Mask | None = None

    @property
    def viewpoint(self) -> Array:
        """Return the camera's viewpoint (3,) [m] in the rig frame."""
        return se3.t_of(se3.inverse(self.T_cam_rig))

    @property
    def visible(self) -> Mask:
        """Return the measured mask, else the whole image of a lens, or the largest disc in a mirror's image."""
        return self.mask if self.mask is not None else visible_part(self.camera)


@dataclass(frozen=True, slots=True)
class Rig:
    """The lower and the upper camera; T_base_rig is the rig's pose on the robot; covariance None if unknown.

    The base frame lies on the floor unless the user defines it otherwise. T_base_rig = identity: pose not stated.
    """

    lower: MountedCamera
    upper: MountedCamera
    T_base_rig: Array = field(default_factory=lambda: np.eye(4))  # (4, 4)
    topics: tuple[str, str] = ("", "")  # of the lower and the upper camera's images; "" if unknown
    covariance: RigCovariance | None = None  # of the calibration
    times: ShutterTimes = field(default_factory=ShutterTimes)

    def __post_init__(self) -> None:
        for name, T in (
            ("lower T_cam_rig", self.lower.T_cam_rig),
            ("upper T_cam_rig", self.upper.T_cam_rig),
            ("T_base_rig", self.T_base_rig),
        ):
            if not se3.is_rigid(T):
                raise CalibError(f"rig: {name} must be a 4x4 rotation and translation, found {np.round(T, 4).tolist()}")
        if not MIN_BASELINE_M <= self.baseline_m <= MAX_LENGTH_M:
            raise CalibError(
                f"rig: the viewpoints must lie apart, by {MAX_LENGTH_M:g} m at most, found "
                f"{self.baseline_m * 1e3:.3f} mm; check that the transforms are T_cam_rig in metres"
            )

    @property
    def sides(self) -> tuple[tuple[str, MountedCamera], tuple[str, MountedCamera]]:
        """Return names and cameras, the lower one first."""
        return ("lower", self.lower), ("upper", self.upper)

    @property
    def baseline_m(self) -> float:
        """Return the distance of the two viewpoints [m]."""
        return float(np.linalg.norm(self.upper.viewpoint - self.lower.viewpoint))

    def height_m(self, floor_m: float = 0.0) -> float | None:
        """Return the height [m] of the lower viewpoint above the floor; None where T_base_rig does not state it.

        floor_m: height of the floor in the base frame.
        """
        height_m = float((se3.R_of(self.T_base_rig) @ self.lower.viewpoint + se3.t_of(self.T_base_rig))[2]) - floor_m
        return height_m if height_m >= MIN_HEIGHT_M else None

    def at_height(self, height_m: float) -> Rig:
        """Return the rig with its lower viewpoint at a height above the base's origin."""
        if not MIN_HEIGHT_M <= height_m <= MAX_LENGTH_M:
            raise CalibError(
                f"height of the cameras: expected {MIN_HEIGHT_M:g} to {MAX_LENGTH_M:g} m from the floor "
                f"to the lower viewpoint, found {height_m:g}"
            )
        T_base_rig = self.T_base_rig.copy()
        T_base_rig[2, 3] = height_m - float(T_base_rig[2, :3] @ self.lower.viewpoint)
        return replace(self, T_base_rig=T_base_rig)

    def with_upper_moved(self, turn: Array, direction: Array, longer_m: float = 0.0) -> Rig:
        """Return the rig with its upper camera moved in the rectified frame, the lower one kept.

        turn (3,): rotation vector [rad], R = exp(turn) R_before; direction (2,): the viewpoint lies along (e_x, e_y, 1)
        at the baseline plus longer_m.
        """
        R_rig_rect = se3.R_of(self.T_rect_rig).T
        along = np.array([*direction, 1.0]) / np.linalg.norm([*direction, 1.0])
        viewpoint = self.lower.viewpoint + (self.baseline_m + longer_m) * R_rig_rect @ along
        R_rig_upper = R_rig_rect @ se3.rotation_exp(turn) @ R_rig_rect.T @ se3.R_of(self.upper.T_cam_rig).T
        T_upper_rig = se3.inverse(se3.transform(R_rig_upper, viewpoint))
        return replace(self, upper=replace(self.upper, T_cam_rig=T_upper_rig))

    def moves_to(self, other: Rig) -> Array:
        """Return the moves (6,) in the order of TRANSFORM_NAMES by which with_upper_moved leads to another rig."""
        R_rect_rig = se3.R_of(self.T_rect_rig)
        R_rig_upper, own = se3.R_of(other.upper.T_cam_rig).T, se3.R_of(self.upper.T_cam_rig)
        turn = se3.rotation_log(R_rect_rig @ R_rig_upper @ own @ R_rect_rig.T)
        x, y, z = R_rect_rig @ (other.upper.viewpoint - other.lower.viewpoint)
        return np.array([*turn, x / z, y / z, other.baseline_m - self.baseline_m])

    @property
    def T_rect_rig(self) -> Array:
        """Return T_rect_rig (4, 4): origin in the lower viewpoint, z towards the upper one, x nearest the rig's x.

        In the rectified frame the upper viewpoint is (0, 0, baseline): T = (0, 0, t), R = I (Dang et al. 2012, III.A).
        """
        z = (self.upper.viewpoint - self.lower.viewpoint) / self.baseline_m
        forward = np.array([1.0, 0, 0]) if abs(z[0]) < 0.9 else np.array([0, 1.0, 0])
        x = forward - z * (z @ forward)
        x /= np.linalg.norm(x)
        R = np.stack([x, np.cross(z, x), z])
        return se3.transform(R, -R @ self.lower.viewpoint)


# Sine and cosine of 45 degrees, half-way to a camera that lies on its side: the largest angle between the baseline and
# the vertical axis of an image.
MAX_LEAN = np.sqrt(0.5)


def rig_between(lower: OmniCamera, upper: OmniCamera, T_lower_upper: Array, topics: tuple[str, str] = ("", "")) -> Rig:
    """Return the rig with its frame at the lower viewpoint: z to the upper one, x ahead (REP 103).

    For cameras that look to the side, x is the component of the mean optical axis perpendicular to z. For cameras that
    look along z, such as mirrors and fisheyes that see all around, x is the lower image's u axis.
    """
    baseline = float(np.linalg.norm(se3.t_of(T_lower_upper)))
    if not baseline >= MIN_BASELINE_M:
        raise CalibError(f"rig: the viewpoints must lie apart, found {baseline * 1e3:.3f} mm between them")
    z = se3.t_of(T_lower_upper) / baseline
    u, v = image_axis(lower, (1.0, 0.0)), image_axis(lower, (0.0, 1.0))
    axes = optical_axis(lower), se3.R_of(T_lower_upper) @ optical_axis(upper)
    forward = (axes[0] + axes[1]) / 2
    if np.linalg.norm(forward - z * (z @ forward)) < MAX_LEAN:
        forward = u if abs(z @ u) < 0.9 else v
    x = forward - z * (z @ forward)
    x /= np.linalg.norm(x)
    T_lower_rig = se3.transform(np.column_stack([x, np.cross(z, x), z]), np.zeros(3))
    T_upper_rig = se3.inverse(T_lower_upper) @ T_lower_rig
    return Rig(MountedCamera(lower, T_lower_rig), MountedCamera(upper, T_upper_rig), topics=topics)


def is_turned_over(rig: Rig) -> bool:
    """True if the upper viewpoint lies below the lower one, unless the cameras are mounted upside down.

    A camera below its mirror sees itself below the mirror. An upright camera that looks ahead has what is below its
    horizon in the lower part of its image. A lens that looks along the baseline may look up or down: False.
    """
    camera, z = rig.lower.camera, rig.lower.T_cam_rig[:3, 2]
    below = image_axis(camera, (0.0, 1.0)) if sees_directly(camera) else optical_axis(camera)
    return bool(z @ below > MAX_LEAN)


def mounting_notes(rig: Rig) -> list[str]:
    """Return warnings about a rig that is turned over, or whose cameras stand side by side."""
    if is_turned_over(rig):
        mounted = "stand upside down" if sees_directly(rig.lower.camera) else "look down into their mirrors"
        return [
            f"the upper camera is found below the lower one: exchange their images, unless the cameras {mounted}; "
            "the rig's z would point down"
        ]
    along = rig.lower.T_cam_rig[:3, 2] @ image_axis(rig.lower.camera, (1.0, 0.0))
    if abs(along) > MAX_LEAN:
        return [
            "the cameras are found side by side, along the rows of their images: one must stand above the other, "
            "unless both lie on their sides; the rig's z would point to the side"
        ]
    return []


def optical_axis(camera: OmniCamera) -> Array:
    """Return the unit ray (3,) of the image's centre in the camera frame."""
    return np.asarray(camera.lift(np.array([camera.center]))[0])


def image_axis(camera: OmniCamera, step_px: tuple[float, float]) -> Array:
    """Return the unit vector (3,) in the camera frame that corresponds to a step in pixels at the image's centre."""
    ends = camera.lift(np.array([np.subtract(camera.center, step_px), np.add(camera.center, step_px)]))
    axis = ends[1] - ends[0]
    if not np.isfinite(axis).all():
        raise CalibError("rig: the lower camera's model has no ray next to its centre; check its intrinsics")
    return np.asarray(axis / np.linalg.norm(axis))
