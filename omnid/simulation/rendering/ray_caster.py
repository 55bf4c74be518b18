"""Ray caster: the rays of a camera as a table, images of rectangles with textures along them, errors of a sensor.

The camera's lift() defines the rays, which meet in its origin; a table may give each ray an origin of its own. Rays are
cast in square tiles, and a rectangle is intersected only with the rays of the tiles whose cone of directions overlaps
the pyramid through its corners, unless all of them meet something nearer.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.models.camera import Array, Mask, OmniCamera
from calib.rig import MountedCamera
from omnid.simulation.rendering.ray_caster_kernels import cast
from omnid.simulation.rendering.surfaces import Rectangle, Scene, Texture

Floats = NDArray[np.float32]
T = TypeVar("T")
TILE_PX = 32  # samples along a tile's side
KEPT = 6  # Number of cameras whose rays are kept, and of scenes whose textures are.
# Rounding of float32 rays: of angles [rad] near the axis of a cone, and as a share of distances.
ROUNDING = 2 * float(np.sqrt(np.finfo(np.float32).eps))
# Guards against division by zero at a rectangle through the viewpoint [m].
MIN_DISTANCE_M = np.finfo(float).eps
SMALLEST_PX = 8


# 1. The rays of a camera.
@dataclass(frozen=True, slots=True)
class RayTable:
    """The rays of one camera's visible samples by square tiles, row by row; N samples, M tiles, some of them empty."""

    rays: Floats  # (3, N) unit, camera frame
    origins: Floats  # (3, N) [m] camera frame; (3, TILE_PX^2) zeros where all rays start at the camera's origin
    spacing: Floats  # (N,) [rad] to the next sample, the root of the sample's solid angle
    pixel: NDArray[np.int32]  # (N,) index in the flattened image
    sample: NDArray[np.int32]  # (N,) number of the sample, of all of the image row by row
    starts: NDArray[np.int64]  # (M + 1,) first sample of each tile
    axes: Array  # (M, 3) unit; zero for an empty tile
    angles: Array  # (M,) [rad] from the axis to the farthest ray of a tile


_kept: dict[Hashable, tuple[Mask, RayTable]] = {}  # the mask stays, so that the id of its image is its own


def cached_rays(mounted: MountedCamera, supersample: int) -> RayTable:
    """Return the camera's table, made once for equal cameras and masks."""
    mask = mounted.visible
    key = mounted.camera, mask.center, mask.inner_px, mask.outer_px, id(mask.image), supersample
    return _remembered(_kept, key, lambda: (mask, ray_table(mounted.camera, mask, supersample)))[1]


def _remembered(kept: dict[Hashable, T], key: Hashable, make: Callable[[], T]) -> T:
    """Return what is kept by a key, made at first use; KEPT are kept."""
    if key not in kept:
        made = make()
        for oldest in list(kept)[: len(kept) - KEPT + 1]:
            del kept[oldest]
        kept[key] = made
    return kept[key]


def ray_table(camera: OmniCamera, mask: Mask, supersample: int) -> RayTable:
    """Return the rays of all samples (supersample^2 per pixel) inside a camera's mask, by tiles."""
    width, height = (side * supersample for side in camera.size)
    columns, lines = -(-width // TILE_PX), -(-height // TILE_PX)
    rays, spacing = _lifted(camera, supersample)  # type: ignore[arg-type]  # cameras are frozen
    seen = mask.contains(sample_pixels(camera.size, supersample))
    row, column = np.divmod(np.arange(height * width), width)
    tile = row // TILE_PX * columns + column // TILE_PX
    index = np.flatnonzero(seen & np.isfinite(rays[:, 0]) & np.isfinite(spacing))
    index = index[np.argsort(tile[index], kind="stable")]
    starts = np.searchsorted(tile[index], np.arange(lines * columns + 1))
    pixel = row[index] // supersample * (width // supersample) + column[index] // supersample
    return RayTable(
        np.ascontiguousarray(rays[index].T),
        np.zeros((3, TILE_PX**2), np.float32),
        spacing[index],
        pixel.astype(np.int32),
        index.astype(np.int32),
        starts,
        *_cones(rays[index], starts),
    )


def sample_pixels(size: tuple[int, int], supersample: int) -> Array:
    """Return the pixels (N, 2) of all samples, row by row."""
    u, v = ((np.arange(side * supersample) + 0.5) / supersample - 0.5 for side in size)
    return np.column_stack([np.tile(u, len(v)), np.repeat(v, len(u))])


@lru_cache(1)
def _lifted(camera: OmniCamera, supersample: int) -> tuple[Floats, Floats]:
    """Return rays (N, 3) and the angle between neighbours (N,) of every sample, row by row.

    Computed once for the equal lenses of a rig.
    """
    width, height = camera.size
    pixels = sample_pixels(camera.size, supersample)
    rays = camera.lift(pixels)
    grid = rays.reshape(height * supersample, width * supersample, 3)
    solid_angle = np.linalg.norm(np.cross(np.gradient(grid, axis=0), np.gradient(grid, axis=1)), axis=2)
    return rays.astype(np.float32), np.sqrt(solid_angle).astype(np.float32).ravel()


def _cones(rays: Floats, starts: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return axis (M, 3) and half angle (M,) of the cone around each tile's rays; 0 for an empty tile."""
    axes, angles, counts = np.zeros((len(starts) - 1, 3)), np.zeros(len(starts) - 1), np.diff(starts)
    full, first = counts > 0, starts[:-1][counts > 0]
    axes[full] = np.add.reduceat(rays.astype(float), first)
    axes[full] /= np.linalg.norm(axes[full], axis=1, keepdims=True)
    cosines = np.einsum("ij,ij->i", rays, np.repeat(axes, counts, axis=0))
    angles[full] = np.arccos(np.clip(np.minimum.reduceat(cosines, first), -1, 1)) + ROUNDING
    return axes, angles


# 2. An image.
def render_grey(scene: Scene, mounted: MountedCamera, T_world_rig: Array, supersample: int = 2) -> Floats:
    """Return the ideal image (H, W) float32, 0 to 255; 0 outside the mask and for rays that hit no rectangle.

    supersample: rays of a pixel, per axis.
    """
    T_world_cam = T_world_rig @ se3.inverse(mounted.T_cam_rig)
    return render_rays(scene, cached_rays(mounted, supersample), T_world_cam, mounted.camera.size, supersample)


def render_rays(scene: Scene, table: RayTable, T_world_cam: Array, size: tuple[int, int], supersample: int) -> Floats:
    """Return the ideal image (H, W) of the rays of a camera at T_world_cam; size: (width, height)."""
    width, height = size
    # 1. The rectangles in the camera frame by their least distance, and those that tiles may see.
    reach_m = float(np.linalg.norm(table.origins, axis=0).max())
    corners = se3.apply(se3.inverse(T_world_cam), np.array([r.corners for r in scene]))
    distance_m = _distances_m(corners)
    order = np.argsort(distance_m, kind="stable")
    corners, distance_m = corners[order], distance_m[order]
    surfaces = _surfaces([scene[i] for i in order], T_world_cam, distance_m - reach_m)
    seen = tiles_that_see(table, corners, np.arcsin(np.clip(reach_m / distance_m, 0, 1)))
    # 2. The greys of all samples.
    textures, image = [r.texture for r in scene], np.zeros(width * height, np.float32)
    atlas = _remembered(_atlases, tuple(map(id, textures)), lambda: _make_atlas(textures))
    cast(
        table.rays,
        table.origins,
        table.spacing,
        table.pixel,
        table.starts,
        np.ascontiguousarray(seen),
        surfaces,
        atlas.pyramids[order],
        atlas.levels,
        atlas.texels,
        image,
    )
    return np.asarray(image.reshape(height, width) / np.float32(supersample**2), np.float32)


def _surfaces(rectangles: Sequence[Rectangle], T_world_cam: Array, nearest_m: Array) -> Floats:
    """Return the rows (R, 4, 4) of rectangles for the compiled loops, in the camera frame; see ray_caster_kernels.

    nearest_m (R,): least distance of each from the origin of any ray.
    """
    edges = np.array([(r.normal, r.edge_u, r.edge_v) for r in rectangles])
    from_origin = T_world_cam[:3, 3] - np.array([r.origin for r in rectangles])
    n_u_v = np.linalg.inv(edges.transpose(0, 2, 1))
    rows = np.zeros((len(rectangles), 4, 4))
    rows[:, :-1, :-1] = n_u_v @ T_world_cam[:3, :3]
    rows[:, :-1, -1] = np.einsum("rij,rj->ri", n_u_v, from_origin)
    rows[:, -1, 0] = [r.brightness for r in rectangles]
    rows[:, -1, 1] = [r.texture.size for r in rectangles] / np.linalg.norm(edges[:, 1:], axis=2).prod(axis=1)
    rows[:, -1, 2] = nearest_m - ROUNDING * np.abs(nearest_m)
    return rows.astype(np.float32)


def tiles_that_see(table: RayTable, corners: Array, parallax_rad: Array) -> NDArray[np.bool_]:
    """Return the mask (M, R) of tiles that may see rectangles with corners (R, 4, 3) in the camera frame.

    A tile sees none of what lies between the sides of the pyramid from the origin through a rectangle if its whole cone
    is beyond one of them. parallax_rad (R,): largest angle between a ray and the direction from the camera's origin of
    what it meets.
    """
    # 1. The normals (R, 4, 3) of the sides, to the inside; 0 where an edge leads to the origin.
    normals = np.cross(corners, np.roll(corners, -1, axis=1))
    inwards = np.sign((normals * corners.mean(axis=1, keepdims=True)).sum(axis=(1, 2)))
    normals *= (inwards[:, None] / np.maximum(np.linalg.norm(normals, axis=2), MIN_DISTANCE_M**2))[:, :, None]
    # 2. The least sine, of all four, of the angle from a side to the tile's axis.
    sines = np.min([table.axes @ normals[:, side].T for side in range(4)], axis=0)
    reach_rad = np.minimum(table.angles[:, None] + parallax_rad, np.pi / 2)
    return np.asarray(sines >= -np.sin(reach_rad))


def _distances_m(corners: Array) -> Array:
    """Return the distances (R,) [m] of rectangles (R, 4, 3) in the camera frame from the camera's origin."""
    first, u, v = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]
    parts = [np.clip(-(first * edge).sum(axis=1) / (edge * edge).sum(axis=1), 0, 1)[:, None] for edge in (u, v)]
    nearest = np.linalg.norm(first + parts[0] * u + parts[1] * v, axis=1)
    return np.asarray(np.maximum(nearest, MIN_DISTANCE_M))


# 3. Textures at all sizes.
@dataclass(frozen=True, slots=True)
class Atlas:
    """All levels of textures, and where those of R of them are."""

    textures: tuple[Texture, ...]  # all; kept, so that their ids stay unique
    texels: NDArray[np.uint8]  # (K,) of all levels, row by row
    pyramids: NDArray[np.int64]  # (R, 2) first level of each texture, number of its levels
    levels: NDArray[np.int64]  # (L, 3) first texel, height, width


_atlases: dict[Hashable, Atlas] = {}  # of scenes, by the ids of their textures


def _make_atlas(textures: Sequence[Texture]) -> Atlas:
    """Return the atlas of textures; one that occurs several times is stored once."""
    first: dict[int, tuple[int, int]] = {}
    images: list[Texture] = []
    for texture in textures:
        if id(texture) not in first:
            made = _pyramid(texture)
            first[id(texture)] = (len(images), len(made))
            images += made
    starts = np.cumsum([0, *(image.size for image in images[:-1])])
    levels = np.array([(start, *image.shape) for start, image in zip(starts, images, strict=True)], np.int64)
    texels = np.concatenate([image.ravel() for image in images])
    return Atlas(tuple(textures), texels, np.array([first[id(texture)] for texture in textures], np.int64), levels)


def _pyramid(texture: Texture) -> list[Texture]:
    """Return a texture at halved sizes (box filter), all with the same outline, until a side is below SMALLEST_PX."""
    exact, levels = texture.astype(np.float32), [texture]
    while min(exact.shape) >= SMALLEST_PX:
        height, width = exact.shape
        exact = np.asarray(cv2.resize(exact, (width // 2, height // 2), interpolation=cv2.INTER_AREA), np.float32)
        levels.append(np.rint(exact).astype(np.uint8))
    return levels


# 4. The errors of a sensor.
@dataclass(frozen=True, slots=True)
class Sensor:
    """A sensor that blurs, has an offset and is noisy."""

    noise_sigma: float = 1.5
    blur_px: float = 0.5
    black_level: float = 5.0

    def expose(self, ideal: Floats, rng: np.random.Generator) -> NDArray[np.uint8]:
        """Return the sensor's image (H, W) uint8 of an ideal one."""
        grey = cv2.GaussianBlur(ideal, (0, 0), self.blur_px) if self.blur_px > 0 else ideal
        noise = self.noise_sigma * rng.standard_normal(grey.shape, dtype=np.float32)
        return np.clip(np.rint(grey * (1 - self.black_level / 255) + self.black_level + noise), 0, 255).astype(np.uint8)
