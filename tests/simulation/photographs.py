"""Images and textures that others made: photographs on walls, floors and pictures, and images that are broken.

Photographs are those that scikit-image installs (`pip install '.[test]'`), each with a license that allows it. Only its
files are read, the package is not imported.

Broken images are whole, but not of one instant or of one geometry: what buses, buffers and stabilisers make of them.
Each function returns images (N, H, W) of one camera; those that it leaves are the same objects. axis 0: a line is a row
of the raw image, and what follows it is below; 1: it is a column, as of a sensor that was mounted on its side.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.simulation.rendering.surfaces import Rectangle, Scene
from omnid.simulation.rendering.textures import PAINTERS, Random, Texture

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
    return Scene(tuple(_painter(face)(rng, face) for face in scene.rectangles))


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


Image = NDArray[np.uint8]
Line = int | Callable[[int], int]  # where the image breaks: a line, or that of each image by its number


def tear(
    images: Sequence[Image], line: Line, *, every: int = 1, axis: int = 0, new_below: bool = False, since: int = 1
) -> list[Image]:
    """Return images whose lines from one on are those of the image before, in each `every`-th from `since` on.

    new_below: the lines before it are old instead.
    """
    torn = list(images)
    for number in range(max(1, since), len(images)):
        if (number - since) % every == 0:
            first, second = images[number], images[number - 1]
            parts = (second, first) if new_below else (first, second)
            torn[number] = _joined(parts, _at(line, number), axis)
    return torn


def shift(images: Sequence[Image], by_px: tuple[int, int], *, since: int) -> list[Image]:
    """Return images that are displaced by (columns, rows) from one on; their edges are repeated."""
    return warp(images, np.array([[1.0, 0.0, by_px[0]], [0.0, 1.0, by_px[1]]]), since=since)


def turn(images: Sequence[Image], angle_deg: float, *, since: int) -> list[Image]:
    """Return images that are turned about their middle from one on, as by a mirror that has moved."""
    height, width = images[0].shape
    about = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), angle_deg, 1.0)
    return warp(images, np.asarray(about, float), since=since)


def warp(images: Sequence[Image], affine: NDArray[np.float64], *, since: int) -> list[Image]:
    """Return images that are mapped by an affine (2, 3) from one on; their edges are repeated."""
    height, width = images[0].shape
    return [
        np.asarray(cv2.warpAffine(image, affine, (width, height), borderMode=cv2.BORDER_REPLICATE), np.uint8)
        if number >= since
        else image
        for number, image in enumerate(images)
    ]


def repeat_lines(
    images: Sequence[Image], line: Line, count: int, *, every: int = 1, axis: int = 0, since: int = 1
) -> list[Image]:
    """Return images in which `count` lines from one on are there twice; negative: so many are missing."""
    found = list(images)
    for number in range(since, len(images), every):
        size, at = images[number].shape[axis], _at(line, number)
        lines = np.arange(size)
        source = np.where(lines < at, lines, np.clip(lines - count, 0, size - 1))
        found[number] = np.take(images[number], source, axis=axis)
    return found


def _at(line: Line, number: int) -> int:
    return line(number) if callable(line) else line


def _joined(parts: tuple[Image, Image], line: int, axis: int) -> Image:
    """Return the lines of the first part before a line, and those of the second one from it on."""
    before, after = (np.split(part, [line], axis=axis)[number] for number, part in enumerate(parts))
    return np.ascontiguousarray(np.concatenate([before, after], axis=axis))


def roll(images: Sequence[Image], share: float, *, axis: int = 0, since: int = 1) -> list[Image]:
    """Return images whose lines are exposed one after the other, the last one by a share of a period before the first.

    They are warped by the dense flow from the image before, from one on.
    """
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    height, width = images[0].shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    late = np.float32(share) * (x / np.float32(width) if axis else y / np.float32(height))
    rolled = list(images[:since])
    for before, now in pairwise(images[since - 1 :]):
        back = flow.calc(now, before, np.zeros((height, width, 2), np.float32))
        at = x - late * back[:, :, 0], y - late * back[:, :, 1]
        rolled.append(np.asarray(cv2.remap(now, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8))
    return rolled
