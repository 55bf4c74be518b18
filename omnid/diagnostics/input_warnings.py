"""Warnings about the input that a run makes apparent, each with what to do about it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from omnid.config import Config
from omnid.core.rig.rig_health import RigHealth
from omnid.diagnostics.run_summary import RunStatistics
from omnid.stages.synchronise import FROZEN_IMAGES, Synchronise
from omnid.tracking_state import TrackingState

DARK_SHARE: Final = 0.1  # Share of dark pairs from which there is a warning.
LOST_PARTS_SHARE: Final = 0.1  # Share of pairs with lost parts from which there is a warning.
# Share of pairs without a sure pose; a smaller one is a gap, whose first pose may imply any speed.
UNSURE_SHARE: Final = 0.1
REPEATED: Final = {
    "drop": "their pairs were left out; a simulator without noise needs pair.repeated_images = 'use'",
    "use": "they were used, as pair.repeated_images says",
}


def input_warnings(pairing: Synchronise, rig: RigHealth, statistics: RunStatistics, config: Config) -> Iterator[str]:
    """Yield one line for each problem of the input."""
    yield from _image_warnings(pairing, config)
    if rig.warning:
        yield rig.warning
    yield from _pose_warnings(statistics, config)


def _image_warnings(pairing: Synchronise, config: Config) -> Iterator[str]:
    """Yield the problems of the images and their stamps."""
    counts = pairing.counts
    if pairing.fault:
        yield f"{counts['broken']} images could not be decoded; the first: {pairing.fault}"
    if not counts["pairs"]:
        yield _no_pair(pairing.closest_miss_ms, pairing.tolerance_ms)
    elif min(counts["unpaired_lower"], counts["unpaired_upper"]) > counts["pairs"]:
        closest_ms = pairing.closest_miss_ms or 0.0
        yield (
            f"most images of both cameras found no partner: the closest ones are {closest_ms:.3f} ms apart, "
            f"pair.tolerance_ms is {pairing.tolerance_ms:g}; if no images are missing, synchronise the cameras"
        )
    for camera, images in pairing.repeated.items():
        if images.longest >= FROZEN_IMAGES:
            yield (
                f"the {camera} camera was frozen: {images.count} of its images had all pixels as before, "
                f"{images.longest} in a row; {REPEATED[config.pair.repeated_images]}"
            )


def _pose_warnings(statistics: RunStatistics, config: Config) -> Iterator[str]:
    """Yield the problems that the odometry has met: dark pairs, parts of images without use, lost poses."""
    if statistics.dark > statistics.poses * DARK_SHARE:
        yield (
            f"it was too dark in {statistics.dark} of {statistics.poses} pairs: the images have more noise than "
            "contrast; more light, a longer exposure (cameras.exposure_us) or less gain"
        )
    for camera, pairs in statistics.lost_parts.items():
        if pairs > statistics.poses * LOST_PARTS_SHARE:
            yield (
                f"a part of the {camera} camera's image was frozen, dark, saturated or blurred in {pairs} of "
                f"{statistics.poses} pairs: it was not used; clean the mirror, check the camera and its driver"
            )
    lost = statistics.states[TrackingState.LOST]
    unsure = lost + statistics.states[TrackingState.DEGRADED]
    if statistics.too_fast and unsure > statistics.poses * UNSURE_SHARE:
        yield (
            f"the pose was lost or degraded in {unsure} of {statistics.poses} pairs, and the images show up to "
            f"{statistics.fastest_mps:.1f} m/s: poses that imply more than odometry.limits.max_speed_mps = "
            f"{config.odometry.limits.max_speed_mps:g} are refused; raise it if the robot is that fast"
        )
    elif lost > statistics.poses / 2:
        yield (
            f"the pose was lost in {lost} of {statistics.poses} pairs: is the rig that of these cameras, "
            "is --lower the lower one, are the images bright and sharp?"
        )


def _no_pair(closest_ms: float | None, tolerance_ms: float) -> str:
    if closest_ms is None:
        return "no pair of images: one camera or both have none, see the drops below"
    return (
        f"no pair of images: the stamps of the two cameras are at least {closest_ms:.3f} ms apart, "
        f"pair.tolerance_ms is {tolerance_ms:g}: increase it, or correct the clocks of the cameras"
    )
