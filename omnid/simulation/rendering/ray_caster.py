"""Ray caster: images of a mirror camera, by casting the rays that its model lifts from the pixels.

The camera's lift() defines the rays of a central camera. A non-central one has a ray of its own, with its own origin,
for every pixel. Rays are cast in square tiles, and a rectangle is intersected only with the tiles whose
cone of directions overlaps its own. With a rolling shutter every row has a pose of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.models.camera import Array
from calib.rig import MountedCamera
from omnid.simulation.rendering.surfaces import Rectangle, Scene

Floats = NDArray[np.float32]
TILE_PX = 32
# cv2.remap expects images, not lists: samples are folded into rows of this length.
REMAP_COLUMNS = 1024
# Pixels lifted at once, which bounds memory.
RAY_CHUNK = 1 << 18
# Number of ray tables that are cached.
MAX_TABLES = 6
# Added to the half angle of a tile's cone: rounding of float32 rays.
CONE_MARGIN_RAD = 1e-3
# A cone bounds a rectangle between its corners only if it is narrower than a half space.
MAX_CONE_RAD = 1.5
# Least cosine between a ray and a rectangle's normal in a sample's footprint.
MIN_SLANT = 0.02
# Guards against division by zero at a rectangle through the viewpoint [m].
MIN_DISTANCE_M = 1e-9


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
    spacing: Floats  # (N,) [rad] to the next sample, the root of the sample's solid angle
    index: NDArray[np.int64]  # (N,) into the flattened supersampled image
    starts: NDArray[np.int64]  # (M + 1,) first sample of each tile
    axes: Array  # (M, 3) unit
    angles: Array  # (M,) [rad] from the axis to the farthest ray of a tile
    origins: Floats | None = None  # (3, N) [m] camera frame; None: all rays start at the camera's origin
    reach_m: float = 0.0  # of the farthest origin from the camera's


def ray_table(mounted: MountedCamera, supersample: int = 2) -> RayTable:
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
    return RayTable((height, width), supersample, np.ascontiguousarray(rays[index].T), spacing[index], index,
                    starts, axes, angles, origins, _reach_m(origins))


def _reach_m(origins: Floats | None) -> float:
    """Return the distance of the farthest of origins (3, N) from the camera's origin."""
    return 0.0 if origins is None else float(np.sqrt((origins**2).sum(axis=0).max()))


def _origins(mounted: MountedCamera, supersample: int, index: NDArray[np.int64]) -> Floats | None:
    """Return the origins (3, N) of the samples' rays of a non-central camera; None for a central one."""
    camera = mounted.camera
    if not isinstance(camera, NonCentralCamera):
        return None
    origins = [camera.rays(pixels)[0] for pixels in _sample_pixels(mounted, supersample)]
    return np.ascontiguousarray(np.concatenate(origins)[index].T, np.float32)


def _sample_pixels(mounted: MountedCamera, supersample: int) -> list[Array]:
    """Return the pixels (N, 2) of all samples, row by row, in chunks of about RAY_CHUNK."""
    width, height = mounted.camera.size
    u = (np.arange(width * supersample) + 0.5) / supersample - 0.5
    v = (np.arange(height * supersample) + 0.5) / supersample - 0.5
    pixels = np.column_stack([np.tile(u, len(v)), np.repeat(v, len(u))])
    return np.array_split(pixels, -(-len(pixels) // RAY_CHUNK))


def _lift_grid(mounted: MountedCamera, supersample: int) -> tuple[Floats, Floats]:
    """Return rays (N, 3), NaN outside the mask, and the angle between neighbours (N,) of every sample, row by row."""
    width, height = mounted.camera.size
    chunks = _sample_pixels(mounted, supersample)
    pixels, rays = np.concatenate(chunks), np.concatenate([mounted.camera.lift(chunk) for chunk in chunks])
    grid = rays.reshape(height * supersample, width * supersample, 3)
    solid_angle = np.linalg.norm(np.cross(np.gradient(grid, axis=0), np.gradient(grid, axis=1)), axis=2)
    rays[~mounted.visible.contains(pixels)] = np.nan
    return rays.astype(np.float32), np.sqrt(solid_angle).astype(np.float32).ravel()


def _cones(rays: Floats, starts: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return axis (M, 3) and half angle (M,) of the cone around each tile's rays."""
    axes = np.add.reduceat(rays.astype(float), starts[:-1])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    cosines = np.einsum("ij,ij->i", rays, np.repeat(axes, np.diff(starts), axis=0))
    return axes, np.arccos(np.clip(np.minimum.reduceat(cosines, starts[:-1]), -1, 1)) + CONE_MARGIN_RAD


_tables: dict[tuple[int, int], tuple[MountedCamera, RayTable]] = {}


def _cached_table(mounted: MountedCamera, supersample: int) -> RayTable:
    """Return the camera's table, computed once; the camera is kept with it so that its id stays unique."""
    key = (id(mounted), supersample)
    if key not in _tables:
        if len(_tables) >= MAX_TABLES:
            del _tables[next(iter(_tables))]
        _tables[key] = (mounted, ray_table(mounted, supersample))
    return _tables[key][1]


def render(scene: Scene, mounted: MountedCamera, T_world_rig: Array, supersample: int = 2) -> NDArray[np.uint8]:
    """Return the image (H, W) uint8 of the camera on a rig at T_world_rig; 0 outside the mask."""
    return np.clip(np.rint(render_grey(scene, mounted, T_world_rig, supersample)), 0, 255).astype(np.uint8)


def render_grey(scene: Scene, mounted: MountedCamera, T_world_rig: Array, supersample: int = 2,
                row_twist: Array | None = None) -> Floats:
    """Return the ideal image (H, W) float32, 0 to 255; 0 outside the mask and for rays that hit no rectangle.

    row_twist (6,): motion of the rig in its own frame from one image row to the next (rolling shutter).
    """
    table = _cached_table(mounted, supersample)
    if row_twist is not None and np.any(row_twist):
        table = _moving(table, se3.adjoint(mounted.T_cam_rig) @ row_twist)
    T_world_cam = T_world_rig @ se3.inverse(mounted.T_cam_rig)
    hits = _Hits.none(table.rays.shape[1])
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for number, rectangle in enumerate(scene.rectangles):
            _cast(table, rectangle, T_world_cam, (hits, number))
    height, width = table.shape
    canvas = np.zeros((height * supersample, width * supersample), np.float32)
    canvas.ravel()[table.index] = _shade(table, scene, hits, T_world_cam)
    return np.asarray(cv2.resize(canvas, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def _moving(table: RayTable, row_twist: Array) -> RayTable:
    """Return the table of a camera that moves by a twist (6,) in its own frame per row; to second order in it."""
    height, width = table.shape
    row = ((table.index // (width * table.supersample) + 0.5) / table.supersample - 0.5).astype(np.float32)
    v, W = row_twist[:3].astype(np.float32)[:, None], se3.hat(row_twist[3:]).astype(np.float32)
    half = row * row / 2
    origins = row * v + half * (W @ v)
    if table.origins is not None:
        origins += table.origins + row * (W @ table.origins) + half * (W @ W @ table.origins)
    rays = np.asarray(table.rays + row * (W @ table.rays) + half * (W @ W @ table.rays), np.float32)
    angles = table.angles + height * np.linalg.norm(row_twist[3:])
    return replace(table, rays=rays, origins=origins, angles=angles, reach_m=_reach_m(origins))


@dataclass(frozen=True, slots=True)
class _Hits:
    """The nearest hit of every ray so far: distance [m], fractions u and v, rectangle number (-1 = none)."""

    distance: Floats
    u: Floats
    v: Floats
    number: NDArray[np.int16]

    @staticmethod
    def none(count: int) -> _Hits:
        u, v = np.empty((2, count), np.float32)
        return _Hits(np.full(count, np.inf, np.float32), u, v, np.full(count, -1, np.int16))


def _cast(table: RayTable, rectangle: Rectangle, T_world_cam: Array, target: tuple[_Hits, int]) -> None:
    """Intersect the rays of all tiles that may see the rectangle, and keep hits nearer than the earlier ones."""
    hits, number = target
    axes = np.column_stack([rectangle.edge_u, rectangle.edge_v, rectangle.normal])
    # In the rectangle's own coordinates (u, v, height) a ray starts at q and has the direction M @ ray.
    viewpoint = np.linalg.solve(axes, T_world_cam[:3, 3] - rectangle.origin).astype(np.float32)
    M = np.linalg.solve(axes, T_world_cam[:3, :3]).astype(np.float32)
    for start, stop in _runs(table, _tiles_that_see(table, rectangle, T_world_cam)):
        du, dv, dn = M @ table.rays[:, start:stop]
        q = viewpoint if table.origins is None else viewpoint[:, None] + M @ table.origins[:, start:stop]
        s = -q[2] / dn
        u, v = q[0] + s * du, q[1] + s * dv
        nearer = (s > 0) & (s < hits.distance[start:stop]) & (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
        for kept, new in ((hits.distance, s), (hits.u, u), (hits.v, v)):
            np.copyto(kept[start:stop], new, where=nearer)
        hits.number[start:stop][nearer] = number


def _tiles_that_see(table: RayTable, rectangle: Rectangle, T_world_cam: Array) -> NDArray[np.bool_]:
    """Return the mask (M,) of tiles whose cone overlaps the cone through the rectangle's corners.

    Rays that start beside the camera's origin see a point at most asin(offset / distance) beside its direction.
    """
    corners = se3.apply(se3.inverse(T_world_cam), rectangle.corners)
    distance_m = _distance_m(corners)
    aside = float(np.arcsin(table.reach_m / distance_m)) if table.reach_m < distance_m else np.pi
    rays = corners / np.maximum(np.linalg.norm(corners, axis=1, keepdims=True), MIN_DISTANCE_M)
    axis = rays.sum(axis=0) / max(float(np.linalg.norm(rays.sum(axis=0))), MIN_DISTANCE_M)
    angle = np.arccos(np.clip(rays @ axis, -1, 1)).max()
    if angle > MAX_CONE_RAD:
        return np.ones(len(table.angles), bool)
    return np.asarray(np.arccos(np.clip(table.axes @ axis, -1, 1)) <= angle + table.angles + aside)


def _distance_m(corners: Array) -> float:
    """Return the distance [m] of a rectangle (4, 3) in the camera frame from the camera's origin."""
    u, v = corners[1] - corners[0], corners[3] - corners[0]
    part = np.clip([-corners[0] @ u / (u @ u), -corners[0] @ v / (v @ v)], 0, 1)
    return float(np.linalg.norm(corners[0] + part[0] * u + part[1] * v))


def _runs(table: RayTable, chosen: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return sample ranges [start, stop) of runs of neighbouring chosen tiles."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], chosen, [False]]).astype(np.int8)))
    return [(int(table.starts[a]), int(table.starts[b])) for a, b in edges.reshape(-1, 2)]


def _shade(table: RayTable, scene: Scene, hits: _Hits, T_world_cam: Array) -> Floats:
    """Return the grey level (N,) of every ray's nearest rectangle."""
    grey = np.zeros(len(hits.distance), np.float32)
    for number, rectangle in enumerate(scene.rectangles):
        mine = np.flatnonzero(hits.number == number)
        if len(mine):
            normal = (T_world_cam[:3, :3].T @ rectangle.normal).astype(np.float32)
            slant = np.maximum(np.abs(normal @ table.rays[:, mine]), MIN_SLANT)
            footprint_m2 = (hits.distance[mine] * table.spacing[mine]) ** 2 / slant
            grey[mine] = rectangle.brightness * _sample(rectangle, (hits.u[mine], hits.v[mine]), footprint_m2)
    return grey


def _sample(rectangle: Rectangle, uv: tuple[Floats, Floats], footprint_m2: Floats) -> Floats:
    """Return texture grey (N,) at fractions uv, from the level whose pixels are about as large as the footprint."""
    height, width = rectangle.texture.shape
    pixels = footprint_m2 * np.float32(height * width / (rectangle.height_m * rectangle.width_m))
    level = np.clip(np.rint(0.5 * np.log2(pixels)), 0, len(rectangle.pyramid) - 1).astype(np.int8)
    grey = np.empty(len(level), np.float32)
    for number in range(level.min(), level.max() + 1):
        mine = np.flatnonzero(level == number)
        if len(mine):
            grey[mine] = _bilinear(rectangle.pyramid[number], uv[0][mine], uv[1][mine])
    return grey


def _bilinear(texture: Floats, u: Floats, v: Floats) -> Floats:
    """Return the texture (H, W) at fractions u, v (N,) of its outline, bilinear, with the border repeated."""
    height, width = texture.shape
    rows = -(-len(u) // REMAP_COLUMNS)
    maps = np.zeros((2, rows * REMAP_COLUMNS), np.float32)
    maps[0, :len(u)], maps[1, :len(u)] = u * width - 0.5, v * height - 0.5
    map_u, map_v = maps.reshape(2, rows, REMAP_COLUMNS)
    image = cv2.remap(texture, map_u, map_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(image.ravel()[:len(u)], np.float32)
