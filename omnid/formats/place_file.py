"""Map files (.omap): a map of places as an uncompressed .npz file of numpy; see docs/formats.md.

A map is written to a temporary file in the same folder, synced and renamed, so that a program that is killed leaves the
old map whole. What is read is checked: each array by its type, its size and the CRC-32 of the archive, each value by
its range. The same checks come before a map is written, so that none is replaced by one that would be refused.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from stat import S_ISFIFO
from typing import Any, Final

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
MAX_PIXELS: Final = 1 << 15  # width and height of a panorama
MAX_INTEGER: Final = 1 << 62
MAX_POSITION_M: Final = 1e5
MAX_VARIANCE: Final = 1e8  # m^2 and rad^2
LEAST_VARIANCE: Final = 1e-16  # of a loop in any direction, so that its covariance can be inverted
RIGID: Final = 1e-6  # largest difference of an element of R R^T from the identity

# Names are those of the attributes; transforms are the upper rows of the 4x4 matrix.
_POSE: Final = ("<f8", (3, 4))
_HEAD_NUMBERS: Final = [(name, "<i8") for name in ("format", "dropped", "width", "height")]
_KEYFRAME_NUMBERS: Final = [(name, "<i8") for name in ("id", "session", "stamp_ns", "found", "missed", "features")]
_ARRAYS: Final[dict[str, np.dtype[Any]]] = {
    "map": np.dtype(
        [
            *_HEAD_NUMBERS,
            ("row0", "<f8"),
            ("baseline_m", "<f8"),
            ("T_rig_rect", *_POSE),
            ("T_base_rig", *_POSE),
            ("rig_hash", "S64"),
        ]
    ),
    "keyframes": np.dtype(
        [
            *_KEYFRAME_NUMBERS,
            ("T_map_rect", *_POSE),
            ("T_odom_rect", *_POSE),
            ("covariance", "<f8", (6, 6)),
            ("thumbnail", "i1", (ROWS, COLUMNS)),
            ("scan", "<f2", (SECTORS,)),
            ("free_m", "<f2", (SECTORS,)),
        ]
    ),
    "links": np.dtype(
        [("a", "<i8"), ("b", "<i8"), ("inliers", "<i8"), ("T_a_b", *_POSE), ("covariance", "<f8", (6, 6))]
    ),
    # Features of one keyframe after the other.
    "views": np.dtype(("<f4", (3,))),
    "descriptors": np.dtype(("u1", (DESCRIPTOR,))),
}
_Arrays = dict[str, NDArray[Any]]


class _BadMapError(ValueError):
    """A map that no omnid has written."""


def write_places(path: str | Path, places: PlaceMap, rig: PlaceRig) -> None:
    """Write a map; the same map gives the same bytes. Raises OmnidError if that is impossible."""
    path, arrays = Path(path), _to_arrays(places, rig)
    try:
        _check(arrays)
        with replacement(path) as partial, zipfile.ZipFile(partial, "w") as archive:
            for name, array in arrays.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                    np.lib.format.write_array(file, array, allow_pickle=False)
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
        with np.load(path, allow_pickle=False) as archive:
            files = archive.zip.infolist()
            if any(file.compress_type for file in files) or sum(file.file_size for file in files) > MAX_FILE_BYTES:
                raise _BadMapError("its arrays are compressed, or too large")
            arrays = {name: archive[name] for name in _ARRAYS}
        _check(arrays)
        return places, _from_arrays(arrays, places)
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


def _to_arrays(places: PlaceMap, rig: PlaceRig) -> _Arrays:
    """Return the arrays of a map."""
    ids = sorted(places.keyframes)
    found, uses = [places.keyframes[id] for id in ids], [places.uses.get(id, UNUSED) for id in ids]
    head, keyframes, links = (
        np.zeros(count, _ARRAYS[name])
        for name, count in (("map", 1), ("keyframes", len(ids)), ("links", len(places.links)))
    )
    head["format"], head["dropped"], head["rig_hash"] = FORMAT, places.dropped, rig.rig_hash.encode()
    head["width"], head["height"], head["row0"] = rig.cylinder.width, rig.cylinder.height, rig.cylinder.row0
    head["baseline_m"], head["T_rig_rect"], head["T_base_rig"] = rig.baseline_m, rig.T_rig_rect[:3], rig.T_base_rig[:3]
    for n, (id, keyframe, use) in enumerate(zip(ids, found, uses, strict=True)):
        row = keyframes[n]
        for name in ("id", "session", "stamp_ns", "covariance", "thumbnail", "scan", "free_m"):
            row[name] = getattr(keyframe, name)
        row["found"], row["missed"], row["features"] = use.found, use.missed, len(keyframe.features.views)
        row["T_map_rect"], row["T_odom_rect"] = places.poses[id][:3], keyframe.T_odom_rect[:3]
    for n, link in enumerate(places.links):
        links[n] = (link.a, link.b, link.inliers, link.T_a_b[:3], link.covariance)
    views, descriptors = (
        np.concatenate([np.zeros(0, _ARRAYS[name]), *(getattr(one.features, name) for one in found)])
        for name in ("views", "descriptors")
    )
    return {"map": head, "keyframes": keyframes, "links": links, "views": views, "descriptors": descriptors}


def _from_arrays(arrays: _Arrays, places: PlaceMap) -> PlaceRig:
    """Fill an empty map; return the rig."""
    head, keyframes, links = arrays["map"][0], arrays["keyframes"], arrays["links"]
    T_map_rect, T_odom_rect = _transforms(keyframes["T_map_rect"]), _transforms(keyframes["T_odom_rect"])
    ends = np.cumsum(keyframes["features"]).tolist()
    for n, (row, end) in enumerate(zip(keyframes, ends, strict=True)):
        id, its = int(row["id"]), slice(end - int(row["features"]), end)
        features = PlaceFeatures(arrays["descriptors"][its].copy(), arrays["views"][its].copy())
        covariance, thumbnail, scan, free_m = (
            np.array(row[name]) for name in ("covariance", "thumbnail", "scan", "free_m")
        )
        places.keyframes[id] = PlaceKeyframe(
            id, int(row["session"]), int(row["stamp_ns"]), T_odom_rect[n], covariance, thumbnail, scan, free_m, features
        )
        places.poses[id] = T_map_rect[n]
        if row["found"] or row["missed"]:
            places.uses[id] = KeyframeUse(int(row["found"]), int(row["missed"]))
    places.links = [
        Link(int(row["a"]), int(row["b"]), T, np.array(row["covariance"]), int(row["inliers"]))
        for row, T in zip(links, _transforms(links["T_a_b"]), strict=True)
    ]
    places.dropped = int(head["dropped"])
    T_rig_rect, T_base_rig = (_transforms(arrays["map"][name])[0] for name in ("T_rig_rect", "T_base_rig"))
    cylinder = Cylinder(int(head["width"]), int(head["height"]), float(head["row0"]))
    return PlaceRig(cylinder, float(head["baseline_m"]), T_rig_rect, T_base_rig, head["rig_hash"].decode())


def _transforms(upper: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return transforms (N, 4, 4) of their upper rows (N, 3, 4)."""
    return np.concatenate([upper, np.broadcast_to([0.0, 0.0, 0.0, 1.0], (len(upper), 1, 4))], axis=1)


def _check(arrays: _Arrays) -> None:
    """Raise _BadMapError for arrays that no omnid has written."""
    # 1. Types and sizes.
    head, keyframes, links, views = (arrays[name] for name in ("map", "keyframes", "links", "views"))
    for name, dtype in _ARRAYS.items():
        count = len(views if name == "descriptors" else arrays[name])
        has_type = arrays[name].dtype == dtype.base and arrays[name].shape == (count, *dtype.shape)
        _require(has_type, f"the array {name} has another type or size")
    _require(len(head) == 1 and head["format"][0] == FORMAT, f"expected version {FORMAT} of the format")
    # 2. The rig.
    for name in ("width", "height"):
        _require((head[name] >= 1) & (head[name] <= MAX_PIXELS), "the panorama has another size")
    _require((np.abs(head["row0"]) <= 1e6) & (head["baseline_m"] >= 1e-3) & (head["baseline_m"] <= 1e2), "no such rig")
    _require(head["rig_hash"][0].isalnum(), "the hash of the rig is none")
    # 3. Numbers.
    ids = keyframes["id"]
    _require(np.diff(ids) > 0, "the keyframes are not in the order of their ids")
    counts = [keyframes[name] for name in ("id", "session", "found", "missed", "features")]
    for numbers in (*counts, links["inliers"], head["dropped"]):
        _require((numbers >= 0) & (numbers < MAX_INTEGER), "a number is outside its range")
    _require(np.abs(keyframes["stamp_ns"]) < MAX_INTEGER, "a stamp is outside its range")
    _require(np.array(len(views) == keyframes["features"].sum()), "the features are not those of the keyframes")
    for ranges, is_unknown in ((keyframes["scan"], np.isnan(keyframes["scan"])), (np.abs(keyframes["free_m"]), False)):
        _require(is_unknown | ((ranges >= 0) & (ranges <= MAX_RANGE_M)), f"a range is outside 0 to {MAX_RANGE_M:g} m")
    joins = np.isin(links["a"], ids) & np.isin(links["b"], ids) & (links["a"] != links["b"])
    _require(joins, "a link joins no two keyframes")
    # The upper camera may show a point at a row below the end of the lower one's panorama.
    (column, lower, upper), width, height = views.T, head["width"][0], head["height"][0]
    is_inside = (np.abs(column) <= 2 * width) & (np.abs(lower) <= 2 * height) & (upper > lower) & (upper <= 3 * height)
    _require(is_inside, "a view of a keyframe is outside the panorama")
    # 4. Poses and covariances.
    for array, name in (
        (head, "T_rig_rect"),
        (head, "T_base_rig"),
        (keyframes, "T_map_rect"),
        (keyframes, "T_odom_rect"),
        (links, "T_a_b"),
    ):
        T = array[name]
        _require(np.isfinite(T) & (np.abs(T) <= MAX_POSITION_M), "a pose is not finite, or too far away")
        R = T[:, :, :3]
        is_rigid = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)) <= RIGID
        _require(np.all(is_rigid, axis=(1, 2)) & (np.linalg.det(R) > 0), "a pose is no rotation")
    is_loop = links["inliers"] > 0
    _check_covariances(keyframes["covariance"], 0.0)
    _check_covariances(links["covariance"][~is_loop], 0.0)
    _check_covariances(links["covariance"][is_loop], LEAST_VARIANCE)


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
