"""Ray caster: the rays of a camera as a table, and images of rectangles with textures along them.

The camera's lift() defines the rays of a central camera. A non-central one has a ray of its own, with its own origin,
for every pixel. Rays are cast in square tiles, and a rectangle is intersected only with the rays of the tiles whose
cone of directions overlaps the pyramid through its corners, unless all of them meet something nearer. With a rolling
shutter every row has a pose of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.models.camera import Array, Mask, OmniCamera
from calib.rig import MountedCamera
from omnid.simulation.rendering.caster_kernels import cast
from omnid.simulation.rendering.surfaces import Rectangle, Scene, Texture

Floats = NDArray[np.float32]
TILE_PX = 32
# Number of samples for "as many as needed": one ray a pixel where a tile of NEEDED_PX shows one rectangle, else as many
# as make SIDE_RAYS along a side of the image. With two a pixel and axis at 512 px, joints of tiles come and go from
# pixel to pixel, as no lens shows them; with three they do not.
AS_NEEDED, NEEDED_PX, SIDE_RAYS = 0, 8, 3 * 512
# Pixels lifted at once, which bounds memory.
RAY_CHUNK = 1 << 18
# Number of cameras whose rays are kept, and of scenes whose textures are.
KEPT = 6
# Added to the half angle of a tile's cone: rounding of float32 rays.
CONE_MARGIN_RAD = 1e-3


@runtime_checkable
class NonCentralCamera(Protocol):
    """A camera whose rays do not meet in one point."""

    def rays(self, pixels: Array) -> tuple[Array, Array]:
        """Return origins (N, 3) [m] and unit directions (N, 3) of pixels (N, 2), in the camera frame."""


@dataclass(frozen=True, slots=True)
class RayTable:
    """The rays of one camera's visible samples by square tiles, row by row; N samples, M tiles, some of them empty."""

    supersample: int
    columns: int  # of tiles
    rays: Floats  # (3, N) unit, camera frame
    origins: Floats  # (3, N) [m] camera frame; (3, 1) zero where all rays start at the camera's origin
    spacing: Floats  # (N,) [rad] to the next sample, the root of the sample's solid angle
    index: NDArray[np.int32]  # (2, N) of the pixel in the flattened image, and of the row of samples
    starts: NDArray[np.int64]  # (M + 1,) first sample of each tile
    axes: Array  # (M, 3) unit; zero for an empty tile
    angles: Array  # (M,) [rad] from the axis to the farthest ray of a tile
    reach_m: float  # of the farthest origin from the camera's


def ray_table(mounted: MountedCamera, supersample: int, tile_samples: int = TILE_PX) -> RayTable:
    """Return the rays of all samples (supersample^2 per pixel) inside the camera's mask, by tiles of a side."""
    width, height = (side * supersample for side in mounted.camera.size)
    columns, lines = -(-width // tile_samples), -(-height // tile_samples)
    rays, spacing = _lift_grid(mounted, supersample)
    row, column = np.divmod(np.arange(height * width), width)
    tile = row // tile_samples * columns + column // tile_samples
    index = np.flatnonzero(np.isfinite(rays[:, 0]) & np.isfinite(spacing))
    index = index[np.argsort(tile[index], kind="stable")]
    starts = np.searchsorted(tile[index], np.arange(lines * columns + 1))
    axes, angles = _cones(rays[index], starts)
    origins = _origins(mounted, supersample, index)
    pixel = row[index] // supersample * (width // supersample) + column[index] // supersample
    return RayTable(
        supersample,
        columns,
        np.ascontiguousarray(rays[index].T),
        origins,
        spacing[index],
        np.stack([pixel, row[index]]).astype(np.int32),
        starts,
        axes,
        angles,
        float(np.linalg.norm(origins, axis=0).max()),
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


def _lift_grid(mounted: MountedCamera, supersample: int) -> tuple[Floats, Floats]:
    """Return rays (N, 3), NaN outside the mask, and the angle between neighbours (N,) of every sample, row by row."""
    rays, spacing = _lifted(mounted.camera, supersample)  # type: ignore[arg-type]  # cameras are frozen
    pixels = np.concatenate(_sample_pixels(mounted.camera.size, supersample))
    return np.where(mounted.visible.contains(pixels)[:, None], rays, np.float32(np.nan)), spacing


@lru_cache(1)
def _lifted(camera: OmniCamera, supersample: int) -> tuple[Floats, Floats]:
    """Return rays and spacing of every sample without a mask; computed once for the equal lenses of a rig."""
    width, height = camera.size
    rays = np.concatenate([camera.lift(chunk) for chunk in _sample_pixels(camera.size, supersample)])
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
    angles[full] = np.arccos(np.clip(np.minimum.reduceat(cosines, first), -1, 1)) + CONE_MARGIN_RAD
    return axes, angles


@dataclass(frozen=True, slots=True)
class CameraRays:
    """The tables of a camera: all samples; one ray a pixel in the same tiles, or none; the tiles that are culled."""

    samples: RayTable
    plain: RayTable | None
    culled: RayTable  # the samples', or larger tiles of one ray a pixel

    @property
    def parents(self) -> NDArray[np.int64]:
        """The culled tile in which each tile (M,) of the samples is."""
        tiles = np.arange(len(self.samples.angles))
        if self.plain is None:
            return tiles
        rows, columns = np.divmod(tiles, self.samples.columns)
        times = TILE_PX // NEEDED_PX
        return np.asarray(rows // times * self.culled.columns + columns // times)


_kept: list[tuple[OmniCamera, Mask, int, CameraRays]] = []  # the one made last at the end


def cached_rays(mounted: MountedCamera, supersample: int) -> CameraRays:
    """Return the camera's tables, computed once for equal cameras and masks."""
    mask = mounted.visible
    ring = mask.center, mask.inner_px, mask.outer_px
    for camera, kept, samples, rays in _kept:
        is_ring = (kept.center, kept.inner_px, kept.outer_px) == ring and kept.image is mask.image
        if samples == supersample and is_ring and camera == mounted.camera:
            return rays
    if supersample == AS_NEEDED:
        finest = -(-SIDE_RAYS // max(mounted.camera.size))
        fine, plain = (ray_table(mounted, samples, NEEDED_PX * samples) for samples in (finest, 1))
        made = CameraRays(fine, plain, ray_table(mounted, 1))
    else:
        table = ray_table(mounted, supersample)
        made = CameraRays(table, None, table)
    del _kept[: len(_kept) - KEPT + 1]
    _kept.append((mounted.camera, mask, supersample, made))
    return made


# Guards against division by zero at a rectangle through the viewpoint [m].
MIN_DISTANCE_M = np.finfo(float).eps
MARGIN_M = 1e-4  # Subtracted from the least distance of a rectangle: rounding of float32 rays.
SMALLEST_PX = 8
_atlases: list[Atlas] = []  # the one used last at the end


def render_grey(
    scene: Scene, mounted: MountedCamera, T_world_rig: Array, supersample: int = 2, row_twist: Array | None = None
) -> Floats:
    """Return the ideal image (H, W) float32, 0 to 255; 0 outside the mask and for rays that hit no rectangle.

    supersample: rays of a pixel, per axis, or AS_NEEDED.
    row_twist (6,): motion of the rig in its own frame from one image row to the next (rolling shutter).
    """
    rays, (width, height) = cached_rays(mounted, supersample), mounted.camera.size
    table, plain = rays.samples, rays.plain
    # 1. The poses of the camera, and the rectangles in the frame of the first one, by their least distance.
    poses, turned_rad = _row_poses(height, table, T_world_rig, np.zeros(6) if row_twist is None else row_twist)
    poses = poses @ se3.inverse(mounted.T_cam_rig)
    reach_m = table.reach_m + float(np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1).max())
    if plain is not None and reach_m:
        raise ValueError("as many rays as needed: for central cameras that take all rows at once only")
    corners = se3.apply(se3.inverse(poses[0]), corners_of(scene.rectangles))
    distance_m = _distances_m(corners)
    order = np.argsort(distance_m, kind="stable")
    corners, distance_m = corners[order], distance_m[order]
    surfaces = _surfaces([scene.rectangles[i] for i in order], poses[0], distance_m - reach_m)
    # 2. The rectangles that tiles may see.
    sides = sides_of(corners)
    seen = tiles_that_see(rays.culled, sides, turned_rad + np.arcsin(np.clip(reach_m / distance_m, 0, 1)))
    # 3. The greys of all samples.
    atlas, image = cached_atlas([r.texture for r in scene.rectangles]), np.zeros(width * height, np.float32)
    one = plain or table
    cast(
        table.rays,
        table.origins,
        table.spacing,
        table.index,
        table.starts,
        one.rays,
        one.spacing,
        one.index,
        one.starts if plain else one.starts[:1],
        one.axes.astype(np.float32),
        np.sin(np.minimum(one.angles, np.pi / 2)).astype(np.float32),
        np.ascontiguousarray((se3.inverse(poses[:1]) @ poses)[:, :3]),
        rays.parents,
        np.ascontiguousarray(seen),
        sides.astype(np.float32),
        surfaces,
        atlas.pyramids[order],
        atlas.levels,
        atlas.texels,
        np.float32(table.supersample**2),
        image,
    )
    return np.asarray(image.reshape(height, width) / np.float32(table.supersample**2), np.float32)


def _row_poses(height: int, table: RayTable, T_world_rig: Array, row_twist: Array) -> tuple[Array, float]:
    """Return the poses (S, 4, 4) of the rig at the S rows of samples, one if it rests, and its largest turn [rad]."""
    if not np.any(row_twist):
        return T_world_rig[None], 0.0
    rows = (np.arange(height * table.supersample) + 0.5) / table.supersample - 0.5
    return T_world_rig @ se3.exp(rows[:, None] * row_twist), height * float(np.linalg.norm(row_twist[3:]))


def _surfaces(rectangles: Sequence[Rectangle], T_world_cam: Array, nearest_m: Array) -> Floats:
    """Return what the caster knows of rectangles (R, 4, 4), in the camera frame; see caster_kernels.

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
    rows[:, -1, 2] = nearest_m - MARGIN_M
    return rows.astype(np.float32)


def tiles_that_see(table: RayTable, sides: Array, aside_rad: Array) -> NDArray[np.bool_]:
    """Return the mask (M, R) of tiles that may see the rectangles with sides (R, 4, 3) of their pyramids.

    A tile sees none of what lies between the sides of a pyramid if its whole cone is beyond one of them. aside_rad
    (R,): largest angle between a ray and the direction from the camera's origin of what it meets.
    """
    # The least sine, of all four, of the angle from a side to the tile's axis.
    sines = np.min([table.axes @ sides[:, side].T for side in range(4)], axis=0)
    reach_rad = np.minimum(table.angles[:, None] + aside_rad, np.pi / 2)
    return np.asarray(sines >= -np.sin(reach_rad))


def sides_of(corners: Array) -> Array:
    """Return the normals (R, 4, 3), to the inside, of the sides of the pyramids from the origin through rectangles.

    They are 0 where an edge leads to the origin.
    """
    normals = np.cross(corners, np.roll(corners, -1, axis=1))
    inwards = np.sign((normals * corners.mean(axis=1, keepdims=True)).sum(axis=(1, 2)))
    normals *= (inwards[:, None] / np.maximum(np.linalg.norm(normals, axis=2), MIN_DISTANCE_M**2))[:, :, None]
    return np.asarray(normals)


def corners_of(rectangles: Sequence[Rectangle]) -> Array:
    """Return the corners (R, 4, 3) of rectangles."""
    origins, u, v = (np.array([getattr(r, name) for r in rectangles]) for name in ("origin", "edge_u", "edge_v"))
    return np.stack([origins, origins + u, origins + u + v, origins + v], axis=1)


def _distances_m(corners: Array) -> Array:
    """Return the distances (R,) [m] of rectangles (R, 4, 3) in the camera frame from the camera's origin."""
    first, u, v = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]
    parts = [np.clip(-(first * edge).sum(axis=1) / (edge * edge).sum(axis=1), 0, 1)[:, None] for edge in (u, v)]
    nearest = np.linalg.norm(first + parts[0] * u + parts[1] * v, axis=1)
    return np.asarray(np.maximum(nearest, MIN_DISTANCE_M))


@dataclass(frozen=True, slots=True)
class Atlas:
    """All levels of textures, and where those of R of them are."""

    textures: tuple[Texture, ...]  # all; kept, so that their ids stay unique
    texels: NDArray[np.uint8]  # (K,) of all levels, row by row
    pyramids: NDArray[np.int64]  # (R, 2) first level of each texture, number of its levels
    levels: NDArray[np.int64]  # (L, 3) first texel, height, width


def pyramid(texture: Texture) -> list[NDArray[np.uint8]]:
    """Return a texture at halved sizes (box filter), all with the same outline, until a side is below 8 px."""
    exact, levels = texture.astype(np.float32), [texture]
    while min(exact.shape) >= SMALLEST_PX:
        height, width = exact.shape
        exact = np.asarray(cv2.resize(exact, (width // 2, height // 2), interpolation=cv2.INTER_AREA), np.float32)
        levels.append(np.rint(exact).astype(np.uint8))
    return levels


def make_atlas(textures: Sequence[Texture]) -> Atlas:
    """Return the atlas of textures; one that occurs several times is stored once."""
    first: dict[int, tuple[int, int]] = {}
    images: list[NDArray[np.uint8]] = []
    for texture in textures:
        if id(texture) not in first:
            made = pyramid(texture)
            first[id(texture)] = (len(images), len(made))
            images += made
    sizes = np.array([image.size for image in images], np.int64)
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    levels = np.array([(start, *image.shape) for start, image in zip(starts, images, strict=True)], np.int64)
    texels = np.concatenate([image.ravel() for image in images])
    return Atlas(tuple(textures), texels, np.array([first[id(texture)] for texture in textures], np.int64), levels)


def cached_atlas(textures: Sequence[Texture]) -> Atlas:
    """Return the atlas of textures; the texels of one that has them all are shared, whatever their order."""
    for number, atlas in enumerate(_atlases):
        rows = {id(texture): row for row, texture in enumerate(atlas.textures)}
        if all(id(texture) in rows for texture in textures):
            _atlases.append(_atlases.pop(number))
            return replace(atlas, pyramids=atlas.pyramids[[rows[id(texture)] for texture in textures]])
    del _atlases[: len(_atlases) - KEPT + 1]
    _atlases.append(make_atlas(textures))
    return _atlases[-1]
