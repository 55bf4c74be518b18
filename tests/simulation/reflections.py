"""What polished floors and panes of glass mirror.

A reflection in a plane is the image of the world mirrored in that plane, seen where the plane is seen. Polished stone,
lacquered wood and wet tiles reflect by Fresnel's equations for n = 1.5: 4 % straight down, 9 % at 60 degrees from the
vertical, 25 % at 75 degrees. From a camera 0.9 m above the floor that is 5 % at 1 m and 17 % at 3 m.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Final

import numpy as np

from calib.models.camera import Array
from calib.rig import MountedCamera
from omnid.simulation.rendering.ray_caster import render_grey
from omnid.simulation.rendering.sensor import Floats
from omnid.simulation.rendering.surfaces import POSTER_GAP_M, Rectangle, Scene, Texture

REFRACTIVE_INDEX: Final = 1.5  # of glass, glazed tiles, polish and lacquer
WHITE: Final[Texture] = np.full((8, 8), 255, np.uint8)
BLACK: Final[Texture] = np.zeros((8, 8), np.uint8)


def reflectance(cosine: Floats) -> Floats:
    """Return the share of unpolarised light that is reflected, by the cosine of the angle to the normal (Fresnel)."""
    n = np.float32(REFRACTIVE_INDEX)
    inside = np.sqrt(1 - (1 - cosine**2) / n**2)
    across, along = (cosine - n * inside) / (cosine + n * inside), (n * cosine - inside) / (n * cosine + inside)
    return np.asarray((across**2 + along**2) / 2, np.float32)


def mirrored(rectangle: Rectangle, in_plane: Rectangle) -> Rectangle:
    """Return the mirror image of a rectangle in the plane of another one."""
    n = in_plane.normal
    across = np.eye(3) - 2 * np.outer(n, n)
    origin = across @ (rectangle.origin - in_plane.origin) + in_plane.origin
    return replace(rectangle, origin=origin, edge_u=across @ rectangle.edge_u, edge_v=across @ rectangle.edge_v)


class Mirror:
    """Renders what a camera sees in a polished floor, or in a pane of glass through which the scene is seen."""

    def __init__(self, mounted: MountedCamera) -> None:
        self._mounted = mounted

    @cached_property
    def _rays(self) -> Floats:
        """The rays (H W, 3) of the pixels in the rig frame."""
        width, height = self._mounted.camera.size
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
        rays = self._mounted.camera.lift(pixels.astype(float)) @ self._mounted.T_cam_rig[:3, :3]
        return np.nan_to_num(rays).astype(np.float32)

    def reflected(self, image: Floats, scene: Scene, surface: Rectangle, T_world_rig: Array, samples: int) -> Floats:
        """Return the ideal image (H, W) of a scene with what a surface mirrors; the scene may hold it, or not."""
        # 1. The part of each pixel that shows the surface, times what it reflects at the pixel's angle.
        others = [face for face in scene.rectangles if face is not surface]
        shown = seen_part(replace(surface, texture=WHITE), others, self._mounted, T_world_rig, 1)
        if not shown.any():
            return image
        normal = (T_world_rig[:3, :3].T @ surface.normal).astype(np.float32)
        share = shown * reflectance(np.abs(self._rays @ normal).reshape(image.shape))
        # 2. The mirror image of all on this side of the surface, seen through it.
        here = T_world_rig[:3, 3] - surface.origin
        side = math.copysign(1.0, float(surface.normal @ here)) * surface.normal
        before = [face for face in others if ((face.corners - surface.origin) @ side).max() > POSTER_GAP_M]
        below = Scene(tuple(mirrored(face, surface) for face in before))
        seen = render_grey(below, self._mounted, T_world_rig, samples)
        return np.asarray(image + share * (seen - image), np.float32)


def seen_part(
    surface: Rectangle, others: Sequence[Rectangle], mounted: MountedCamera, T_world_rig: Array, samples: int
) -> Floats:
    """Return the part (H, W) of each pixel, 0 to 1, that shows the white of a surface among others."""
    flags = Scene((surface, *(replace(face, texture=BLACK) for face in others)))
    shown = render_grey(flags, mounted, T_world_rig, samples) / np.float32(255 * surface.brightness)
    return np.asarray(np.minimum(shown, 1), np.float32)
