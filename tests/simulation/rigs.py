"""Rigs of lenses, of ray-traced mirrors, nominal rigs, and rigs that are wrong; images of any of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.models.camera import Array, Mask, OmniCamera
from calib.models.lens import DoubleSphereCamera, EquidistantCamera
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera, Rig
from omnid.core.compiled import compiled
from omnid.simulation.rendering.ray_caster import Floats, cached_rays, render_grey, render_rays, sample_pixels
from omnid.simulation.rendering.surfaces import Scene
from omnid.simulation.robot import HORIZON, R_RIG_CAM, RIM, TOPICS

# Distance below the focus from which the camera's parallel rays start.
START_M = 1.0
# Newton iterations of the projection, step of its derivatives, and its tolerance.
PROJECT_STEPS, DIFFERENCE_PX, TOLERANCE = 12, 0.01, 1e-9


@dataclass(frozen=True, slots=True)
class MirrorCamera:
    """An orthographic camera that looks up at a convex mirror with focal parameter parameter_m (radius of the horizon).

    tilt_rad: rotation of the camera about x and y, relative to the mirror; conic 1 + k and ellipticity e: deviation of
    the mirror from the paraboloid. horizon_px: radius of the horizon of the nominal mirror.
    """

    horizon_px: float
    center: tuple[float, float]
    size: tuple[int, int]
    parameter_m: float = 0.03
    tilt_rad: tuple[float, float] = (0.0, 0.0)
    conic: float = 0.0
    ellipticity: float = 0.0

    def rays(self, pixels: Array) -> tuple[Array, Array]:
        """Return origins (N, 3) [m] on the mirror and unit directions (N, 3) of pixels (N, 2); NaN off the mirror."""
        scale = self.parameter_m / self.horizon_px
        x, y = -(pixels[:, 0] - self.center[0]) * scale, (pixels[:, 1] - self.center[1]) * scale
        R = se3.rotation_exp([*self.tilt_rad, 0.0])
        start = np.column_stack([x, y, np.full(len(x), START_M)]) @ R.T
        beam = -R[:, 2]
        origin = start + self._distance(start, beam)[:, None] * beam
        normal = self._normal(origin)
        return origin, beam - 2 * (normal @ beam)[:, None] * normal

    def lift(self, pixels: Array) -> Array:
        """Return unit ray directions (N, 3) of pixels (N, 2)."""
        return self.rays(np.asarray(pixels, float))[1]

    def project(self, points: Array) -> Array:
        """Return pixels (N, 2) of points (N, 3) [m], by Newton steps on the ray that passes through the point."""
        points = np.asarray(points, float)
        unit = points / np.linalg.norm(points, axis=1, keepdims=True)
        nominal = unit[:, :2] / (1 + unit[:, 2:])
        pixels = np.asarray(self.center) + self.horizon_px * nominal * (-1, 1)
        for _ in range(PROJECT_STEPS):
            error = self._miss(pixels, points)
            columns = [
                (self._miss(pixels + step, points) - self._miss(pixels - step, points)) / (2 * DIFFERENCE_PX)
                for step in DIFFERENCE_PX * np.eye(2)
            ]
            J = np.stack(columns, axis=-1)
            step = np.einsum("nij,nj->ni", np.linalg.pinv(np.nan_to_num(J)), error)
            pixels = pixels - step
            if np.nanmax(np.abs(step), initial=0.0) < TOLERANCE:
                break
        return np.asarray(pixels)

    def _miss(self, pixels: Array, points: Array) -> Array:
        """Return the difference (N, 3) of the pixels' ray directions and the directions from the mirror to points."""
        origin, direction = self.rays(pixels)
        wanted = points - origin
        return np.asarray(direction - wanted / np.linalg.norm(wanted, axis=1, keepdims=True))

    def _distance(self, start: Array, beam: Array) -> Array:
        """Return the distance (N,) along the beam to the first point of the mirror."""
        h, stretch = self.parameter_m, np.array([1 + self.ellipticity, 1.0])
        across, rise = beam[:2] * stretch, -beam[2]
        xy, w = start[:, :2] * stretch, h / 2 - start[:, 2]
        a = across @ across + self.conic * rise * rise
        b = 2 * (xy @ across) - 2 * h * rise + 2 * self.conic * w * rise
        c = (xy**2).sum(axis=1) - 2 * h * w + self.conic * w * w
        root = b * b - 4 * a * c
        return np.asarray(2 * c / (-b + np.sqrt(np.where(root >= 0, root, np.nan))))

    def _normal(self, origin: Array) -> Array:
        """Return the unit normals (N, 3) of the mirror."""
        w = self.parameter_m / 2 - origin[:, 2]
        gradient = np.column_stack(
            [(1 + self.ellipticity) ** 2 * origin[:, 0], origin[:, 1], self.parameter_m - self.conic * w]
        )
        return np.asarray(gradient / np.linalg.norm(gradient, axis=1, keepdims=True))


# Deviation of real mirrors: tilt of a camera below its mirror, shape, centre of the image.
TILT_RAD, SHAPE, CENTRE_PX = np.deg2rad(0.7), 0.015, 3.0


def make_rig(
    *,
    size: int = 768,
    scale: float = 1.0,
    baseline_m: float = 0.2,
    rim: float = RIM,
    xi: float = 1.0,
    misaligned_deg: tuple[float, float, float] = (0, 0, 0),
    offset_mm: tuple[float, float] = (0, 0),
    lower_misaligned_deg: tuple[float, float, float] = (0, 0, 0),
    lower_offset_mm: tuple[float, float] = (0, 0),
    distortion: tuple[float, float, float, float] = (0, 0, 0, 0),
    centre_px: tuple[float, float] = (0, 0),
) -> Rig:
    """Return a rig with its frame at the lower viewpoint, z up, unless lower_* are given.

    misaligned_deg: rotation vector of the upper camera, in the rig frame, about its viewpoint, which lies offset_mm
    (x, y) off the axis. scale: horizon radius; rim: mirror radius as fraction of size; centre_px moves the optical
    centre (and the rim) off the image's centre.
    """
    focal = HORIZON * size * scale * (xi if xi > 0 else 1.0)
    centre = ((size - 1) / 2 + centre_px[0], (size - 1) / 2 + centre_px[1])
    camera = UnifiedCamera(xi, (-focal, focal), centre, (size, size), distortion)
    mask = Mask(centre, 0.0, rim * size)
    lower = MountedCamera(camera, camera_pose(lower_misaligned_deg, (*lower_offset_mm, 0.0)), mask)
    upper = MountedCamera(camera, camera_pose(misaligned_deg, (*offset_mm, 1e3 * baseline_m)), mask)
    return Rig(lower, upper, topics=TOPICS)


def camera_pose(misaligned_deg: tuple[float, float, float], viewpoint_mm: tuple[float, float, float]) -> Array:
    """Return T_cam_rig (4, 4) of a camera that is turned about its viewpoint."""
    R = se3.rotation_exp(np.deg2rad(misaligned_deg)) @ R_RIG_CAM
    return se3.inverse(se3.transform(R, 1e-3 * np.array(viewpoint_mm)))


def with_real_mirrors(rig: Rig, seed: int, amount: float = 1.0) -> Rig:
    """Return the rig with ray-traced mirrors: cameras tilted below them, shapes off the paraboloid, centres off.

    amount: part of TILT_RAD, SHAPE and CENTRE_PX; the cameras' viewpoints become the foci of the nominal mirrors.
    """
    rng = np.random.default_rng([seed, 11])
    return replace(rig, lower=_real_mirror(rig.lower, rng, amount), upper=_real_mirror(rig.upper, rng, amount))


def _real_mirror(mounted: MountedCamera, rng: np.random.Generator, amount: float) -> MountedCamera:
    """Tilt is TILT_RAD in any direction; conic and ellipticity are up to SHAPE."""
    camera = mounted.camera
    assert isinstance(camera, UnifiedCamera) and camera.xi == 1 and mounted.mask is not None
    direction = rng.uniform(0, 2 * np.pi)
    tilt = amount * TILT_RAD * np.array([np.cos(direction), np.sin(direction)])
    conic, ellipticity = amount * SHAPE * rng.uniform(-1, 1, 2)
    u, v = np.array(camera.center) + amount * rng.uniform(-CENTRE_PX, CENTRE_PX, 2)
    mirror = MirrorCamera(
        abs(camera.focal[0]), (u, v), camera.size, tilt_rad=(tilt[0], tilt[1]), conic=conic, ellipticity=ellipticity
    )
    return MountedCamera(mirror, mounted.T_cam_rig, replace(mounted.mask, center=(u, v)))


def nominal_rig(rig: Rig) -> Rig:
    """Return what the builder of a rig of ray-traced mirrors knows, without masks.

    xi = 1, centre of the image, focal length by the mirror's data sheet and its rim in the image (to half a pixel),
    cameras upright one above the other, and the distance of their viewpoints by ruler (to half a millimetre).
    """
    cameras = []
    for mounted in (rig.lower, rig.upper):
        mirror, rim = mounted.camera, mounted.visible
        assert isinstance(mirror, MirrorCamera)
        focal = mirror.horizon_px * (round(2 * rim.outer_px) / 2) / rim.outer_px
        centre = ((mirror.size[0] - 1) / 2, (mirror.size[1] - 1) / 2)
        cameras.append(UnifiedCamera(1.0, (-focal, focal), centre, mirror.size))
    ruler_mm = round(2e3 * rig.baseline_m) / 2
    lower, upper = (
        MountedCamera(camera, camera_pose((0, 0, 0), (0, 0, height_mm)))
        for camera, height_mm in zip(cameras, (0.0, ruler_mm), strict=True)
    )
    return Rig(lower, upper, rig.T_base_rig, rig.topics)


def with_upper_rotated(rig: Rig, turn_deg: tuple[float, float, float]) -> Rig:
    """Return the rig whose upper camera would have to rotate by turn_deg, in the rectified frame, to be correct."""
    R = rig.T_rect_rig[:3, :3]
    T_rig_upper = se3.inverse(rig.upper.T_cam_rig)
    back = R.T @ se3.rotation_exp(-np.deg2rad(turn_deg)) @ R
    T = se3.transform(back @ T_rig_upper[:3, :3], T_rig_upper[:3, 3])
    return replace(rig, upper=replace(rig.upper, T_cam_rig=se3.inverse(T)))


# A camera that looks ahead: its z is the rig's x, its x the rig's -y, its y the rig's -z.
R_RIG_AHEAD = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])


def lens(model: str, field_deg: float, size: tuple[int, int] = (640, 480)) -> OmniCamera:
    """Return a lens whose image is field_deg wide; "pinhole" has radial distortion and less than 130 degrees."""
    centre, half_px = ((size[0] - 1) / 2 + 2.3, (size[1] - 1) / 2 - 1.7), (size[0] - 1) / 2
    edge = np.array([[np.sin(np.deg2rad(field_deg) / 2), 0, np.cos(np.deg2rad(field_deg) / 2)]])

    def made(focal: float) -> OmniCamera:
        if model == "pinhole":
            return UnifiedCamera(0.0, (focal, focal), centre, size, (-0.03, 0.004, 2e-4, -1e-4))
        if model == "ds":
            return DoubleSphereCamera(-0.2, 0.6, (focal, focal), centre, size)
        return EquidistantCamera((0.01, -0.002, 0.0, 0.0), (focal, focal), centre, size)

    return made(half_px / float(made(1.0).project(edge)[0, 0] - centre[0]))


def lens_rig(
    camera: OmniCamera,
    *,
    baseline_m: float = 0.2,
    heading_deg: float = 0.0,
    misaligned_deg: tuple[float, float, float] = (0.4, -0.3, 0.5),
) -> Rig:
    """Return two equal lenses one above the other that look at heading_deg; the upper one is misaligned."""
    R = se3.rotation_exp(np.deg2rad([0.0, 0.0, heading_deg])) @ R_RIG_AHEAD
    R_upper = se3.rotation_exp(np.deg2rad(misaligned_deg)) @ R
    lower, upper = (
        MountedCamera(camera, se3.inverse(se3.transform(turned, np.array([0.0, 0.0, height_m]))))
        for turned, height_m in ((R, 0.0), (R_upper, baseline_m))
    )
    return Rig(lower, upper, topics=TOPICS)


# Images of rolling shutters, and of mirrors whose rays do not meet in one point.


@compiled("(f8[:, :, ::1], i4[::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1])", writes=("turned", "moved"))
def turn(poses: Array, row: NDArray[np.int32], rays: Floats, origins: Floats, turned: Floats, moved: Floats) -> None:
    """Set rays and origins (3, N) in the frame of the first pose; origins (3, 1) where all are the same."""
    step = 1 if origins.shape[1] > 1 else 0
    for i in range(rays.shape[1]):
        T, x, y, z = poses[row[i] if len(poses) > 1 else 0], rays[0, i], rays[1, i], rays[2, i]
        a, b, c = origins[0, i * step], origins[1, i * step], origins[2, i * step]
        for k in range(3):
            turned[k, i] = T[k, 0] * x + T[k, 1] * y + T[k, 2] * z
            moved[k, i] = T[k, 0] * a + T[k, 1] * b + T[k, 2] * c + T[k, 3]


@lru_cache(2)
def origins_of(camera: MirrorCamera, supersample: int) -> Floats:
    """Return the origins (N, 3) [m] of the rays of all samples, row by row."""
    return camera.rays(sample_pixels(camera.size, supersample))[0].astype(np.float32)


def render_real(
    scene: Scene, mounted: MountedCamera, T_world_rig: Array, supersample: int = 2, row_twist: Array | None = None
) -> Floats:
    """Return the ideal image (H, W) as `render_grey` does, of any camera.

    row_twist (6,): motion of the rig in its own frame from one image row to the next (rolling shutter).
    """
    camera: OmniCamera | MirrorCamera = mounted.camera
    is_rolling = row_twist is not None and bool(np.any(row_twist))
    if not is_rolling and not isinstance(camera, MirrorCamera):
        return render_grey(scene, mounted, T_world_rig, supersample)
    table, (width, height) = cached_rays(mounted, supersample), camera.size
    # 1. The poses of the camera, of which there is one if it rests, and its largest turn.
    poses, turned_rad = T_world_rig[None], 0.0
    if row_twist is not None and is_rolling:
        rows = (np.arange(height * supersample) + 0.5) / supersample - 0.5
        poses = T_world_rig @ se3.exp(rows[:, None] * row_twist)
        turned_rad = height * float(np.linalg.norm(row_twist[3:]))
    poses = poses @ se3.inverse(mounted.T_cam_rig)
    # 2. The rays in the frame of the first pose.
    begin = np.zeros((3, 1), np.float32)
    if isinstance(camera, MirrorCamera):
        begin = np.ascontiguousarray(origins_of(camera, supersample)[table.sample].T)
    turned, moved = np.empty_like(table.rays), np.empty_like(table.rays)
    T_first_row = np.ascontiguousarray((se3.inverse(poses[:1]) @ poses)[:, :3])
    turn(T_first_row, table.sample // (width * supersample), table.rays, begin, turned, moved)
    rolled = replace(table, rays=turned, origins=moved, angles=table.angles + turned_rad)
    return render_rays(scene, rolled, poses[0], camera.size, supersample)
