"""The enhanced SAD: which of several equally good matches is right (Dang et al. 2012, section III.B).

A point with one candidate is matched at once and becomes an anchor. A point with several takes the nearest anchor and
adds, for each candidate, the difference of the intensities along the line from the point to the anchor in the lower
panorama and along the line from the candidate to the anchor's match in the upper one. The lowest total wins.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Array = NDArray[np.float32]

REMAP_ROWS = 32_000  # cv2.remap takes no more rows than a short counts


def nearest_anchor(shape: tuple[int, int], anchors: NDArray[np.intp], points: NDArray[np.intp]) -> NDArray[np.intp]:
    """For each point (flat index) the position in `anchors` of the nearest anchor (flat indices; at least one)."""
    free = np.full(shape, 255, np.uint8)
    free.reshape(-1)[anchors] = 0
    _, labels = cv2.distanceTransformWithLabels(free, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    position = np.zeros(labels.max() + 1, np.intp)
    position[labels.reshape(-1)[anchors]] = np.arange(len(anchors))
    return np.asarray(position[labels.reshape(-1)[points]])


def line_difference(lower: Image, upper: Image, ends: tuple[Array, Array, Array, Array], samples: int = 32) -> Array:
    """Mean absolute difference (N,) of grey levels between two bundles of lines.

    ends: point and anchor in the lower panorama, candidate and the anchor's match in the upper one, each (N, 2) as
    (column, row); sampled at equal fractions of their lengths.
    """
    point, anchor, candidate, match = ends
    along = ((np.arange(samples, dtype=np.float32) + 0.5) / samples)[None, :, None]
    in_lower = point[:, None] + along * (anchor - point)[:, None]
    in_upper = candidate[:, None] + along * (match - candidate)[:, None]
    difference = cv2.absdiff(_sample(lower, in_lower), _sample(upper, in_upper))
    return np.asarray(difference.mean(axis=1, dtype=np.float32))


def _sample(image: Image, positions: Array) -> Image:
    """Grey levels (N, S) uint8 at positions (N, S, 2)."""
    columns, rows = np.ascontiguousarray(np.moveaxis(positions, 2, 0))
    starts = range(0, len(positions), REMAP_ROWS)
    chunks = [cv2.remap(image, columns[k : k + REMAP_ROWS], rows[k : k + REMAP_ROWS], cv2.INTER_LINEAR,
                        borderMode=cv2.BORDER_REPLICATE) for k in starts]
    return np.asarray(np.concatenate(chunks), np.uint8)
