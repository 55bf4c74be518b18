"""Map files (.omap): a map of places as an uncompressed .npz file of numpy; see docs/formats.md.

A map is written to a temporary file in the same folder, synced and renamed, so that a program that is killed leaves the
old map whole. What is read is checked: each array by its type, its size and the CRC-32 of the archive, and references
between them. The same checks come before a map is written, so that none is replaced by one that would be refused.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calib.panorama import Cylinder
from drivers.errors import one_line
from omnid.core.mapping.range_scan import SECTORS
from omnid.core.places.features import COLUMNS, DESCRIPTOR, ROWS
from omnid.core.places.place_map import Link, PlaceFeatures, PlaceKeyframe, PlaceMap, PlaceRig
from omnid.errors import OmnidError
from omnid.formats.exports import replaced

FORMAT: Final = 8  # To be raised when the arrays change; maps of other versions are refused.
_POSE: Final = ("<f8", (3, 4))  # the upper rows of a transform
_COVARIANCE: Final = ("<f8", (6, 6))
_RANGE: Final = ("<f2", (SECTORS,))
# Type and shape of each field; names are those of the attributes.
_FIELDS: Final[dict[str, dict[str, Any]]] = {
    "map": {
        **dict.fromkeys(("format", "dropped", "width", "height"), "<i8"),
        **dict.fromkeys(("row0", "baseline_m"), "<f8"),
        **dict.fromkeys(("T_rig_rect", "T_base_rig"), _POSE),
        "rig_hash": "S64",
    },
    "keyframes": {
        **dict.fromkeys(("id", "session", "stamp_ns", "features"), "<i8"),
        **dict.fromkeys(("T_map_rect", "T_odom_rect"), _POSE),
        "covariance": _COVARIANCE,
        "thumbnail": ("i1", (ROWS, COLUMNS)),
        **dict.fromkeys(("scan", "free_m"), _RANGE),
    },
    "links": {**dict.fromkeys(("a", "b", "inliers"), "<i8"), "T_a_b": _POSE, "covariance": _COVARIANCE},
}
_ARRAYS: Final[dict[str, np.dtype[Any]]] = {
    **{name: np.dtype({"names": [*fields], "formats": [*fields.values()]}) for name, fields in _FIELDS.items()},
    # Features of one keyframe after the other.
    "views": np.dtype(("<f4", (3,))),
    "descriptors": np.dtype(("u1", (DESCRIPTOR,))),
}
_Arrays = dict[str, NDArray[Any]]


def write_places(path: str | Path, places: PlaceMap, rig: PlaceRig) -> None:
    """Write a map; the same map gives the same bytes. Raises OmnidError if that is impossible."""
    arrays = _to_arrays(places, rig)
    with replaced(Path(path), "map") as partial, partial.open("wb") as file:
        _check(arrays)
        np.savez(file, **dict[str, Any](arrays))


def read_places(path: str | Path) -> tuple[PlaceMap, PlaceRig]:
    """Return the map of a file and the rig by which it was made; OmnidError for any file that is no whole map."""
    path = Path(path)
    try:
        if path.exists() and not path.is_file():
            raise ValueError("it is no regular file")
        with zipfile.ZipFile(path) as members:  # What numpy raises for another file advises to unpickle it.
            if any(one.compress_type != zipfile.ZIP_STORED for one in members.infolist()):
                raise ValueError("it is compressed, and could unpack to any size")
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in _ARRAYS}
        _check(arrays)
        return _from_arrays(arrays)
    except OSError as error:
        raise OmnidError(f"{path}: cannot read the map: {error.strerror or error}") from error
    except Exception as error:  # whatever zipfile and numpy raise for bytes that no omnid has written
        raise OmnidError(
            f"{path}: expected a map of places of version {FORMAT}, found another file or a damaged one: "
            f"{one_line(error)}; `omnid map build` makes one"
        ) from error


def _to_arrays(places: PlaceMap, rig: PlaceRig) -> _Arrays:
    """Return the arrays of a map; of transforms (4, 4) the upper rows."""
    ids, upper = sorted(places.keyframes), _POSE[1][0]
    cylinder, poses = rig.cylinder, (rig.T_rig_rect[:upper], rig.T_base_rig[:upper])
    head = FORMAT, places.dropped, cylinder.width, cylinder.height, cylinder.row0, rig.baseline_m, *poses
    keyframes = []
    for id in ids:
        keyframe = places.keyframes[id]
        numbers = id, keyframe.session, keyframe.stamp_ns, len(keyframe.features.views)
        poses = places.poses[id][:upper], keyframe.T_odom_rect[:upper]
        images = keyframe.thumbnail, keyframe.scan, keyframe.free_m
        keyframes.append((*numbers, *poses, keyframe.covariance, *images))
    links = [(link.a, link.b, link.inliers, link.T_a_b[:upper], link.covariance) for link in places.links]
    rows = {"map": [(*head, rig.rig_hash.encode())], "keyframes": keyframes, "links": links}
    arrays = {name: np.array(found, _ARRAYS[name]) for name, found in rows.items()}
    for name in ("views", "descriptors"):
        features = [getattr(places.keyframes[id].features, name) for id in ids]
        arrays[name] = np.concatenate([np.zeros(0, _ARRAYS[name]), *features])
    return arrays


def _from_arrays(arrays: _Arrays) -> tuple[PlaceMap, PlaceRig]:
    """Return the map and the rig of arrays."""
    places = PlaceMap()
    head, keyframes, links = arrays["map"][0], arrays["keyframes"], arrays["links"]
    T_map_rect, T_odom_rect = _transforms(keyframes["T_map_rect"]), _transforms(keyframes["T_odom_rect"])
    ends = np.cumsum(keyframes["features"]).tolist()
    for row, T, T_odom, end in zip(keyframes, T_map_rect, T_odom_rect, ends, strict=True):
        id, own = int(row["id"]), slice(end - int(row["features"]), end)
        features = PlaceFeatures(arrays["descriptors"][own].copy(), arrays["views"][own].copy())
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
    return places, PlaceRig(cylinder, float(head["baseline_m"]), T_rig_rect, T_base_rig, head["rig_hash"].decode())


def _transforms(upper: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return transforms (N, 4, 4) of their upper rows (N, 3, 4)."""
    return np.concatenate([upper, np.broadcast_to([0.0, 0.0, 0.0, 1.0], (len(upper), 1, 4))], axis=1)


def _check(arrays: _Arrays) -> None:
    """Raise ValueError for arrays that no omnid of this version has written."""
    head, keyframes, links, views = (arrays[name] for name in ("map", "keyframes", "links", "views"))
    # 1. Types and sizes.
    for name, dtype in _ARRAYS.items():
        count = len(views if name == "descriptors" else arrays[name])
        if arrays[name].dtype != dtype.base or arrays[name].shape != (count, *dtype.shape):
            raise ValueError(f"the array {name} has another type or size")
    if len(head) != 1 or head["format"][0] != FORMAT:
        raise ValueError(f"expected version {FORMAT} of the format")
    # 2. Numbers, and references between arrays. The range of a scan is NaN where it is unknown.
    fields = [arrays[name][field] for name in _FIELDS for field in _FIELDS[name].keys() - {"scan", "rig_hash"}]
    ids, sizes = keyframes["id"], [head["width"], head["height"], head["baseline_m"]]
    joins = np.isin(links["a"], ids) & np.isin(links["b"], ids) & (links["a"] != links["b"])
    checks = {
        "a number is not finite": all(np.isfinite(field).all() for field in fields),
        "the panorama or the baseline has no size": all((size > 0).all() for size in sizes),
        "the keyframes are not in the order of their ids": (np.diff(ids) > 0).all(),
        "the features are not those of the keyframes": (keyframes["features"] >= 0).all()
        and len(views) == keyframes["features"].sum(),
        "a link joins no two keyframes": joins.all(),
    }
    if wrong := [text for text, holds in checks.items() if not holds]:
        raise ValueError(wrong[0])
