"""Alignment of a map of places with a plan, by landmarks whose places on the plan are known."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.places.place_map import PlaceMap
from omnid.core.places.place_rig import PlaceRig

Array = NDArray[np.float64]

# At which an error of 1 degree of a facing weighs as much as one of 1 cm of a position; by trial on development seeds.
AHEAD_M: Final = 0.5
FACING: Final = 0.7  # least horizontal part of a normal: that of a tag on the floor says nothing of the heading
# Least horizontal spread of the points of a fit: root of the sum of their squared distances from their middle. Less is
# refused, because there errors of 1 cm at each landmark, in map and plan, turn the map by 4 degrees; two landmarks are
# then 0.28 m apart.
MIN_SPREAD_M: Final = 0.2


@dataclass(frozen=True, slots=True)
class Landmark:
    """An AprilTag and its place, in the axes of the map or of the plan."""

    name: str
    id: int
    size_m: float  # edge of its black square
    xyz_m: tuple[float, float, float]  # position of its middle
    facing_rad: float | None  # azimuth of the direction that it faces; None: on the floor or the ceiling, or unknown


def landmark(id: int, size_m: float, T: Array) -> Landmark:
    """Return the landmark of a tag whose pose (4, 4) has z out of its face."""
    normal = T[:3, 2]
    facing = math.atan2(normal[1], normal[0]) if math.hypot(normal[0], normal[1]) >= FACING else None
    x, y, z = T[:3, 3].tolist()
    return Landmark(str(id), id, size_m, (x, y, z), facing)


def fit(seen: Mapping[int, Landmark], known: Mapping[int, Landmark]) -> tuple[Array, dict[int, float]]:
    """Return the transform T_plan_map (4, 4), level, and the distance [m] that is left at each common landmark.

    Least squares (Kabsch) over the landmarks, and where both facings are known over the points AHEAD_M before them.
    Raises ValueError where they do not determine the heading: one landmark without facing, none, or several that hang
    one above the other (MIN_SPREAD_M).
    """
    common = sorted(seen.keys() & known.keys())
    here, there = (np.array([marks[id].xyz_m for id in common]).reshape(-1, 3) for marks in (seen, known))
    facing = [
        (seen[id], known[id]) for id in common if seen[id].facing_rad is not None and known[id].facing_rad is not None
    ]
    a = np.concatenate([here[:, :2], np.array([_ahead(one) for one, _ in facing]).reshape(-1, 2)])
    b = np.concatenate([there[:, :2], np.array([_ahead(one) for _, one in facing]).reshape(-1, 2)])
    if len(a) < 2:
        raise ValueError("two landmarks, or one whose facing_deg is known, tell how the map lies")
    p, q = a - a.mean(axis=0), b - b.mean(axis=0)
    spread_m = min(float(np.linalg.norm(p)), float(np.linalg.norm(q)))
    if spread_m < MIN_SPREAD_M:
        raise ValueError(
            f"across the floor they spread by {spread_m:.2f} m, expected {MIN_SPREAD_M} m or more: "
            "add one that hangs elsewhere, or facing_deg of one, which tells how the map lies"
        )
    yaw = math.atan2(float((p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum()), float((p * q).sum()))
    R = se3.rotation_exp([0.0, 0.0, yaw])
    xy = b.mean(axis=0) - R[:2, :2] @ a.mean(axis=0)
    T_plan_map = se3.transform(R, [xy[0], xy[1], (there - here)[:, 2].mean()])
    left = np.linalg.norm(se3.apply(T_plan_map, here) - there, axis=1)
    return T_plan_map, dict(zip(common, left.tolist(), strict=True))


def align(places: PlaceMap, rig: PlaceRig, T_plan_map: Array) -> None:
    """Move a map, in place: its keyframes and what is published and exported are then in the axes of the plan."""
    T = se3.inverse(rig.T_base_rect) @ T_plan_map @ rig.T_base_rect
    places.move({id: T @ pose for id, pose in places.poses.items()})


def _ahead(mark: Landmark) -> tuple[float, float]:
    """Return the point (x, y) [m] before a landmark whose facing is known."""
    facing = mark.facing_rad or 0.0
    return mark.xyz_m[0] + AHEAD_M * math.cos(facing), mark.xyz_m[1] + AHEAD_M * math.sin(facing)
