"""Map files (.omap): a map of places as an uncompressed .npz file of numpy; see docs/formats.md.

A map is written to a temporary file in the same folder, synced and renamed, so that a program that is killed leaves the
old map whole. What is read is checked: each array by its type, its size and the CRC-32 of the archive, each value by
its range. The same checks come before a map is written, so that none is replaced by one that would be refused.
"""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from stat import S_ISFIFO
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.panorama import Cylinder
from omnid.core.mapping.range_scan import MAX_RANGE_M, SECTORS
from omnid.core.places.features import COLUMNS, ROWS
from omnid.core.places.place_map import (
    DESCRIPTOR,
    Link,
    PlaceFeatures,
    PlaceKeyframe,
    PlaceMap,
    PlaceRig,
)
from omnid.errors import OmnidError
from omnid.formats.exports import replaced
from omnid.formats.tum import STAMP_LIMIT_NS

FORMAT: Final = 8  # to be raised where what is kept of a place changes: old maps fit no more
# Maps up to version 6 were SQLite databases.
EARLIER: Final = b"SQLite format 3\0"
MAX_FILE_BYTES: Final = 1 << 30
LEAST_VARIANCE: Final = 1e-16  # of a loop in any direction, so that its covariance can be inverted
ROUNDING: Final = 1e-6  # of the elements of a rotation times its transpose
_POSE: Final = (3, 4)  # the upper rows of a transform


class _Field(NamedTuple):
    """A field of an array: its type, and the bounds of each value."""

    kind: str
    low: float
    high: float
    shape: tuple[int, ...] = ()


_COUNT: Final = _Field("<i8", 0, STAMP_LIMIT_NS)
_TRANSFORM: Final = _Field("<f8", -1e5, 1e5, _POSE)  # metres
_COVARIANCE: Final = _Field("<f8", -1e8, 1e8, (6, 6))  # m^2 and rad^2
_SIZE: Final = _Field("<i8", 1, 1 << 15)  # of a panorama, px
_RANGE: Final = _Field("<f2", -MAX_RANGE_M, MAX_RANGE_M, (SECTORS,))
# Names are those of the attributes.
_FIELDS: Final[dict[str, dict[str, _Field]]] = {
    "map": {
        **dict.fromkeys(("format", "dropped"), _COUNT),
        **dict.fromkeys(("width", "height"), _SIZE),
        "row0": _Field("<f8", -1e6, 1e6),
        "baseline_m": _Field("<f8", 1e-3, 1e2),
        **dict.fromkeys(("T_rig_rect", "T_base_rig"), _TRANSFORM),
        "rig_hash": _Field("S64", 0, 0),
    },
    "keyframes": {
        **dict.fromkeys(("id", "session", "stamp_ns", "features"), _COUNT),
        **dict.fromkeys(("T_map_rect", "T_odom_rect"), _TRANSFORM),
        "covariance": _COVARIANCE,
        "thumbnail": _Field("i1", -math.inf, math.inf, (ROWS, COLUMNS)),
        "scan": _RANGE._replace(low=0.0),
        "free_m": _RANGE,
    },
    "links": {**dict.fromkeys(("a", "b", "inliers"), _COUNT), "T_a_b": _TRANSFORM, "covariance": _COVARIANCE},
}
_ARRAYS: Final[dict[str, np.dtype[Any]]] = {
    **{
        name: np.dtype([(field, kind, shape) for field, (kind, _, _, shape) in fields.items()])
        for name, fields in _FIELDS.items()
    },
    # Features of one keyframe after the other.
    "views": np.dtype(("<f4", (3,))),
    "descriptors": np.dtype(("u1", (DESCRIPTOR,))),
}
_Arrays = dict[str, NDArray[Any]]


class _BadMapError(ValueError):
    """A map that no omnid has written."""


def write_places(path: str | Path, places: PlaceMap, rig: PlaceRig) -> None:
    """Write a map; the same map gives the same bytes. Raises OmnidError if that is impossible."""
    arrays = _to_arrays(places, rig)
    with replaced(Path(path), "map") as partial:
        _check(arrays)
        with zipfile.ZipFile(partial, "w") as archive:
            for name, array in arrays.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                    np.lib.format.write_array(file, array, allow_pickle=False)


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
    """Return the arrays of a map; of transforms (4, 4) the upper rows."""
    ids, upper = sorted(places.keyframes), _POSE[0]
    cylinder, poses = rig.cylinder, (rig.T_rig_rect[:upper], rig.T_base_rig[:upper])
    head = FORMAT, places.dropped, cylinder.width, cylinder.height, cylinder.row0, rig.baseline_m, *poses
    keyframes = []
    for id in ids:
        its = places.keyframes[id]
        numbers = id, its.session, its.stamp_ns, len(its.features.views)
        poses = places.poses[id][:upper], its.T_odom_rect[:upper]
        keyframes.append((*numbers, *poses, its.covariance, its.thumbnail, its.scan, its.free_m))
    links = [(link.a, link.b, link.inliers, link.T_a_b[:upper], link.covariance) for link in places.links]
    rows = {"map": [(*head, rig.rig_hash.encode())], "keyframes": keyframes, "links": links}
    arrays = {name: np.array(found, _ARRAYS[name]) for name, found in rows.items()}
    for name in ("views", "descriptors"):
        features = [getattr(places.keyframes[id].features, name) for id in ids]
        arrays[name] = np.concatenate([np.zeros(0, _ARRAYS[name]), *features])
    return arrays


def _from_arrays(arrays: _Arrays, places: PlaceMap) -> PlaceRig:
    """Fill an empty map; return the rig."""
    head, keyframes, links = arrays["map"][0], arrays["keyframes"], arrays["links"]
    T_map_rect, T_odom_rect = _transforms(keyframes["T_map_rect"]), _transforms(keyframes["T_odom_rect"])
    ends = np.cumsum(keyframes["features"]).tolist()
    for row, T, T_odom, end in zip(keyframes, T_map_rect, T_odom_rect, ends, strict=True):
        id, its = int(row["id"]), slice(end - int(row["features"]), end)
        features = PlaceFeatures(arrays["descriptors"][its].copy(), arrays["views"][its].copy())
        covariance, thumbnail, scan, free_m = (
            np.array(row[name]) for name in ("covariance", "thumbnail", "scan", "free_m")
        )
        numbers = int(row["session"]), int(row["stamp_ns"])
        places.keyframes[id] = PlaceKeyframe(id, *numbers, T_odom, covariance, thumbnail, scan, free_m, features)
        places.poses[id] = T
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
    _require(head["rig_hash"][0].isalnum(), "the hash of the rig is none")
    # 2. Bounds. The range of a scan is NaN where it is unknown.
    for name, fields in _FIELDS.items():
        for field, (_, low, high, shape) in fields.items():
            values = arrays[name][field]
            if values.dtype.kind != "S":
                is_inside = ((values >= low) & (values <= high)) | (field == "scan" and np.isnan(values))
                _require(is_inside, f"{field} of {name} is outside {low:g} to {high:g}")
            if shape == _POSE:
                R, transposed = values[:, :, :-1], np.swapaxes(values[:, :, :-1], 1, 2)
                is_rotation = np.abs(R @ transposed - np.eye(_POSE[0])) <= ROUNDING
                _require(np.all(is_rotation) & (np.linalg.det(R) > 0), f"{field} of {name} is no rotation")
            elif field == "covariance":
                least = np.where(arrays[name]["inliers"] > 0, LEAST_VARIANCE, -np.inf) if name == "links" else -np.inf
                _check_covariances(values, least)
    # 3. References.
    ids = keyframes["id"]
    _require(np.diff(ids) > 0, "the keyframes are not in the order of their ids")
    _require(len(views) == keyframes["features"].sum(), "the features are not those of the keyframes")
    joins = np.isin(links["a"], ids) & np.isin(links["b"], ids) & (links["a"] != links["b"])
    _require(joins, "a link joins no two keyframes")
    # 4. Views. The upper camera may show a point at a row below the end of the lower one's panorama.
    (column, lower, upper), width, height = views.T, head["width"][0], head["height"][0]
    is_inside = (np.abs(column) <= 2 * width) & (np.abs(lower) <= 2 * height) & (upper > lower) & (upper <= 3 * height)
    _require(is_inside, "a view of a keyframe is outside the panorama")


def _check_covariances(P: NDArray[np.float64], least: NDArray[np.float64] | float) -> None:
    """Check that (N, 6, 6) are symmetric, without an eigenvalue below `least` [m^2, rad^2], nor below 0."""
    rounding = 1e-9 * np.abs(P).max(axis=(1, 2), initial=0.0)  # an eigenvalue that is 0 may be less by this
    asymmetry = np.abs(P - np.swapaxes(P, 1, 2)).max(axis=(1, 2), initial=0.0)
    _require(asymmetry <= rounding, "a covariance is not symmetric")
    _require(np.linalg.eigvalsh(P)[:, 0] >= np.maximum(least, -rounding), "a covariance is not positive")


def _require(holds: bool | NDArray[np.bool_] | np.bool_, text: str) -> None:
    """Raise _BadMapError where a condition does not hold for all values."""
    if not np.all(holds):
        raise _BadMapError(text)
