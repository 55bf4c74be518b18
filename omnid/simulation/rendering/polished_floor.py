"""Images of a world whose floor is polished: it mirrors the objects on it.

A reflection in a plane is the image of the world mirrored in that plane, seen where the plane is seen. Polished stone,
lacquered wood and wet tiles reflect by Fresnel's equations for n = 1.5: 4 % straight down, 9 % at 60 degrees from the
vertical, 25 % at 75 degrees. From a camera 0.9 m above the floor that is 5 % at 1 m and 17 % at 3 m.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from calib.models.camera import Array
from calib.rig import MountedCamera
from omnid.simulation.rendering.ray_caster import render_grey
from omnid.simulation.rendering.sensor import Floats
from omnid.simulation.rendering.surfaces import Rectangle, Scene, Texture

REFRACTIVE_INDEX: Final = 1.5  # of glass, glazed tiles, polish and lacquer
WHITE: Final[Texture] = np.full((8, 8), 255, np.uint8)
BLACK: Final[Texture] = np.zeros((8, 8), np.uint8)


def reflectance(cosine: Floats) -> Floats:
    """Return the share of unpolarised light that is reflected, by the cosine of the angle to the normal (Fresnel)."""
    n = np.float32(REFRACTIVE_INDEX)
    inside = np.sqrt(1 - (1 - cosine**2) / n**2)
    across, along = (cosine - n * inside) / (cosine + n * inside), (n * cosine - inside) / (n * cosine + inside)
    return np.asarray((across**2 + along**2) / 2, np.float32)


def below_floor(rectangle: Rectangle) -> Rectangle:
    """Return the mirror image of a rectangle in the floor z = 0."""
    by = np.array([1.0, 1.0, -1.0])
    return replace(rectangle, origin=rectangle.origin * by, edge_u=rectangle.edge_u * by, edge_v=rectangle.edge_v * by)


class PolishedFloor:
    """Renders what a camera sees on a polished floor; the rectangles named "floor" are that floor."""

    def __init__(self, mounted: MountedCamera) -> None:
        width, height = mounted.camera.size
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
        rays = mounted.camera.lift(pixels.astype(float)) @ mounted.T_cam_rig[:3, :3]
        self._rays = np.nan_to_num(rays).astype(np.float32)  # (H W, 3) in the rig frame
        self._mounted = mounted

    def reflected(self, image: Floats, scene: Scene, T_world_rig: Array, samples: int) -> Floats:
        """Return the ideal image (H, W) of a scene with what its floor mirrors."""
        # 1. The part of each pixel that shows the floor, times what the floor reflects at the pixel's angle.
        floor = scene.named("floor")
        flags = Scene(tuple(replace(r, texture=WHITE if r.name == "floor" else BLACK) for r in scene.rectangles))
        shown = render_grey(flags, self._mounted, T_world_rig, 1) / np.float32(255 * floor.brightness)
        cosine = np.abs(self._rays @ T_world_rig[2, :3].astype(np.float32)).reshape(image.shape)
        share = np.minimum(shown, 1) * reflectance(cosine)
        # 2. The world upside down, seen through the floor.
        below = Scene(tuple(below_floor(r) for r in scene.rectangles if r.name != "floor"))
        mirrored = render_grey(below, self._mounted, T_world_rig, samples)
        return np.asarray(image + share * (mirrored - image), np.float32)
