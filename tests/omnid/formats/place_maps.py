"""Maps of places with random evidence."""

from __future__ import annotations

import numpy as np

from calib import se3
from calib.panorama import Cylinder
from omnid.core.places.place_map import Link, PlaceFeatures, PlaceKeyframe, PlaceMap, PlaceRig

RIG = PlaceRig(
    Cylinder(1304, 378, 128.75),
    0.24,
    se3.exp([0.01, 0.02, 0.03, 0.01, 0.02, 0.3]),
    se3.exp([0.1, 0, 0.5, 0, 0, 1.0]),
    "0123abcd" * 8,
)


def some_places(count: int, features: int = 256, seed: int = 1) -> PlaceMap:
    """Return a map of keyframes in a row, each linked to the next, with one loop."""
    rng, places = np.random.default_rng(seed), PlaceMap()
    for id in range(count):
        T = se3.exp([0.3 * id, 0, 0, 0, 0, 0.01 * id])
        scan = rng.uniform(0, 12, 360).astype(np.float16)
        scan[::7] = np.nan
        free_m = rng.uniform(-4, 4, 360).astype(np.float16)
        views = rng.uniform([0, 0, 0], [1304, 300, 0], (features, 3)).astype(np.float32)
        views[:, 2] = views[:, 1] + rng.uniform(1, 50, features)
        seen = PlaceFeatures(rng.integers(0, 256, (features, 128), dtype=np.uint8), views)
        keyframe = PlaceKeyframe(
            id,
            id // 10,
            10**18 + id,
            se3.inverse(T),
            covariance(rng),
            rng.integers(-127, 128, (16, 128)).astype(np.int8),
            scan,
            free_m,
            seen,
        )
        link = Link(id - 1, id, se3.exp([0.3, 0, 0, 0, 0, 0.01]), covariance(rng)) if id else None
        places.add(keyframe, T, link)
    if count > 2:
        places.links.append(Link(0, count - 1, se3.exp(rng.normal(size=6)), covariance(rng), 77))
    places.dropped = 3
    return places


def covariance(rng: np.random.Generator) -> np.ndarray:
    """Return a covariance (6, 6) of millimetres and milliradians."""
    root = rng.normal(scale=1e-3, size=(6, 6))
    return root @ root.T + 1e-8 * np.eye(6)
