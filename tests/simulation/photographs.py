"""Photographs on walls, floors and pictures: files that scikit-image installs, each with a license that allows it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from omnid.simulation.rendering.surfaces import PAINTERS, Random, Rectangle, Scene, Texture

SURFACES: Final = ("brick.png", "gravel.png", "grass.png")  # each of 512x512 px, evenly lit
SURFACE_M: Final = 1.2  # width of a photograph of a surface
POSTERS: Final = (
    "astronaut.png",
    "camera.png",
    "chelsea.png",
    "coffee.png",
    "coins.png",
    "motorcycle_left.png",
    "retina.jpg",
    "rocket.jpg",
)
LEAST_PART: Final = 0.5  # of a photograph, that a picture shows


def with_photographs(scene: Scene, seed: int) -> Scene:
    """Return the scene with photographs of bricks, gravel and grass on walls and floor, and others as its pictures.

    Faces of boxes are pictures, too; the ceiling stays.
    """
    rng = np.random.default_rng([seed, 53])
    return Scene(tuple(_painter(face)(rng, face) for face in scene))


def _painter(face: Rectangle) -> Callable[[Random, Rectangle], Rectangle]:
    if face.name.startswith(("poster", "box")):
        return _as_poster
    return _as_surface if face.name in ("floor", "wall", *PAINTERS) else lambda _, unchanged: unchanged


def _as_surface(rng: Random, face: Rectangle) -> Rectangle:
    """Return a face covered by one photograph, next to its mirror images, so that it has no seams."""
    photograph = photographed(str(rng.choice(SURFACES)))
    both = np.block([[photograph, photograph[:, ::-1]], [photograph[::-1], photograph[::-1, ::-1]]])
    px_per_m = photograph.shape[1] / SURFACE_M
    rows, columns = (round(side_m * px_per_m) for side_m in (face.height_m, face.width_m))
    times = (-(-rows // both.shape[0]), -(-columns // both.shape[1]))
    shifted = np.roll(both, rng.integers(0, both.shape[0], 2), axis=(0, 1))
    return replace(face, texture=np.ascontiguousarray(np.tile(shifted, times)[:rows, :columns]))


def _as_poster(rng: Random, face: Rectangle) -> Rectangle:
    """Return a face that shows a part of a photograph."""
    photograph, shape = photographed(str(rng.choice(POSTERS))), face.texture.shape
    # The largest part of the face's form, then a random share of it at a random place.
    scale = rng.uniform(LEAST_PART, 1) * min(photograph.shape[0] / shape[0], photograph.shape[1] / shape[1])
    height, width = (max(2, int(scale * side)) for side in shape)
    top, left = (
        int(rng.integers(0, most - side + 1)) for most, side in zip(photograph.shape, (height, width), strict=True)
    )
    part = photograph[top : top + height, left : left + width]
    way = cv2.INTER_AREA if scale > 1 else cv2.INTER_LINEAR
    return replace(face, texture=np.asarray(cv2.resize(part, (shape[1], shape[0]), interpolation=way), np.uint8))


@cache
def photographed(name: str) -> Texture:
    """Return a photograph (H, W) in grey."""
    package = find_spec("skimage")
    if package is None or not package.submodule_search_locations:
        raise SystemExit("the photographs are files of scikit-image: pip install scikit-image")
    path = Path(package.submodule_search_locations[0]) / "data" / name
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise SystemExit(f"{path} cannot be read: install scikit-image 0.25 or later again")
    return np.asarray(image, np.uint8)
