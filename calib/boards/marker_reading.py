"""Reading of a board's markers in mirror images by cv2.aruco, and the choice of those that lie as on the board."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.boards.derived_images import DerivedImage, Image, derived_images
from calib.boards.marker_board import DICTIONARIES, MarkerLayout, predefined
from calib.models.camera import Array

# Corners (4, 2) [px] of markers by id, in the order of cv2.aruco.
Markers = dict[int, Array]
# Least perimeter of a marker in parts of the image's larger side, and pixels per bit when it is read: half and 1.5 of
# OpenCV's defaults, because markers are small in a mirror image.
MIN_PERIMETER_PART, PIXELS_PER_BIT = 0.015, 6
# Markers whose middles are at most this many sides (of the larger one) apart must predict each other's position,
# within this part of a side.
NEIGHBOUR_SIDES, MAX_OFF_PART = 3.2, 0.45
# One marker alone may be misread; so many that lie as on the board are not.
MIN_MARKERS, SURE_MARKERS = 2, 6
ENOUGH_PART = 0.9
# The largest dictionary of every family that users print.
FAMILIES = ("4X4_1000", "5X5_1000", "6X6_1000", "7X7_1000", "APRILTAG_36h11", "ARUCO_ORIGINAL")
# Least markers of another dictionary of which a hint tells.
MIN_HINT_MARKERS = 4


def read_markers(image: Image, layout: MarkerLayout, *, thorough: bool) -> Markers:
    """Read the markers of a board in an image (H, W) uint8, seen directly or in a mirror, and leave out misread ones.

    thorough=False reads the original image only.
    """
    best: dict[bool, Markers] = {False: {}, True: {}}
    detector = _detector(layout.border_bits)
    for number, derived in enumerate(derived_images(image)):
        gained = False
        for reflected in (False, True):
            mine, other = len(best[reflected]), len(best[not reflected])
            # Several markers that lie as on the board are no misread ones: the other view is not read. After the first
            # image the better of the two stays.
            if other >= SURE_MARKERS or (number and mine < other):
                continue
            found = _detected(detector, layout, derived, reflected)
            best[reflected] = consistent_markers({**found, **best[reflected]}, layout)
            gained |= len(best[reflected]) > mine
        most = max(map(len, best.values()))
        # The corners of a few markers that are missing are predicted by the others. Where a derived image shows no
        # further marker of a board that is well seen, the next one does not either.
        is_enough = most >= ENOUGH_PART * len(layout.ids) or (number and not gained)
        if not thorough or (most >= min(SURE_MARKERS, len(layout.ids)) and is_enough):
            break
    found = max(best.values(), key=len)
    return found if len(found) >= MIN_MARKERS else {}


def seen_dictionary(image: Image, border_bits: int) -> str | None:
    """Return the name of the smallest dictionary of which an image shows several markers; None if there is none."""
    detector, most, largest, family = _detector(border_bits), 0, 0, ""
    for name in FAMILIES:
        detector.setDictionary(predefined(name))
        for reflected in (False, True):
            ids = detector.detectMarkers(_reflected(image, reflected))[1]
            if ids is not None and len(np.unique(ids)) > most:
                most, largest, family = len(np.unique(ids)), int(ids.max()), name
    if most < MIN_HINT_MARKERS:
        return None
    # The smaller dictionaries of a family hold the first markers of the larger ones.
    sizes = {
        name: len(predefined(name).bytesList)
        for name in DICTIONARIES
        if name.rsplit("_", 1)[0] == family.rsplit("_", 1)[0]
    }
    return min((name for name in sizes if sizes[name] > largest), key=lambda name: sizes[name]) if sizes else family


def consistent_markers(markers: Markers, layout: MarkerLayout) -> Markers:
    """Return the largest set of markers each of which predicts the position of its neighbours in the set."""
    on_board = {int(number): corners for number, corners in zip(layout.ids, layout.corners, strict=True)}
    known = [number for number in markers if number in on_board]
    if not known:
        return {}
    linked = _links(np.array([markers[k] for k in known]), np.array([on_board[k] for k in known]))
    links = {number: [known[other] for other in np.flatnonzero(row)] for number, row in zip(known, linked, strict=True)}
    best, left = list[int](), set(known)
    while left:
        group, queue = set[int](), [left.pop()]
        while queue:
            number = queue.pop()
            group.add(number)
            queue += [other for other in links[number] if other not in group]
        left -= group
        best = sorted(group) if len(group) > len(best) else best
    return {number: markers[number] for number in best}


def _links(image: Array, board: Array) -> NDArray[np.bool_]:
    """Return the pairs (N, N) of markers that are near each other on the board, and each predict the other's middle.

    image (N, 4, 2) [px], board (N, 4, 2) [m]: the markers' corners.
    """
    middles, board_middles = image.mean(axis=1), board.mean(axis=1)
    side = np.linalg.norm(np.diff(image, axis=1), axis=2).mean(axis=1)
    board_side = np.linalg.norm(board[:, 0] - board[:, 1], axis=1)
    apart = np.linalg.norm(board_middles[:, None] - board_middles, axis=2)
    # The plane of marker a places the middle of marker b in the image.
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


def _detector(border_bits: int) -> cv2.aruco.ArucoDetector:
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border_bits
    parameters.minMarkerPerimeterRate = MIN_PERIMETER_PART
    parameters.perspectiveRemovePixelPerCell = PIXELS_PER_BIT
    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(0), parameters)


def _detected(
    detector: cv2.aruco.ArucoDetector, layout: MarkerLayout, derived: DerivedImage, reflected: bool
) -> Markers:
    """Return the markers of a derived image in pixels of the source."""
    detector.setDictionary(layout.dictionary)
    corners, ids, _ = detector.detectMarkers(_reflected(derived.image, reflected))
    found = Markers()
    for pixels, number in zip(corners, () if ids is None else ids.ravel(), strict=True):
        at = np.asarray(pixels, float).reshape(4, 2)
        if reflected:
            at[:, 0] = derived.image.shape[1] - 1 - at[:, 0]
        found.setdefault(int(number), derived.to_source(at))
    return found


def _reflected(image: Image, reflected: bool) -> NDArray[np.uint8]:
    return np.ascontiguousarray(image[:, ::-1]) if reflected else image
