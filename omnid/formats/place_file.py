"""Map files (.omap): a map of places as an uncompressed .npz file, which `numpy.load` opens; see docs/formats.md.

A map is written to a temporary file in the same folder, synced and renamed, so that a program that is killed leaves the
old map whole. What is read is checked: each array by its type, its size and the CRC-32 of the archive, each value by
its range. The same checks come before a map is written, so that none is replaced by one that would be refused.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from stat import S_ISFIFO
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from calib.atomic_file import replacement
from calib.panorama import Cylinder
from omnid.core.mapping.range_scan import MAX_RANGE_M, SECTORS
from omnid.core.places.features import COLUMNS, ROWS
from omnid.core.places.place_map import (
    DESCRIPTOR,
    UNUSED,
    KeyframeUse,
    Link,
    PlaceFeatures,
    PlaceKeyframe,
    PlaceMap,
    PlaceRig,
)
from omnid.errors import OmnidError

FORMAT: Final = 7  # to be raised where thumbnails or features of a place are computed otherwise: old maps fit no more
# Maps up to version 6 were SQLite databases.
EARLIER: Final = b"SQLite format 3\0"
MAX_FILE_BYTES: Final = 1 << 30
MAX_FEATURES: Final = 4096  # of a keyframe
MAX_PIXELS: Final = 1 << 15  # width and height of a panorama
MAX_INTEGER: Final = 1 << 62
MAX_POSITION_M: Final = 1e5
MAX_VARIANCE: Final = 1e8  # m^2 and rad^2
LEAST_VARIANCE: Final = 1e-16  # of a loop in any direction, so that its covariance can be inverted
RIGID: Final = 1e-6  # largest difference of an element of R R^T from the identity

# Transforms are the upper rows of the 4x4 matrix.
HEAD: Final = np.dtype(
    [
        ("format", "<i8"),
        ("dropped", "<i8"),
        ("width", "<i8"),
        ("height", "<i8"),
        ("row0", "<f8"),
        ("baseline_m", "<f8"),
        ("T_rig_rect", "<f8", (3, 4)),
        ("T_base_rig", "<f8", (3, 4)),
        ("rig_hash", "S64"),
    ]
)
KEYFRAME: Final = np.dtype(
    [
        ("id", "<i8"),
        ("session", "<i8"),
        ("stamp_ns", "<i8"),
        ("found", "<i8"),
        ("missed", "<i8"),
        ("features", "<i8"),
        ("T_map_rect", "<f8", (3, 4)),
        ("T_odom_rect", "<f8", (3, 4)),
        ("covariance", "<f8", (6, 6)),
        ("thumbnail", "i1", (ROWS, COLUMNS)),
        ("scan", "<f2", (SECTORS,)),
        ("free_m", "<f2", (SECTORS,)),
    ]
)
LINK: Final = np.dtype(
    [("a", "<i8"), ("b", "<i8"), ("inliers", "<i8"), ("T_a_b", "<f8", (3, 4)), ("covariance", "<f8", (6, 6))]
)
# Features of one keyframe after the other.
DESCRIPTORS: Final = np.dtype(("u1", (DESCRIPTOR,)))
VIEWS: Final = np.dtype(("<f4", (3,)))


class _BadMapError(ValueError):
    """A map that no omnid has written."""


def write_places(path: str | Path, places: PlaceMap, rig: PlaceRig) -> None:
    """Write a map; the same map gives the same bytes. Raises OmnidError if that is impossible."""
    path, ids = Path(path), sorted(places.keyframes)
    features = [places.keyframes[id].features for id in ids]
    views = np.concatenate([np.zeros((0, 3), np.float32), *(of_one.views for of_one in features)])
    try:
        head, keyframes, links = _head(places, rig), _keyframes(places, ids), _links(places)
        _check(head, keyframes, links)
        _check_views(views, rig.cylinder)
        with replacement(path) as partial, zipfile.ZipFile(partial, "w") as archive:
            _write_array(archive, "map", head.dtype, 1, [head])
            _write_array(archive, "keyframes", KEYFRAME, len(keyframes), [keyframes])
            _write_array(archive, "links", LINK, len(links), [links])
            _write_array(archive, "views", VIEWS, len(views), [views])
            # Some 50 MB in a large map, which are not copied together in memory.
            _write_array(archive, "descriptors", DESCRIPTORS, len(views), (of_one.descriptors for of_one in features))
    except (OSError, ValueError) as error:
        raise OmnidError(f"{path}: cannot write the map: {error}: choose another file") from error


def read_places(path: str | Path, into: PlaceMap | None = None) -> tuple[PlaceMap, PlaceRig]:
    """Return the map of a file and the rig by which it was made.

    into: an empty map that is filled, whose bound holds as soon as a keyframe is added to it.
    Raises OmnidError, in one line, for any file that is no whole map.
    """
    path, places = Path(path), PlaceMap() if into is None else into
    _require_map(path)
    try:
        with zipfile.ZipFile(path) as archive:
            return places, _read(archive, places)
    except OSError as error:
        raise OmnidError(f"{path}: cannot read the map: {error.strerror or error}") from error
    except Exception as error:  # whatever zipfile and numpy raise for bytes that no omnid has written
        found = " ".join(str(error).split()) or type(error).__name__
        raise OmnidError(
            f"{path}: the map is damaged: {found}; take a copy, or build it again with `omnid map build`"
        ) from error


def _require_map(path: Path) -> None:
    """Raise OmnidError for a file that is none of numpy's archives, or too large."""
    try:
        status = path.stat()
        if S_ISFIFO(status.st_mode):
            raise OmnidError(f"{path}: expected a map of places (.omap), found a pipe: name a file")
        with path.open("rb") as file:
            beginning = file.read(len(EARLIER))
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise OmnidError(f"{path}: cannot read the map: {getattr(error, 'strerror', None) or error}") from error
    if beginning == EARLIER:
        raise OmnidError(f"{path}: this is a map of an earlier version of omnid: build it again with `omnid map build`")
    if not beginning.startswith(b"PK"):
        raise OmnidError(f"{path}: expected a map of places (.omap), found another file; `omnid map build` makes one")
    if status.st_size > MAX_FILE_BYTES:
        raise OmnidError(
            f"{path}: expected a map of at most {MAX_FILE_BYTES >> 20} MB, found {status.st_size >> 20} MB"
        )


def _head(places: PlaceMap, rig: PlaceRig) -> NDArray[Any]:
    head = np.zeros(1, HEAD)
    head[0] = (
        FORMAT,
        places.dropped,
        rig.cylinder.width,
        rig.cylinder.height,
        rig.cylinder.row0,
        rig.baseline_m,
        rig.T_rig_rect[:3],
        rig.T_base_rig[:3],
        rig.rig_hash.encode(),
    )
    return head


def _keyframes(places: PlaceMap, ids: list[int]) -> NDArray[Any]:
    rows = np.zeros(len(ids), KEYFRAME)
    for n, id in enumerate(ids):
        keyframe, use = places.keyframes[id], places.uses.get(id, UNUSED)
        rows[n] = (
            id,
            keyframe.session,
            keyframe.stamp_ns,
            use.found,
            use.missed,
            len(keyframe.features.views),
            places.poses[id][:3],
            keyframe.T_odom_rect[:3],
            keyframe.covariance,
            keyframe.thumbnail,
            keyframe.scan,
            keyframe.free_m,
        )
    return rows


def _links(places: PlaceMap) -> NDArray[Any]:
    rows = np.zeros(len(places.links), LINK)
    for n, link in enumerate(places.links):
        rows[n] = (link.a, link.b, link.inliers, link.T_a_b[:3], link.covariance)
    return rows


def _write_array(
    archive: zipfile.ZipFile, name: str, dtype: np.dtype[Any], count: int, parts: Iterable[NDArray[Any]]
) -> None:
    """Write an array of numpy (.npy, version 1.0) that consists of parts."""
    item, shape = dtype.base, (count, *dtype.shape)
    with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
        np.lib.format.write_array_header_1_0(
            file, {"descr": np.lib.format.dtype_to_descr(item), "fortran_order": False, "shape": shape}
        )
        for part in parts:
            file.write(np.ascontiguousarray(part, item).tobytes())


def _read(archive: zipfile.ZipFile, places: PlaceMap) -> PlaceRig:
    """Fill an empty map; return the rig."""
    # 1. The rig, keyframes and links, with all checks.
    head, keyframes, links = (
        _array(archive, *what) for what in (("map", HEAD), ("keyframes", KEYFRAME), ("links", LINK))
    )
    _check(head, keyframes, links)
    cylinder = Cylinder(int(head["width"][0]), int(head["height"][0]), float(head["row0"][0]))
    rig = PlaceRig(
        cylinder,
        float(head["baseline_m"][0]),
        _transforms(head["T_rig_rect"])[0],
        _transforms(head["T_base_rig"])[0],
        head["rig_hash"][0].decode(),
    )
    # 2. Features, keyframe by keyframe.
    views = _array(archive, "views", VIEWS)
    _check_views(views, cylinder)
    if len(views) != keyframes["features"].sum():
        raise _BadMapError("the features are not those of the keyframes")
    T_map_rect, T_odom_rect = _transforms(keyframes["T_map_rect"]), _transforms(keyframes["T_odom_rect"])
    with _opened(archive, "descriptors", DESCRIPTORS, len(views)) as file:
        ends = np.cumsum(keyframes["features"]).tolist()
        for n, (row, end) in enumerate(zip(keyframes, ends, strict=True)):
            count, id = int(row["features"]), int(row["id"])
            descriptors = np.frombuffer(bytearray(file.read(count * DESCRIPTOR)), np.uint8).reshape(count, DESCRIPTOR)
            places.keyframes[id] = PlaceKeyframe(
                id,
                int(row["session"]),
                int(row["stamp_ns"]),
                T_odom_rect[n],
                np.array(row["covariance"]),
                np.array(row["thumbnail"]),
                np.array(row["scan"]),
                np.array(row["free_m"]),
                PlaceFeatures(descriptors, views[end - count : end].copy()),
            )
            places.poses[id] = T_map_rect[n]
            if row["found"] or row["missed"]:
                places.uses[id] = KeyframeUse(int(row["found"]), int(row["missed"]))
    # 3. Links.
    places.links = [
        Link(int(row["a"]), int(row["b"]), T, np.array(row["covariance"]), int(row["inliers"]))
        for row, T in zip(links, _transforms(links["T_a_b"]), strict=True)
    ]
    places.dropped = int(head["dropped"][0])
    return rig


@contextmanager
def _opened(archive: zipfile.ZipFile, name: str, dtype: np.dtype[Any], count: int | None = None) -> Iterator[IO[bytes]]:
    """Open an array of `count` items, or of any number, behind its header."""
    info = archive.getinfo(f"{name}.npy")
    if info.compress_type != zipfile.ZIP_STORED or info.file_size > MAX_FILE_BYTES:
        raise _BadMapError(f"the array {name} is compressed, or too large")
    with archive.open(info) as file:
        if np.lib.format.read_magic(file) != (1, 0):
            raise _BadMapError(f"the array {name} is of another version of numpy's format")
        shape, is_fortran, item = np.lib.format.read_array_header_1_0(file)
        size = info.file_size - file.tell()
        expected = size // dtype.itemsize if count is None else count
        if is_fortran or item != dtype.base or shape != (expected, *dtype.shape) or size != expected * dtype.itemsize:
            raise _BadMapError(f"the array {name} has another type or size")
        yield file


def _array(archive: zipfile.ZipFile, name: str, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return an array of the archive."""
    with _opened(archive, name, dtype) as file:
        found = np.frombuffer(bytearray(file.read()), dtype.base)
    return found.reshape(-1, *dtype.shape).astype(dtype.base.newbyteorder("="), copy=False)


def _transforms(upper: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return transforms (N, 4, 4) of their upper rows (N, 3, 4)."""
    return np.concatenate([upper, np.broadcast_to([0.0, 0.0, 0.0, 1.0], (len(upper), 1, 4))], axis=1)


def _check(head: NDArray[Any], keyframes: NDArray[Any], links: NDArray[Any]) -> None:
    """Check all values but those of the features. Raises _BadMapError."""
    _require(len(head) == 1 and head["format"][0] == FORMAT, f"expected version {FORMAT} of the format")
    _require(head["dropped"] >= 0, "a count is negative")
    for name in ("width", "height"):
        _require((head[name] >= 1) & (head[name] <= MAX_PIXELS), "the panorama has another size")
    _require((np.abs(head["row0"]) <= 1e6) & (head["baseline_m"] >= 1e-3) & (head["baseline_m"] <= 1e2), "no such rig")
    _require(head["rig_hash"][0].isalnum(), "the hash of the rig is none")
    ids = keyframes["id"]
    _require(np.diff(ids) > 0, "the keyframes are not in the order of their ids")
    for name in ("id", "session", "found", "missed", "features"):
        _require((keyframes[name] >= 0) & (keyframes[name] < MAX_INTEGER), "a number is outside its range")
    _require(np.abs(keyframes["stamp_ns"]) < MAX_INTEGER, "a stamp is outside its range")
    _require(keyframes["features"] <= MAX_FEATURES, "a keyframe has too many features")
    for ranges, is_unknown in ((keyframes["scan"], np.isnan(keyframes["scan"])), (np.abs(keyframes["free_m"]), False)):
        _require(is_unknown | ((ranges >= 0) & (ranges <= MAX_RANGE_M)), f"a range is outside 0 to {MAX_RANGE_M:g} m")
    _require(
        np.isin(links["a"], ids) & np.isin(links["b"], ids) & (links["a"] != links["b"]),
        "a link joins no two keyframes",
    )
    _require((links["inliers"] >= 0) & (links["inliers"] < MAX_INTEGER), "a number is outside its range")
    for upper in (
        head["T_rig_rect"],
        head["T_base_rig"],
        keyframes["T_map_rect"],
        keyframes["T_odom_rect"],
        links["T_a_b"],
    ):
        _check_rigid(upper)
    is_loop = links["inliers"] > 0
    _check_covariances(keyframes["covariance"], 0.0)
    _check_covariances(links["covariance"][~is_loop], 0.0)
    _check_covariances(links["covariance"][is_loop], LEAST_VARIANCE)


def _check_views(views: NDArray[np.float32], cylinder: Cylinder) -> None:
    """Check views (N, 3) of features; NaN fails too.

    The upper camera may show a point at a row below the end of the lower one's panorama.
    """
    column, lower, upper = views.T
    width, height = cylinder.width, cylinder.height
    _require(
        (np.abs(column) <= 2 * width) & (np.abs(lower) <= 2 * height) & (upper > lower) & (upper <= 3 * height),
        "a view of a keyframe is outside the panorama",
    )


def _check_rigid(upper: NDArray[np.float64]) -> None:
    """Check that (N, 3, 4) are rotations with translations up to MAX_POSITION_M."""
    R = upper[:, :, :3]
    _require(np.isfinite(upper) & (np.abs(upper) <= MAX_POSITION_M), "a pose is not finite, or too far away")
    _require(np.abs(R) <= 2, "a pose is no rotation")
    _require(np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)) <= RIGID, "a pose is no rotation")
    _require(np.linalg.det(R) > 0, "a pose is no rotation")


def _check_covariances(P: NDArray[np.float64], least: float) -> None:
    """Check that (N, 6, 6) are symmetric, without an eigenvalue below `least` [m^2, rad^2]."""
    _require(np.isfinite(P) & (np.abs(P) <= MAX_VARIANCE), "a covariance is not finite, or too large")
    rounding = 1e-9 * np.abs(P).max(axis=(1, 2), initial=0.0)  # an eigenvalue that is 0 may be less by this
    asymmetry = np.abs(P - np.swapaxes(P, 1, 2)).max(axis=(1, 2), initial=0.0)
    _require(asymmetry <= rounding, "a covariance is not symmetric")
    _require(np.linalg.eigvalsh(P)[:, 0] >= (least or -rounding), "a covariance is not positive")


def _require(holds: bool | NDArray[np.bool_], text: str) -> None:
    """Raise _BadMapError where a condition does not hold for all values."""
    if not np.all(holds):
        raise _BadMapError(text)
