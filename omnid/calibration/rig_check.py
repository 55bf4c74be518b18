"""Check of a rig by the pairs of a log: `omnid calibrate drive --only check`."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from calib.rig import Rig
from drivers.logs.log_reader import LogCameras, LogReader
from omnid.calibration.images import TOLERANCE_NS, spread_pairs
from omnid.config import PanoramaConfig
from omnid.core.rig.rig_health import MIN_MATCHES, RigFinding, RigState, judge, match
from omnid.errors import OmnidError
from omnid.messages import FramePair
from omnid.stages.geometry import Dewarp, geometry, with_rims
from omnid.stages.synchronise import Decoder

# Number of pairs that are used, spread over the log: some thousand matches of different places.
PAIRS: Final = 24
# Median time between the exposures of the pairs: the stamps of cameras that are triggered together scatter by less.
MAX_SKEW_S: Final = 3e-3


@dataclass(frozen=True, slots=True)
class RigCheckResult:
    """Result of the check by the columns of both panoramas."""

    finding: RigFinding
    pairs: int  # that were compared
    skew_s: float  # median time from the lower camera's exposure to the upper one's

    def __str__(self) -> str:
        return f"{self.finding.summary}, in {self.pairs} pairs"


def check_log(log: Path, rig: Rig, cameras: LogCameras) -> RigCheckResult:
    """Check a rig by pairs spread over a log; OmnidError where they show too little."""
    pairs = read_rig_pairs(log, rig, cameras)
    found = check_rig(pairs, rig)
    if abs(found.skew_s) >= MAX_SKEW_S:
        raise OmnidError(
            f"calibrate drive: --only check would take motion for a drift: the upper images are "
            f"{1e3 * found.skew_s:+.1f} ms later than the lower ones; without --only the times of exposure are "
            "calibrated as well"
        )
    if found.finding.state is RigState.UNCHECKED:
        raise OmnidError(
            f"calibrate drive: expected at least {MIN_MATCHES} points in both panoramas, found "
            f"{found.finding.matches} of {found.finding.tried} in {len(pairs)} pairs; use a log with more texture"
        )
    return found


def read_rig_pairs(log: Path, rig: Rig, cameras: LogCameras) -> list[FramePair]:
    """Read at most PAIRS pairs, evenly spread over the log; raises OmnidError if none has the rig's size.

    Cameras that are not synchronised are paired as in a run: within half a period.
    """
    decode, found = Decoder(rig), list[FramePair]()
    with closing(LogReader(log, cameras, rig.topics)) as reader:
        lower_ns = [frame.stamp_ns for frame in reader.frames() if frame.camera == "lower"]
        period_ns = float(np.median(np.diff(lower_ns))) if len(lower_ns) > 1 else 0.0
        for number, *frames in spread_pairs(reader, PAIRS, max(TOLERANCE_NS, period_ns / 2)):
            lower, upper = map(decode, frames)
            if lower is not None and upper is not None:
                skew_s = (frames[1].stamp_ns - frames[0].stamp_ns) * 1e-9
                found.append(FramePair(number, frames[0].stamp_ns, lower, upper, skew_s))
    if not found:
        raise OmnidError(
            "calibrate drive: no pair of images in the log; "
            f"{decode.first_error or 'expected nearly equal stamps of both cameras'}"
        )
    return found


def check_rig(pairs: Sequence[FramePair], rig: Rig) -> RigCheckResult:
    """Check a rig by pairs of images."""
    config = PanoramaConfig()
    rectification = geometry(rig, config)
    dewarp = Dewarp(rectification, config)
    seen = map(dewarp.process, pairs)
    found = [match(panoramas.lower, panoramas.upper, panoramas.visible) for panoramas in seen]
    skew_s = float(np.median([pair.skew_s for pair in pairs]))
    return RigCheckResult(judge(found, rectification.cylinder), len(pairs), skew_s)


def with_masks(log: Path, rig: Rig, cameras: LogCameras) -> Rig:
    """Return the rig with the masks of its mirrors, found in the images of a log where the rig has none."""
    with closing(LogReader(log, cameras, rig.topics)) as reader:
        return with_rims(rig, reader.frames())
