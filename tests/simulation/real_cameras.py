"""Images of cameras whose rows are exposed one after the other, or whose rays do not meet in one point."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.models.camera import Array, OmniCamera
from calib.rig import MountedCamera
from omnid.core.compiled import compiled
from omnid.simulation.rendering.ray_caster import Floats, cached_rays, render_grey, render_rays, sample_pixels
from omnid.simulation.rendering.surfaces import Scene
from tests.simulation.rigs import MirrorCamera


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
