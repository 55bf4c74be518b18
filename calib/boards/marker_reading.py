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
# One marker alone may be misread.
MIN_MARKERS = 2
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
        for reflected in (False, True):
            # After the first image the better of the two stays.
            mine, other = len(best[reflected]), len(best[not reflected])
            if number and (mine < other or mine == len(layout.ids)):
                continue
            found = _detected(detector, layout, derived, reflected)
            best[reflected] = consistent_markers({**found, **best[reflected]}, layout)
        if not thorough:
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
    links = {
        number: [other for other in known if other != number and _is_neighbour(number, other, markers, on_board)]
        for number in known
    }
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


def _is_neighbour(number: int, other: int, markers: Markers, on_board: Markers) -> bool:
    """True if two markers are near each other on the board, and each predicts the other's middle."""
    sides = [float(np.linalg.norm(on_board[one][0] - on_board[one][1])) for one in (number, other)]
    apart = float(np.linalg.norm(on_board[number].mean(axis=0) - on_board[other].mean(axis=0)))
    return apart <= NEIGHBOUR_SIDES * max(sides) and all(
        _predicts(markers[a], on_board[a], markers[b], on_board[b]) for a, b in ((number, other), (other, number))
    )


def _predicts(image_a: Array, board_a: Array, image_b: Array, board_b: Array) -> bool:
    """True if the plane of marker a places the middle of marker b, in the image, where it is."""
    H = cv2.getPerspectiveTransform(board_a.astype(np.float32), image_a.astype(np.float32))
    middle = H @ np.array([*board_b.mean(axis=0), 1.0])
    side = float(np.linalg.norm(np.diff(image_b, axis=0), axis=1).mean())
    off = np.linalg.norm(middle[:2] / middle[2] - image_b.mean(axis=0))
    # The plane bends in a mirror: more over several sides.
    steps = float(np.linalg.norm(board_b.mean(axis=0) - board_a.mean(axis=0)) / np.linalg.norm(board_b[0] - board_b[1]))
    return bool(middle[2] > 0 and off < MAX_OFF_PART * side * max(1.0, steps / 2))


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
