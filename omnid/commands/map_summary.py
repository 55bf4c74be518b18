"""The lines that describe a map of places."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from omnid.utc import utc

if TYPE_CHECKING:
    from omnid.core.places.place_rig import PlaceRig
    from omnid.core.places.place_views import PlaceSummary


def described(path: Path, sizes: PlaceSummary, rig: PlaceRig) -> Iterator[str]:
    """Yield a line for each property: its name, padded to 12 characters, and its value."""
    per_keyframe = path.stat().st_size / max(1, sizes.keyframes)
    yield f"map          {path}"
    yield f"size         {path.stat().st_size / 1e6:.1f} MB, {per_keyframe / 1e3:.0f} kB a keyframe"
    yield f"time         {utc(sizes.first_stamp_ns)} to {utc(sizes.last_stamp_ns)}"
    yield f"sessions     {sizes.sessions}"
    yield f"keyframes    {sizes.keyframes}, with {sizes.features} features; {sizes.dropped} were dropped"
    yield f"loops        {sizes.loops}"
    if sizes.tags:
        yield f"tags         {sizes.tags}, of which {sizes.tags_seen} were seen; `omnid map tags` lists them"
    yield f"path         {sizes.path_m:.1f} m, within {sizes.extent_m[0]:.1f} x {sizes.extent_m[1]:.1f} m"
    if sizes.parts > 1:
        yield f"parts        {sizes.parts}, between which no pose is known"
    yield (
        f"rig          {rig.rig_hash[:12]}, baseline {rig.baseline_m:.4f} m, panoramas of "
        f"{rig.cylinder.width} x {rig.cylinder.height} px"
    )
