"""AprilTag grids as Kalibr prints them, and their detection in mirror images: any visible part of a grid counts.

The tags' borders are two bits wide, and black squares between the tags turn the tags' corners into corners of a
checkerboard. The tags that can be read predict the corners around them, to second order; these are found as saddle
points of grey, also those of tags that could not be read.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from calib.boards.board import MAX_SQUARE_M, MIN_SQUARE_M, BoardView
from calib.boards.board_shape import quadratic_terms
from calib.boards.corner_candidates import BLUR_PX, Grey, describe_corners, smoothed
from calib.boards.corner_grid import WINDOW_PART, refine_subpixel
from calib.boards.corner_refinement import refine_in_mappings
from calib.boards.derived_images import DerivedImage, Image, derived_images
from calib.errors import CalibError
from calib.models.camera import Array

# Corners (4, 2) [px] of tags by number, in the order of cv2.aruco.
Tags = dict[int, Array]
# Least and largest space between two tags, in parts of a tag.
MIN_SPACING, MAX_SPACING = 0.05, 1.0
# Tags as in Kalibr: number of those of the family 36h11, width of the border [bits], bits along a side within it.
TAGS, TAG_BORDER_BITS, TAG_BITS = 587, 2, 6
# Tag 0 of the family 36h11 (Olson 2011): row by row, the most significant bit at the upper left, 1 is light.
TAG_0 = 0xD5D628584


# Least perimeter of a tag in parts of the image's larger side, and pixels per bit when it is read: half and 1.5 of
# OpenCV's defaults, because tags are small in a mirror image.
MIN_PERIMETER_PART, PIXELS_PER_BIT = 0.015, 6
# Tags whose middles are at most this many sides (of the larger one) apart must predict each other's position,
# within this part of a side.
NEIGHBOUR_SIDES, MAX_OFF_PART = 3.2, 0.45
# One tag alone may be misread; so many that lie as on the board are not.
MIN_TAGS, SURE_TAGS = 2, 6
ENOUGH_PART = 0.9
# Points of which a mapping is fitted: the nearest ones, its reach [squares], width of their Gaussian weight
# [squares].
NEAREST, REACH, WEIGHT_WIDTH = 24, 3.0, 1.5
# Least numbers of points of a mapping of third, second and first order, because these have 10, 6 and 3 terms.
MIN_CUBIC, MIN_QUADRATIC, MIN_AFFINE = 16, 10, 4
# Least ratio of the mapping's singular values.
MIN_CONDITION = 0.02
# A predicted corner lies at most this far from a known one [squares]; it may move by a part of its square and pixels.
MAX_AHEAD, MAX_MOVE, MAX_MOVE_PX = 1.1, 0.12, 1.5
# Radius of the ring about a corner, in parts of the window, and least radius [px].
RING_PART, MIN_RING_PX = 1.2, 1.8
# Half side of the window of the first refinement [px]; a smaller one has fewer than nine pixels, too few.
MIN_WINDOW_PX = 1.5
ROUNDS = 12  # enough: the boards of test_aprilgrid.py take 2 to 4
# Least quality of a corner's ring, because the edge of what hides the board crosses others.
MIN_QUALITY = 0.4
# Largest distance of a corner from the mapping of the others: in squares, and in pixels added to it.
MAX_IRREGULARITY, MAX_IRREGULARITY_PX = 0.03, 0.4
# Least number of corners, and how far they lie off one line (ratio of the standard deviations), because fewer, or those
# of a line, determine no pose well.
MIN_CORNERS, MIN_SPREAD = 8, 0.1


@dataclass(frozen=True, slots=True)
class AprilGrid:
    """A grid of columns x rows AprilTags 36h11 of tag_m, spacing times tag_m apart, as Kalibr prints it.

    The numbers of the tags rise along x, then along y, from 0. Kalibr's frame: x right, y up, origin at the lower left
    corner of tag 0.
    """

    columns: int
    rows: int
    tag_m: float
    spacing: float

    def __post_init__(self) -> None:
        if not 1 <= self.columns * self.rows <= TAGS:
            raise CalibError(
                f"board: expected 1 to {TAGS} tags, as the family 36h11 has, found {self.columns}x{self.rows}"
            )
        if not MIN_SQUARE_M <= self.tag_m <= MAX_SQUARE_M:
            raise CalibError(f"board: expected tags of 0.1 mm to 10 m, found {self.tag_m * 1e3:g} mm")
        if not MIN_SPACING <= self.spacing <= MAX_SPACING:
            raise CalibError(
                f"board: expected a space between tags of {MIN_SPACING:g} to {MAX_SPACING:g} of a tag's "
                f"side, like Kalibr's tagSpacing, found {self.spacing:g}"
            )

    @property
    def square_m(self) -> float:
        """Return the side of a tag [m], the unit of the windows about corners."""
        return self.tag_m

    @property
    def points(self) -> Array:
        """Return the corners of all tags (N, 3) [m], row by row upwards, z 0."""
        x, y = np.meshgrid(self._ends(self.columns), self._ends(self.rows))
        return np.asarray(np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) * self.tag_m)

    @property
    def window(self) -> float:
        """Return the half side, in tags, of a window about a tag's corner: its border, the square beside it."""
        return min(self.spacing, TAG_BORDER_BITS / (TAG_BITS + 2 * TAG_BORDER_BITS))

    @property
    def tag_corners(self) -> Array:
        """Return the corners (M, 4, 2) [m] of the tags in the order of cv2.aruco."""
        y, x = np.divmod(np.arange(self.columns * self.rows), self.columns)
        # Clockwise from the upper left of the tag as Kalibr prints it, then from that of OpenCV's dictionary.
        corner = np.roll(np.array([[0, 1], [1, 1], [1, 0], [0, 0]]), _quarter_turns(), axis=0)
        return np.asarray((np.column_stack([x, y])[:, None] * (1 + self.spacing) + corner) * self.tag_m)

    def __str__(self) -> str:
        return f"AprilTag grid of {self.columns}x{self.rows} tags"

    def _ends(self, tags: int) -> Array:
        return np.asarray((np.arange(tags)[:, None] * (1 + self.spacing) + [0, 1]).ravel())


@dataclass(frozen=True, slots=True)
class LocalMapping:
    """Coefficients (6, 2) of pixels by 1, x, y, x^2, xy, y^2 about a place of a board [squares].

    gain: ratio of the standard deviations of the place's pixel and of the points' pixels; above 1 beyond their outline,
    infinite for a mapping of first order, which does not hold the curvature of a mirror image.
    """

    coefficients: Array
    gain: float


def find_april_grid(image: Image, board: AprilGrid, name: str = "", *, thorough: bool = True) -> BoardView | None:
    """Find the visible corners of a grid in an image (H, W) uint8; None if there are too few.

    The view's pixels are NaN for corners that are hidden; its confidence is the share of visible ones. thorough=False
    reads the original image only.
    """
    corners = board.tag_corners / board.tag_m
    tags = _read_tags(image, corners, thorough=thorough)
    if not tags:
        return None
    points = board.points[:, :2] / board.tag_m
    places, outlines = corners[list(tags)].reshape(-1, 2), np.concatenate(list(tags.values()))
    pixels = _grown(smoothed(image, BLUR_PX), points, places, outlines, board.window)
    pixels = _refined(image.astype(np.float32), points, pixels, board.window)
    seen = np.isfinite(pixels[:, 0])
    if seen.sum() < MIN_CORNERS or not _is_spread(points[seen]):
        return None
    return BoardView(name, pixels, float(seen.mean()))


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
        # The corners of a few tags that are missing are predicted by the others. Where a derived image shows no further
        # tag of a grid that is well seen, the next one does not either.
        is_enough = most >= ENOUGH_PART * len(on_board) or (number and not gained)
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


@lru_cache(maxsize=1)
def _quarter_turns() -> int:
    """Return the counter-clockwise quarter turns from OpenCV's tags to the family's."""
    image = cv2.aruco.generateImageMarker(_dictionary(), 0, TAG_BITS + 2, borderBits=1)[1:-1, 1:-1] > 0
    bits = np.array([TAG_0 >> k & 1 for k in range(TAG_BITS**2 - 1, -1, -1)], bool).reshape(TAG_BITS, TAG_BITS)
    return next(k for k in range(4) if (np.rot90(image, k) == bits).all())


def _grown(image: Grey, points: Array, places: Array, outlines: Array, window: float) -> Array:
    """Return the pixels (N, 2) of the board's points [squares] that the image shows, NaN for the others.

    places (M, 2) [squares] and outlines (M, 2) [px]: the tags' corners.
    """
    pixels = np.full(points.shape, np.nan)
    at, where = places, outlines
    refused = np.zeros(len(points), bool)
    for _ in range(ROUNDS):
        tried = np.flatnonzero(np.isnan(pixels[:, 0]) & ~refused)
        mappings = {int(k): mapping for k in tried if (mapping := _local_mapping(points[k], at, where)) is not None}
        if not mappings:
            break
        found = _accepted(image, mappings, window)
        refused[[k for k in mappings if k not in found]] = True
        if not found:
            break
        pixels[list(found)] = np.array(list(found.values()))
        new = np.isfinite(pixels[:, 0])
        # Corners are more accurate than the outlines of tags, which remain where there are no corners yet.
        far = np.linalg.norm(places[:, None] - points[new], axis=2).min(axis=1) > REACH
        at, where = np.vstack([points[new], places[far]]), np.vstack([pixels[new], outlines[far]])
    return pixels


def _local_mapping(place: Array, at: Array, where: Array, *, exact: bool = False) -> LocalMapping | None:
    """Fit the mapping from the board to the image about a place (2,) [squares] of the board.

    at (M, 2) [squares], where (M, 2) [px]: known points; exact: they are refined corners, whose third order is fitted
    too. None if too few are near, or all on one side far away.
    """
    offset = at - place
    distance = np.linalg.norm(offset, axis=1)
    near = np.argsort(distance)[:NEAREST]
    near = near[distance[near] < REACH]
    if len(near) < MIN_AFFINE or distance[near[0]] > MAX_AHEAD:
        return None
    weight = np.exp(-((distance[near] / WEIGHT_WIDTH) ** 2) / 2)[:, None]
    x, y = offset[near].T
    terms = np.column_stack([quadratic_terms(x, y), x**3, x * x * y, x * y * y, y**3])
    counts = [
        count
        for count, least in ((10, MIN_CUBIC), (6, MIN_QUADRATIC), (3, MIN_AFFINE))
        if len(near) >= least and (exact or count < 10)
    ]
    for count in counts:
        left, values, right = np.linalg.svd(terms[:, :count] * weight, full_matrices=False)
        if values[-1] > MIN_CONDITION * values[0]:
            inverse = (right.T / values) @ left.T * weight.T
            coefficients = np.vstack([(inverse @ where[near])[:6], np.zeros((max(0, 6 - count), 2))])
            return LocalMapping(coefficients, float(np.linalg.norm(inverse[0])) if count > 3 else np.inf)
    return None


def _accepted(image: Grey, mappings: dict[int, LocalMapping], window: float) -> dict[int, Array]:
    """Return the predicted corners that the image shows, by number."""
    start = np.array([mapping.coefficients[0] for mapping in mappings.values()])
    sizes = np.array([_side_px(mapping) for mapping in mappings.values()])
    height, width = image.shape
    inside = ((start > 3) & (start < np.array([width, height]) - 4)).all(axis=1) & (window * sizes > MIN_WINDOW_PX)
    refined = start.copy()
    refined[inside] = refine_subpixel(image, start[inside], window / WINDOW_PART * sizes[inside])
    seen = describe_corners(image, refined, np.maximum(MIN_RING_PX, RING_PART * window * sizes))
    near = np.linalg.norm(refined - start, axis=1) < MAX_MOVE * sizes + MAX_MOVE_PX
    good = inside & near & (seen.quality > MIN_QUALITY)
    return {k: pixel for k, pixel, fine in zip(mappings, refined, good, strict=True) if fine}


def _side_px(mapping: LocalMapping) -> float:
    """Return the narrower side of a square in a mapping [px]."""
    return float(np.linalg.svd(mapping.coefficients[1:3], compute_uv=False)[-1])


def _refined(grey: Grey, points: Array, pixels: Array, window: float) -> Array:
    """Return the pixels moved onto the corners, without those off the mapping of their neighbours."""
    good = pixels.copy()
    seen = [int(k) for k in np.flatnonzero(np.isfinite(pixels[:, 0]))]
    mappings = {k: mapping for k in seen if (mapping := _mapping_of_others(points, pixels, k)) is not None}
    if mappings:
        own = np.array([np.vstack([pixels[k], mapping.coefficients[1:]]) for k, mapping in mappings.items()])
        good[list(mappings)] = refine_in_mappings(grey, own, own[:, 0], window)
    for _ in range(len(points)):
        left = [int(k) for k in np.flatnonzero(np.isfinite(good[:, 0]))]
        off = {k: _irregularity(_mapping_of_others(points, good, k), good[k]) for k in left}
        worst = max(off, key=lambda k: off[k], default=None)
        if worst is None or off[worst] < 1:
            break
        # One at a time: an outlier spoils the mappings of its neighbours.
        good[worst] = np.nan
    return good


def _mapping_of_others(points: Array, pixels: Array, k: int) -> LocalMapping | None:
    others = np.isfinite(pixels[:, 0])
    others[k] = False
    return _local_mapping(points[k], points[others], pixels[others], exact=True)


def _irregularity(mapping: LocalMapping | None, pixel: Array) -> float:
    """Return the distance of a corner from the mapping of the others, in parts of the largest one.

    Outside their outline they determine it less well; 0 where they do not. Infinite if there are none.
    """
    if mapping is None:
        return np.inf
    off = np.linalg.norm(mapping.coefficients[0] - pixel)
    limit = MAX_IRREGULARITY * _side_px(mapping) + MAX_IRREGULARITY_PX
    return float(off / (limit * max(1.0, mapping.gain) ** 2))


def _is_spread(points: Array) -> bool:
    values = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(values[1] > MIN_SPREAD * values[0])
