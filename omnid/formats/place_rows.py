"""Rows of a map file as tuples of values: written from keyframes, links, tags and the head, and read with checks."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from calib.panorama import Cylinder
from omnid.core.mapping.range_scan import MAX_RANGE_M, SECTORS
from omnid.core.places.code_index import INDEXED, azimuths_of, codes_of
from omnid.core.places.map_tags import MapTag, TagView
from omnid.core.places.place_features import DESCRIPTOR, PlaceFeatures, StoredFeatures
from omnid.core.places.place_map import KeyframeUse, Link, PlaceKeyframe, PlaceMap
from omnid.core.places.place_rig import PlaceRig
from omnid.core.places.tags import MAX_NAME, MAX_TAG, SIZES_M
from omnid.formats.place_values import (
    MAX_INTEGER,
    BadRowError,
    arrays_of,
    as_bytes,
    integer,
    number,
    require_rigid,
    rows_of,
    transform_of,
    transforms_of,
)

Array = NDArray[np.float64]
Row: TypeAlias = tuple[Any, ...]

MAX_FEATURES: Final = 4096  # Most features of a keyframe.
FEATURE_BYTES: Final = DESCRIPTOR + 3 * 4  # Size of a descriptor with its view.
MAX_PIXELS: Final = 1 << 15  # Largest width and height of a panorama.
THUMBNAIL: Final = (16, 128)  # rows and columns
INDEX_COLUMNS: Final = 11  # Columns of a keyframe up to its free ranges.
MAX_HASH: Final = 128  # characters
BASELINES_M: Final = (1e-3, 1e2)  # least and largest


class KeyframeRow(NamedTuple):
    """A keyframe without its features, and its pose in the map; see PlaceKeyframe."""

    id: int
    session: int
    stamp_ns: int
    use: KeyframeUse
    T_map_rect: Array  # (4, 4)
    T_odom_rect: Array  # (4, 4)
    covariance: Array  # (6, 6)
    thumbnail: NDArray[np.int8]  # (16, 128)
    scan: NDArray[np.float16]  # (SECTORS,) m
    free_m: NDArray[np.float16]  # (SECTORS,) m

    def keyframe(self, features: PlaceFeatures | StoredFeatures) -> PlaceKeyframe:
        """Return the keyframe with its features."""
        return PlaceKeyframe(
            self.id,
            self.session,
            self.stamp_ns,
            self.T_odom_rect,
            self.covariance,
            self.thumbnail,
            self.scan,
            self.free_m,
            features,
        )


class KeyframeCodes(NamedTuple):
    """Numbers of features of K keyframes, and the codes of the strongest ones, one keyframe's after the other's."""

    counts: list[int]  # K
    codes: NDArray[np.uint64]  # (N,) min(count, INDEXED) of each keyframe
    azimuths: NDArray[np.uint8]  # (N,) see azimuths_of


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


def keyframe_row(keyframe: PlaceKeyframe, T_map_rect: Array, use: KeyframeUse, width: int) -> Row:
    """Return the row of a keyframe with its pose (4, 4) in the map; width: columns of the panorama."""
    features = keyframe.features.copied()
    return (
        keyframe.id,
        keyframe.session,
        keyframe.stamp_ns,
        use.found,
        use.missed,
        as_bytes(T_map_rect[:3], "<f8"),
        as_bytes(keyframe.T_odom_rect[:3], "<f8"),
        as_bytes(keyframe.covariance, "<f8"),
        as_bytes(keyframe.thumbnail, "i1"),
        as_bytes(keyframe.scan, "<f2"),
        as_bytes(keyframe.free_m, "<f2"),
        keyframe.features.count,
        as_bytes(codes_of(features), "<u8"),
        as_bytes(azimuths_of(features, width), "u1"),
    )


def features_row(keyframe: PlaceKeyframe) -> Row:
    """Return the row of the features of a keyframe. Raises BadRowError where they cannot be read any more."""
    features = keyframe.features.copied()
    if features.count != keyframe.features.count:
        raise BadRowError(f"the features of keyframe {keyframe.id} in the map that was read are damaged")
    return keyframe.id, as_bytes(features.descriptors, "u1"), as_bytes(features.views, "<f4")


def link_row(link: Link) -> Row:
    """Return the row of a link."""
    return link.a, link.b, link.inliers, as_bytes(link.T_a_b[:3], "<f8"), as_bytes(link.covariance, "<f8")


def tag_row(tag: MapTag) -> Row:
    """Return the row of a tag."""
    return tag.id, tag.name, float(tag.size_m)


def tag_view_row(view: TagView) -> Row:
    """Return the row of a view of a tag."""
    return view.keyframe, view.tag, as_bytes(view.T_rect_tag[:3], "<f8"), as_bytes(view.covariance, "<f8")


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
        as_bytes(rig.T_rig_rect[:3], "<f8"),
        as_bytes(rig.T_base_rig[:3], "<f8"),
        rig.rig_hash,
    )


def read_map_row(row: Row) -> Head:
    """Return the head of a map. Raises BadRowError."""
    keyframes, links, dropped, tags, tag_views, width, height, row0, baseline_m, T_rig_rect, T_base_rig, rig_hash = row
    if not isinstance(rig_hash, str) or len(rig_hash) > MAX_HASH or not rig_hash.isalnum():
        raise BadRowError("the hash of the rig is none")
    cylinder = Cylinder(integer(width, 1, MAX_PIXELS), integer(height, 1, MAX_PIXELS), number(row0, -1e6, 1e6))
    rig = PlaceRig(
        cylinder, number(baseline_m, *BASELINES_M), transform_of(T_rig_rect), transform_of(T_base_rig), rig_hash
    )
    require_rigid([rig.T_rig_rect, rig.T_base_rig])
    return Head(rig, integer(keyframes), integer(links), integer(dropped), integer(tags), integer(tag_views))


def head_of_version_2(row: Row) -> Row:
    """Return the row `map` of version 2, which had no tags, as one of today."""
    return (*row[:3], 0, 0, *row[3:])


def keyframe_without_free(row: Row) -> Row:
    """Return the row of a keyframe of versions up to 5, which knew no floor, as one of today: it is free nowhere."""
    return (*row[: INDEX_COLUMNS - 1], bytes(2 * SECTORS), *row[INDEX_COLUMNS - 1 :])


def read_keyframes(rows: Sequence[Row]) -> list[KeyframeRow]:
    """Return keyframes without their features. Raises BadRowError. Poses and covariances are not checked.

    The arrays of all of them are made at once: one by one takes most of the time in which a large map opens.
    """
    ids, sessions, stamps, found, missed, T_map_rect, T_odom_rect, covariance, thumbnail, scan, free = (
        [row[column] for row in rows] for column in range(INDEX_COLUMNS)
    )
    ranges, free_m = (arrays_of(of, "<f2", (SECTORS,)) for of in (scan, free))
    for known, may_be in ((ranges, np.isnan(ranges)), (np.abs(free_m), False)):
        if not (may_be | ((known >= 0) & (known <= MAX_RANGE_M))).all():
            raise BadRowError(f"a range of a keyframe is outside 0 to {MAX_RANGE_M:g} m")
    return [
        KeyframeRow(integer(id), integer(session), integer(stamp_ns, -MAX_INTEGER), use, *arrays)
        for id, session, stamp_ns, use, *arrays in zip(
            ids,
            sessions,
            stamps,
            (KeyframeUse(integer(a), integer(b)) for a, b in zip(found, missed, strict=True)),
            transforms_of(T_map_rect),
            transforms_of(T_odom_rect),
            arrays_of(covariance, "<f8", (6, 6)),
            arrays_of(thumbnail, "i1", THUMBNAIL),
            ranges,
            free_m,
            strict=True,
        )
    ]


def read_codes(rows: Sequence[Row]) -> KeyframeCodes:
    """Return the numbers of features and their codes. Raises BadRowError."""
    counts = [integer(row[INDEX_COLUMNS], 0, MAX_FEATURES) for row in rows]
    for count, row in zip(counts, rows, strict=True):
        codes, azimuths = row[INDEX_COLUMNS + 1 :]
        if not isinstance(codes, bytes) or not isinstance(azimuths, bytes):
            raise BadRowError("the codes of a keyframe are none")
        if (len(codes), len(azimuths)) != (8 * min(count, INDEXED), min(count, INDEXED)):
            raise BadRowError(f"the codes of keyframe {row[0]!r} are not those of {count} features")
    return KeyframeCodes(
        counts,
        np.frombuffer(b"".join(row[INDEX_COLUMNS + 1] for row in rows), "<u8").astype(np.uint64),
        np.frombuffer(b"".join(row[INDEX_COLUMNS + 2] for row in rows), np.uint8),
    )


def read_features(descriptors: object, views: object, rig: PlaceRig) -> PlaceFeatures:
    """Return the features of a keyframe. Raises BadRowError."""
    features = PlaceFeatures(rows_of(descriptors, "u1", DESCRIPTOR), rows_of(views, "<f4", 3))
    if len(features.descriptors) != len(features.views) or len(features.views) > MAX_FEATURES:
        raise BadRowError(f"{len(features.descriptors)} descriptors and {len(features.views)} views in a keyframe")
    column, lower, upper = features.views.T
    width, height = rig.cylinder.width, rig.cylinder.height
    # NaN fails too. The upper camera may show a point at a row below the end of the lower one's panorama.
    if not (
        (np.abs(column) <= 2 * width) & (np.abs(lower) <= 2 * height) & (upper > lower) & (upper <= 3 * height)
    ).all():
        raise BadRowError("a view of a keyframe is outside the panorama")
    return features


def read_links(rows: Sequence[Row]) -> list[Link]:
    """Return links. Raises BadRowError. Their poses and covariances are not checked."""
    T_a_b = transforms_of([row[3] for row in rows])
    covariance = arrays_of([row[4] for row in rows], "<f8", (6, 6))
    return [
        Link(integer(a), integer(b), T, P, integer(inliers))
        for (a, b, inliers, *_), T, P in zip(rows, T_a_b, covariance, strict=True)
    ]


def read_tag_row(row: Row) -> MapTag:
    """Return a tag. Raises BadRowError."""
    id, name, size_m = row
    if not isinstance(name, str) or not 0 < len(name) <= MAX_NAME or not name.isprintable():
        raise BadRowError("the name of a tag is none")
    return MapTag(integer(id, 0, MAX_TAG), name, number(size_m, *SIZES_M))


def read_tag_view_row(row: Row) -> TagView:
    """Return a view of a tag. Raises BadRowError. Its pose and covariance are not checked."""
    keyframe, tag, T_rect_tag, covariance = row
    P = arrays_of([covariance], "<f8", (6, 6))[0]
    return TagView(integer(keyframe), integer(tag), transform_of(T_rect_tag), P)
