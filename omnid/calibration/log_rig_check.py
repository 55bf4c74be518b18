"""Check of a rig by pairs of a log's images."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib.masks.rim_check import RimShift, rim_shift
from calib.rig import Rig
from drivers.errors import DriverError
from drivers.logs.log_reader import LogReader
from omnid.calibration.image_pairs import SIDES, TOLERANCE_NS, paired
from omnid.config import PanoramaConfig
from omnid.core.rig.rig_check import RigCheck, RigFinding
from omnid.errors import OmnidError
from omnid.messages import FramePair
from omnid.stages.decoder import Decoder
from omnid.stages.dewarp import Dewarp
from omnid.stages.geometry import geometry

# Number of pairs that are used.
PAIRS = 24


@dataclass(frozen=True, slots=True)
class RigCheckResult:
    """Result of the check: columns of both panoramas, and the rims of the lower and the upper mirror if found."""

    finding: RigFinding
    rims: tuple[RimShift | None, RimShift | None]

    @property
    def good(self) -> bool:
        """True if columns and rims are within their tolerances."""
        return self.finding.condition == "good" and all(rim is None or rim.fits for rim in self.rims)


def open_log(log: Path, topics: tuple[str | None, str | None], rig: Rig | None) -> LogReader:
    """Open the log's two cameras: by the requested topics, by the rig's if the log has them, or by their names."""
    rig_topics = rig.topics if rig else ("", "")
    named = [requested or known or None for requested, known in zip(topics, rig_topics, strict=True)]
    if rig and not any(topics):
        with suppress(DriverError):
            return LogReader(log, *named)
    return LogReader(log, *topics)


def read_rig_pairs(reader: LogReader, rig: Rig) -> list[FramePair]:
    """Read at most PAIRS pairs, evenly spread over the log; raises OmnidError if none has the rig's size.

    Cameras that are not synchronised are paired as in a run: within half a period.
    """
    stamps = {camera: [frame.stamp_ns for frame in reader.frames() if frame.camera == camera] for camera in SIDES}
    steps = [step for own in stamps.values() for step in np.diff(sorted(own)).tolist() if step > 0]
    within_ns = max(TOLERANCE_NS, float(np.median(steps)) / 2 if steps else 0.0)
    stride = max(1, (min(map(len, stamps.values())) - 1) // PAIRS + 1)
    decode, found = Decoder(rig), list[FramePair]()
    for number, (lower, upper) in enumerate(paired(reader.frames(), within_ns)):
        if number % stride:
            continue
        images = decode(lower), decode(upper)
        skew_s = (upper.stamp_ns - lower.stamp_ns) * 1e-9
        if images[0] is not None and images[1] is not None:
            found.append(FramePair(number, lower.stamp_ns, images[0], images[1], skew_s))
    if not found:
        raise OmnidError("calibrate check: no pair of images in the log; "
                         f"{decode.fault or 'expected nearly equal stamps of both cameras'}")
    return found


def check_rig(pairs: Sequence[FramePair], rig: Rig, config: PanoramaConfig) -> RigCheckResult:
    """Check a rig by pairs of images."""
    rectification = geometry(rig, config)
    dewarp, check = Dewarp(rectification, config), RigCheck(rectification.cylinder, len(pairs))
    for pair in pairs:
        panoramas = dewarp.process(pair)
        check.add(panoramas.lower, panoramas.upper, panoramas.visible)
    rims = tuple(rim_shift(_brightest([getattr(pair, side) for pair in pairs]), mounted.mask)
                 for side, mounted in zip(SIDES, (rig.lower, rig.upper), strict=True))
    return RigCheckResult(check.finding(), (rims[0], rims[1]))


def _brightest(images: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    return np.asarray(np.max(np.stack(images), axis=0), np.uint8)
