"""Rows of a map file: keyframes, links and the head as tuples of values, written and checked."""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import DTypeLike, NDArray

from calib.panorama import Cylinder
from omnid.core.mapping.range_scan import MAX_RANGE_M, SECTORS
from omnid.core.places.map_tags import MapTag, TagView
from omnid.core.places.place_map import KeyframeUse, Link, PlaceFeatures, PlaceKeyframe, PlaceMap
from omnid.core.places.place_rig import PlaceRig
from omnid.core.places.tags import MAX_NAME, MAX_TAG, SIZES_M

Array = NDArray[np.float64]
Row: TypeAlias = tuple[Any, ...]

MAX_INTEGER: Final = 1 << 62
MAX_FEATURES: Final = 4096  # Most features of a keyframe.
MAX_POSITION_M: Final = 1e5
MAX_PIXELS: Final = 1 << 15  # Largest width and height of a panorama.
MAX_VARIANCE: Final = 1e8  # m^2 and rad^2
LEAST_VARIANCE: Final = 1e-16  # Least variance of a loop in any direction, so that its covariance can be inverted.
RIGID: Final = 1e-6  # largest difference of R R^T from the identity
THUMBNAIL: Final = (16, 128)
DESCRIPTOR: Final = 128
MAX_HASH: Final = 128  # characters
BASELINES_M: Final = (1e-3, 1e2)


class BadRowError(ValueError):
    """A row that no omnid has written."""


class Head(NamedTuple):
    """The row of the table `map`."""

    rig: PlaceRig
    keyframes: int
    links: int
    dropped: int
    tags: int
    tag_views: int


def checksum(row: Row) -> int:
    """Return the CRC-32 of the values: numbers and texts as text, arrays as their bytes."""
    crc = 0
    for value in row:
        crc = zlib.crc32(value if isinstance(value, bytes) else repr(value).encode("utf-8", "replace"), crc)
    return crc


def keyframe_row(keyframe: PlaceKeyframe, T_map_rect: Array, use: KeyframeUse) -> Row:
    """Return the row of a keyframe."""
    features = keyframe.features
    return (
        keyframe.id,
        keyframe.session,
        keyframe.stamp_ns,
        use.found,
        use.missed,
        _bytes(T_map_rect[:3], "<f8"),
        _bytes(keyframe.T_odom_rect[:3], "<f8"),
        _bytes(keyframe.covariance, "<f8"),
        _bytes(keyframe.thumbnail, "i1"),
        _bytes(keyframe.scan, "<f2"),
        _bytes(features.descriptors, "u1"),
        _bytes(features.views, "<f4"),
    )


def link_row(link: Link) -> Row:
    """Return the row of a link."""
    return link.a, link.b, link.inliers, _bytes(link.T_a_b[:3], "<f8"), _bytes(link.covariance, "<f8")


def tag_row(tag: MapTag) -> Row:
    """Return the row of a tag."""
    return tag.id, tag.name, float(tag.size_m)


def tag_view_row(view: TagView) -> Row:
    """Return the row of a view of a tag."""
    return view.keyframe, view.tag, _bytes(view.T_rect_tag[:3], "<f8"), _bytes(view.covariance, "<f8")


def map_row(rig: PlaceRig, places: PlaceMap) -> Row:
    """Return the row of the table `map`."""
    return (
        len(places.keyframes),
        len(places.links),
        places.dropped,
        len(places.tags.known),
        len(places.tags.views),
        rig.cylinder.width,
        rig.cylinder.height,
        float(rig.cylinder.row0),
        float(rig.baseline_m),
        _bytes(rig.T_rig_rect[:3], "<f8"),
        _bytes(rig.T_base_rig[:3], "<f8"),
        rig.rig_hash,
    )


def read_map_row(row: Row) -> Head:
    """Return the head of a map. Raises BadRowError."""
    keyframes, links, dropped, tags, tag_views, width, height, row0, baseline_m, T_rig_rect, T_base_rig, rig_hash = row
    if not isinstance(rig_hash, str) or len(rig_hash) > MAX_HASH or not rig_hash.isalnum():
        raise BadRowError("the hash of the rig is none")
    cylinder = Cylinder(_integer(width, 1, MAX_PIXELS), _integer(height, 1, MAX_PIXELS), _number(row0, -1e6, 1e6))
    rig = PlaceRig(
        cylinder, _number(baseline_m, *BASELINES_M), _transform(T_rig_rect), _transform(T_base_rig), rig_hash
    )
    require_rigid([rig.T_rig_rect, rig.T_base_rig])
    return Head(rig, _integer(keyframes), _integer(links), _integer(dropped), _integer(tags), _integer(tag_views))


def head_of_version_2(row: Row) -> Row:
    """Return the row `map` of version 2, which had no tags, as one of today."""
    return (*row[:3], 0, 0, *row[3:])


def read_keyframe_row(row: Row, rig: PlaceRig) -> tuple[PlaceKeyframe, Array, KeyframeUse]:
    """Return a keyframe, its pose T_map_rect (4, 4) and its use. Raises BadRowError.

    Poses and covariance are not checked.
    """
    id, session, stamp_ns, found, missed, T_map_rect, T_odom_rect, covariance, thumbnail, scan, descriptors, views = row
    ranges = _array(scan, "<f2", (SECTORS,))
    if not (np.isnan(ranges) | ((ranges >= 0) & (ranges <= MAX_RANGE_M))).all():
        raise BadRowError(f"a range of keyframe {id!r} is outside 0 to {MAX_RANGE_M:g} m")
    features = PlaceFeatures(_array(descriptors, "u1", (-1, DESCRIPTOR)), _array(views, "<f4", (-1, 3)))
    if len(features.descriptors) != len(features.views) or len(features.views) > MAX_FEATURES:
        raise BadRowError(f"{len(features.descriptors)} descriptors and {len(features.views)} views in a keyframe")
    column, lower, upper = features.views.T
    width, height = rig.cylinder.width, rig.cylinder.height
    # NaN fails too. The horizon of the upper camera may show a point beyond the lower one's panorama.
    if not (
        (np.abs(column) <= 2 * width) & (np.abs(lower) <= 2 * height) & (upper > lower) & (upper <= 3 * height)
    ).all():
        raise BadRowError("a view of a keyframe is outside the panorama")
    keyframe = PlaceKeyframe(
        _integer(id),
        _integer(session),
        _integer(stamp_ns, -MAX_INTEGER),
        _transform(T_odom_rect),
        _array(covariance, "<f8", (6, 6)),
        _array(thumbnail, "i1", THUMBNAIL),
        ranges,
        features,
    )
    return keyframe, _transform(T_map_rect), KeyframeUse(_integer(found), _integer(missed))


def read_link_row(row: Row) -> Link:
    """Return a link. Raises BadRowError. Its pose and covariance are not checked."""
    a, b, inliers, T_a_b, covariance = row
    return Link(_integer(a), _integer(b), _transform(T_a_b), _array(covariance, "<f8", (6, 6)), _integer(inliers))


def read_tag_row(row: Row) -> MapTag:
    """Return a tag. Raises BadRowError."""
    id, name, size_m = row
    if not isinstance(name, str) or not 0 < len(name) <= MAX_NAME or not name.isprintable():
        raise BadRowError("the name of a tag is none")
    return MapTag(_integer(id, 0, MAX_TAG), name, _number(size_m, *SIZES_M))


def read_tag_view_row(row: Row) -> TagView:
    """Return a view of a tag. Raises BadRowError. Its pose and covariance are not checked."""
    keyframe, tag, T_rect_tag, covariance = row
    return TagView(_integer(keyframe), _integer(tag), _transform(T_rect_tag), _array(covariance, "<f8", (6, 6)))


def require_rigid(transforms: Sequence[Array]) -> None:
    """Check that all are rotations and translations of the size of a place. Raises BadRowError."""
    if not transforms:
        return
    T = np.array(transforms)
    R = T[:, :3, :3]
    if not np.isfinite(T).all() or (np.abs(T[:, :3, 3]) > MAX_POSITION_M).any() or (np.abs(R) > 2).any():
        raise BadRowError("a pose is not finite, or too far away")
    if (np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)) > RIGID).any() or (np.linalg.det(R) < 0).any():
        raise BadRowError("a pose is no rotation")


def require_covariances(covariances: Sequence[Array], least: float) -> None:
    """Check that all are symmetric, with eigenvalues from `least` on. Raises BadRowError."""
    if not covariances:
        return
    P = np.array(covariances)
    if not np.isfinite(P).all() or (np.abs(P) > MAX_VARIANCE).any():
        raise BadRowError("a covariance is not finite, or too large")
    rounding = 1e-9 * np.abs(P).max(axis=(1, 2))
    if (np.abs(P - np.swapaxes(P, 1, 2)).max(axis=(1, 2)) > rounding).any():
        raise BadRowError("a covariance is not symmetric")
    if (np.linalg.eigvalsh(P)[:, 0] < (least or -rounding)).any():
        raise BadRowError("a covariance is not positive")


def _bytes(values: NDArray[Any], dtype: str) -> bytes:
    return np.ascontiguousarray(values, np.dtype(dtype)).tobytes()


def _array(value: object, dtype: DTypeLike, shape: tuple[int, ...]) -> NDArray[Any]:
    """Return an array of a shape, in which -1 is any number of rows."""
    kind = np.dtype(dtype)
    row_bytes = kind.itemsize * abs(math.prod(shape))
    if not isinstance(value, bytes) or (len(value) % row_bytes if shape[0] < 0 else len(value) != row_bytes):
        raise BadRowError("an array has another size")
    return np.frombuffer(value, kind).reshape(shape).astype(kind.newbyteorder("="))


def _transform(value: object) -> Array:
    return np.vstack([_array(value, "<f8", (3, 4)), [0.0, 0.0, 0.0, 1.0]])


def _integer(value: object, low: int = 0, high: int = MAX_INTEGER) -> int:
    if not isinstance(value, int) or not low <= value <= high:
        raise BadRowError("a number is missing or outside its range")
    return value


def _number(value: object, low: float, high: float) -> float:
    if not isinstance(value, float) or not low <= value <= high:
        raise BadRowError("a number is missing or outside its range")
    return value
