"""The zenoh attachment of a panorama: JSON with the pixels of its features."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from omnid.errors import OmnidError

Array = NDArray[np.float64]
KINDS: Final = ("inliers", "rejected", "new")
MOST: Final = 2000  # features of a kind
_MAX_BYTES: Final = 1 << 17
_MAX_PX: Final = 1e5


def features_to_bytes(pixels: Mapping[str, Array]) -> bytes:
    """Encode pixels (N, 2), column and row, by kind, rounded to whole pixels; at most MOST of each kind."""
    rounded = {kind: np.rint(pixels[kind][:MOST]).astype(int).tolist() for kind in KINDS}
    return json.dumps(rounded, separators=(",", ":")).encode()


def features_from_bytes(data: bytes) -> dict[str, Array]:
    """Decode pixels (N, 2) by kind. Raise OmnidError for any other bytes."""
    try:
        found = json.loads(data) if len(data) <= _MAX_BYTES else {}
        pixels = {kind: np.asarray(found[kind], np.float64).reshape(-1, 2)[:MOST] for kind in KINDS}
    except (ValueError, TypeError, KeyError, RecursionError, OverflowError):
        reason = f"the {len(data)} bytes attached to a panorama are not features; check that omnid sent them"
        raise OmnidError(reason) from None
    return {kind: points[(np.abs(points) < _MAX_PX).all(axis=1)] for kind, points in pixels.items()}
