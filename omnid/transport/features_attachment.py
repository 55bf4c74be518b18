"""What goes along with a panorama on the bus: where its features are, as JSON beside the image."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from omnid.errors import OmnidError

Array = NDArray[np.float64]
KINDS: Final = ("agreeing", "rejected", "new")
MOST: Final = 2000  # of a kind
_LONGEST: Final = 1 << 17  # bytes
_FARTHEST_PX: Final = 1e5


def features_bytes(pixels: Mapping[str, Array]) -> bytes:
    """Pixels (N, 2), column and row, by kind, to whole pixels; at most MOST of each."""
    said = {kind: np.rint(pixels[kind][:MOST]).astype(int).tolist() for kind in KINDS}
    return json.dumps(said, separators=(",", ":")).encode()


def features_from_bytes(data: bytes) -> dict[str, Array]:
    """The same; OmnidError unless it is such; any bytes may come."""
    try:
        found = json.loads(data) if len(data) <= _LONGEST else {}
        pixels = {kind: np.asarray(found[kind], np.float64).reshape(-1, 2)[:MOST] for kind in KINDS}
    except (ValueError, TypeError, KeyError, RecursionError, OverflowError):
        reason = f"{len(data)} bytes beside a panorama are no features; is it omnid that sends there?"
        raise OmnidError(reason) from None
    return {kind: places[(np.abs(places) < _FARTHEST_PX).all(axis=1)] for kind, places in pixels.items()}
