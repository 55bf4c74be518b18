"""Textures of a scene in one array, with halved sizes of each, as the compiled caster reads them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.simulation.rendering.surfaces import Texture

# Number of scenes whose textures are kept.
MAX_ATLASES = 3
SMALLEST_PX = 8


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


_atlases: list[Atlas] = []  # the one used last at the end


def cached_atlas(textures: Sequence[Texture]) -> Atlas:
    """Return the atlas of textures; the texels of one that has them all are shared, whatever their order."""
    for number, atlas in enumerate(_atlases):
        rows = {id(texture): row for row, texture in enumerate(atlas.textures)}
        if all(id(texture) in rows for texture in textures):
            _atlases.append(_atlases.pop(number))
            return replace(atlas, pyramids=atlas.pyramids[[rows[id(texture)] for texture in textures]])
    del _atlases[: len(_atlases) - MAX_ATLASES + 1]
    _atlases.append(make_atlas(textures))
    return _atlases[-1]
