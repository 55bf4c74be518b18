"""Rays of all samples of a camera, in square tiles; computed once for each camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from calib.models.camera import Array, OmniCamera
from calib.rig import MountedCamera

Floats = NDArray[np.float32]
TILE_PX = 32
# Pixels lifted at once, which bounds memory.
RAY_CHUNK = 1 << 18
# Number of ray tables that are cached.
MAX_TABLES = 6
# Added to the half angle of a tile's cone: rounding of float32 rays.
CONE_MARGIN_RAD = 1e-3


@runtime_checkable
class NonCentralCamera(Protocol):
    """A camera whose rays do not meet in one point."""

    def rays(self, pixels: Array) -> tuple[Array, Array]:
        """Return origins (N, 3) [m] and unit directions (N, 3) of pixels (N, 2), in the camera frame."""


@dataclass(frozen=True, slots=True)
class RayTable:
    """The rays of one camera's visible samples, sorted by tile; N samples, M tiles."""

    shape: tuple[int, int]  # (height, width) of the image without supersampling
    supersample: int
    rays: Floats  # (3, N) unit, camera frame
    origins: Floats  # (3, N) [m] camera frame; (3, 1) zero where all rays start at the camera's origin
    spacing: Floats  # (N,) [rad] to the next sample, the root of the sample's solid angle
    index: NDArray[np.int32]  # (2, N) of the pixel in the flattened image, and of the row of samples
    starts: NDArray[np.int64]  # (M + 1,) first sample of each tile
    axes: Array  # (M, 3) unit
    angles: Array  # (M,) [rad] from the axis to the farthest ray of a tile
    reach_m: float  # of the farthest origin from the camera's


def ray_table(mounted: MountedCamera, supersample: int) -> RayTable:
    """Return the rays of all samples (supersample^2 per pixel) inside the camera's mask."""
    width, height = mounted.camera.size
    rays, spacing = _lift_grid(mounted, supersample)
    ss_height, ss_width = height * supersample, width * supersample
    rows, columns = np.divmod(np.arange(ss_height * ss_width), ss_width)
    tile = rows // TILE_PX * (-(-ss_width // TILE_PX)) + columns // TILE_PX
    index = np.flatnonzero(np.isfinite(rays[:, 0]) & np.isfinite(spacing))
    index = index[np.argsort(tile[index], kind="stable")]
    _, starts = np.unique(tile[index], return_index=True)
    starts = np.append(starts, len(index))
    axes, angles = _cones(rays[index], starts)
    origins = _origins(mounted, supersample, index)
    reach_m = float(np.linalg.norm(origins, axis=0).max())
    pixel = rows[index] // supersample * width + columns[index] // supersample
    return RayTable(
        (height, width),
        supersample,
        np.ascontiguousarray(rays[index].T),
        origins,
        spacing[index],
        np.stack([pixel, rows[index]]).astype(np.int32),
        starts,
        axes,
        angles,
        reach_m,
    )


def _origins(mounted: MountedCamera, supersample: int, index: NDArray[np.int64]) -> Floats:
    """Return the origins (3, N) of the samples' rays of a non-central camera; (3, 1) for a central one."""
    camera = mounted.camera
    if not isinstance(camera, NonCentralCamera):
        return np.zeros((3, 1), np.float32)
    origins = [camera.rays(pixels)[0] for pixels in _sample_pixels(camera.size, supersample)]
    return np.ascontiguousarray(np.concatenate(origins)[index].T, np.float32)


def _sample_pixels(size: tuple[int, int], supersample: int) -> list[Array]:
    """Return the pixels (N, 2) of all samples, row by row, in chunks of about RAY_CHUNK."""
    width, height = size
    u = (np.arange(width * supersample) + 0.5) / supersample - 0.5
    v = (np.arange(height * supersample) + 0.5) / supersample - 0.5
    pixels = np.column_stack([np.tile(u, len(v)), np.repeat(v, len(u))])
    return np.array_split(pixels, -(-len(pixels) // RAY_CHUNK))


_last_lifted: list[tuple[OmniCamera, int, tuple[Floats, Floats]]] = []  # at most one


def _lift_grid(mounted: MountedCamera, supersample: int) -> tuple[Floats, Floats]:
    """Return rays (N, 3), NaN outside the mask, and the angle between neighbours (N,) of every sample, row by row."""
    rays, spacing = _lifted(mounted.camera, supersample)
    pixels = np.concatenate(_sample_pixels(mounted.camera.size, supersample))
    return np.where(mounted.visible.contains(pixels)[:, None], rays, np.float32(np.nan)), spacing


def _lifted(camera: OmniCamera, supersample: int) -> tuple[Floats, Floats]:
    """Return rays and spacing of every sample without a mask; computed once for the equal lenses of a rig."""
    for kept, samples, lifted in _last_lifted:
        if samples == supersample and kept == camera:
            return lifted
    width, height = camera.size
    rays = np.concatenate([camera.lift(chunk) for chunk in _sample_pixels(camera.size, supersample)])
    grid = rays.reshape(height * supersample, width * supersample, 3)
    solid_angle = np.linalg.norm(np.cross(np.gradient(grid, axis=0), np.gradient(grid, axis=1)), axis=2)
    lifted = rays.astype(np.float32), np.sqrt(solid_angle).astype(np.float32).ravel()
    _last_lifted[:] = [(camera, supersample, lifted)]
    return lifted


def _cones(rays: Floats, starts: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return axis (M, 3) and half angle (M,) of the cone around each tile's rays."""
    axes = np.add.reduceat(rays.astype(float), starts[:-1])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    cosines = np.einsum("ij,ij->i", rays, np.repeat(axes, np.diff(starts), axis=0))
    return axes, np.arccos(np.clip(np.minimum.reduceat(cosines, starts[:-1]), -1, 1)) + CONE_MARGIN_RAD


_tables: dict[tuple[int, int], tuple[MountedCamera, RayTable]] = {}


def cached_table(mounted: MountedCamera, supersample: int) -> RayTable:
    """Return the camera's table, computed once; the camera is kept with it so that its id stays unique."""
    key = (id(mounted), supersample)
    if key not in _tables:
        if len(_tables) >= MAX_TABLES:
            del _tables[next(iter(_tables))]
        _tables[key] = (mounted, ray_table(mounted, supersample))
    return _tables[key][1]
