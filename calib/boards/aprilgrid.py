"""Detection of AprilTag grids in mirror images: any visible part of a grid counts.

The tags' borders are two bits wide, and black squares between the tags turn the tags' corners into corners of a
checkerboard. The tags that can be read predict the corners around them, to second order; these are found as saddle
points of grey, also those of tags that could not be read.
"""

from __future__ import annotations

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from calib.boards.board import TAG_BORDER_BITS, AprilGrid, BoardView
from calib.boards.corner_candidates import BLUR_PX, DerivedImage, Grey, Image, derived_images, smoothed
from calib.boards.corner_grid import shown_corners
from calib.boards.local_mapping import REACH, local_mapping, refined_corners, without_outliers
from calib.models.camera import Array

# Corners (4, 2) [px] of tags by number, in the order of cv2.aruco.
Tags = dict[int, Array]


# Least perimeter of a tag as a fraction of the image's larger side, and pixels per bit when it is read: half and 1.5 of
# OpenCV's defaults, because tags are small in a mirror image.
MIN_PERIMETER_PART, PIXELS_PER_BIT = 0.015, 6
# Tags whose middles are at most this many sides (of the larger one) apart must predict each other's position,
# within this part of a side.
NEIGHBOUR_SIDES, MAX_OFF_PART = 3.2, 0.45
# One tag alone may be misread; so many that lie as on the board are not.
MIN_TAGS, SURE_TAGS = 2, 6
# A predicted corner may move by a part of its tag's side and pixels.
MAX_MOVE, MAX_MOVE_PX = 0.12, 1.5
# Half side of the least window [px], because one of fewer than nine pixels does not show the corner alone.
MIN_WINDOW_PX = 1.5
# Least quality of a corner's ring, because the edge of what hides the board crosses others.
MIN_QUALITY = 0.6
# Least number of corners, and how far they lie off one line (ratio of the standard deviations), because fewer, or those
# of a line, determine no pose well.
MIN_CORNERS, MIN_SPREAD = 8, 0.1


def find_april_grid(image: Image, board: AprilGrid, name: str = "", *, thorough: bool = True) -> BoardView | None:
    """Find the visible corners of a grid in an image (H, W) uint8; None if there are too few.

    The view's pixels are NaN for corners that are hidden. thorough=False reads the original image only.
    """
    corners = board.tag_corners / board.tag_m
    tags = _read_tags(image, corners, thorough=thorough)
    if not tags:
        return None
    points = board.points[:, :2] / board.tag_m
    places, outlines = corners[list(tags)].reshape(-1, 2), np.concatenate(list(tags.values()))
    pixels = _grown(smoothed(image, BLUR_PX), points, places, outlines, board.window)
    pixels = without_outliers(points, refined_corners(image, points, pixels, board.window))
    seen = np.isfinite(pixels[:, 0])
    if seen.sum() < MIN_CORNERS:
        return None
    spread = np.linalg.svd(points[seen] - points[seen].mean(axis=0), compute_uv=False)
    if spread[1] <= MIN_SPREAD * spread[0]:
        return None
    return BoardView(name, pixels)


def _read_tags(image: Image, on_board: Array, *, thorough: bool) -> Tags:
    """Read the tags of a grid in an image (H, W) uint8, seen directly or in a mirror, and leave out misread ones.

    on_board (M, 4, 2): the corners of all tags.
    """
    best: dict[bool, Tags] = {False: {}, True: {}}
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = TAG_BORDER_BITS
    parameters.minMarkerPerimeterRate = MIN_PERIMETER_PART
    parameters.perspectiveRemovePixelPerCell = PIXELS_PER_BIT
    detector = cv2.aruco.ArucoDetector(_dictionary(), parameters)
    for number, derived in enumerate(derived_images(image)):
        gained = False
        for reflected in (False, True):
            mine, other = len(best[reflected]), len(best[not reflected])
            # Several tags that lie as on the grid are no misread ones: the other view is not read. After the first
            # image the better of the two stays.
            if other >= SURE_TAGS or (number and mine < other):
                continue
            found = _detected(detector, derived, reflected)
            best[reflected] = consistent_tags({**found, **best[reflected]}, on_board)
            gained |= len(best[reflected]) > mine
        most = max(map(len, best.values()))
        # Where a derived image shows no further tag of a grid that is well seen, the next one does not either.
        is_enough = most == len(on_board) or (number and not gained)
        if not thorough or (most >= min(SURE_TAGS, len(on_board)) and is_enough):
            break
    found = max(best.values(), key=len)
    return found if len(found) >= MIN_TAGS else {}


def consistent_tags(tags: Tags, on_board: Array) -> Tags:
    """Return the largest set of tags each of which predicts the position of its neighbours in the set.

    on_board (M, 4, 2): the corners of all tags of the grid.
    """
    known = [number for number in tags if number < len(on_board)]
    if not known:
        return {}
    linked = _links(np.array([tags[k] for k in known]), on_board[known])
    _, labels = scipy.sparse.csgraph.connected_components(linked, directed=False)
    largest = np.flatnonzero(labels == np.bincount(labels).argmax())
    return {known[k]: tags[known[k]] for k in largest}


def _links(image: Array, board: Array) -> NDArray[np.bool_]:
    """Return the pairs (N, N) of tags that are near each other on the board, and each predict the other's middle.

    image (N, 4, 2) [px], board (N, 4, 2): the tags' corners.
    """
    middles, board_middles = image.mean(axis=1), board.mean(axis=1)
    side = np.linalg.norm(np.diff(image, axis=1), axis=2).mean(axis=1)
    board_side = np.linalg.norm(board[:, 0] - board[:, 1], axis=1)
    apart = np.linalg.norm(board_middles[:, None] - board_middles, axis=2)
    # The plane of tag a places the middle of tag b in the image.
    H = np.array(
        [
            cv2.getPerspectiveTransform(b.astype(np.float32), i.astype(np.float32))
            for b, i in zip(board, image, strict=True)
        ]
    )
    placed = np.einsum("aij,bj->abi", H, np.column_stack([board_middles, np.ones(len(board))]))
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.linalg.norm(placed[..., :2] / placed[..., 2:] - middles, axis=2)
    # The plane bends in a mirror: more over several sides.
    steps = np.maximum(1.0, apart / board_side / 2)
    predicts = (placed[..., 2] > 0) & (off < MAX_OFF_PART * side * steps)
    near = apart <= NEIGHBOUR_SIDES * np.maximum(board_side[:, None], board_side)
    return np.asarray(predicts & predicts.T & near & ~np.eye(len(image), dtype=bool))


def _detected(detector: cv2.aruco.ArucoDetector, derived: DerivedImage, reflected: bool) -> Tags:
    """Return the tags of a derived image in pixels of the source."""
    image = np.ascontiguousarray(derived.image[:, ::-1]) if reflected else derived.image
    corners, ids, _ = detector.detectMarkers(image)
    found = Tags()
    for pixels, number in zip(corners, () if ids is None else ids.ravel(), strict=True):
        at = np.asarray(pixels, float).reshape(4, 2)
        if reflected:
            at[:, 0] = image.shape[1] - 1 - at[:, 0]
        found.setdefault(int(number), derived.to_source(at))
    return found


def _dictionary() -> cv2.aruco.Dictionary:
    return cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)


def _grown(image: Grey, points: Array, places: Array, outlines: Array, window: float) -> Array:
    """Return the pixels (N, 2) of the board's points [squares] that the image shows, NaN for the others.

    places (M, 2) [squares] and outlines (M, 2) [px]: the tags' corners.
    """
    pixels = np.full(points.shape, np.nan)
    at, where = places, outlines
    refused = np.zeros(len(points), bool)
    while True:
        tried = np.flatnonzero(np.isnan(pixels[:, 0]) & ~refused)
        predicted = {int(k): local_mapping(points[k], at, where) for k in tried}
        mappings = {k: m for k, m in predicted.items() if m is not None and window * m.side_px > MIN_WINDOW_PX}
        if not mappings:
            break
        search_px = [MAX_MOVE * mapping.side_px + MAX_MOVE_PX for mapping in mappings.values()]
        found = shown_corners(image, mappings, window, search_px, MIN_QUALITY)
        refused[[k for k in mappings if k not in found]] = True
        if not found:
            break
        pixels[list(found)] = np.array(list(found.values()))
        new = np.isfinite(pixels[:, 0])
        # Corners are more accurate than the outlines of tags, which remain where there are no corners yet.
        far = np.linalg.norm(places[:, None] - points[new], axis=2).min(axis=1) > REACH
        at, where = np.vstack([points[new], places[far]]), np.vstack([pixels[new], outlines[far]])
    return pixels
