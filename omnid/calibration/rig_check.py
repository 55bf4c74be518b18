"""Check of a rig by the pairs of a log: the driver of `omnid calibrate check`."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from calib.masks.rim_check import RimShift, rim_shift
from calib.rig import Rig
from drivers.logs.log_reader import LogReader
from omnid.calibration.drive_observations import Topics, tracked_updates
from omnid.calibration.images import SIDES, TOLERANCE_NS, brightest, open_log, paired
from omnid.config import Config, PanoramaConfig
from omnid.core.rig.column_finding import RigFinding, judge
from omnid.core.rig.column_matches import Matches, is_motion_unknown, match, together
from omnid.core.rig.rig_health import RigHealth
from omnid.core.rig.rig_state import RigState
from omnid.errors import OmnidError
from omnid.messages import FramePair
from omnid.stages.decoder import Decoder
from omnid.stages.dewarp import Dewarp
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import geometry

# Number of pairs that are used, spread over the log: some thousand matches of different places.
PAIRS: Final = 24


@dataclass(frozen=True, slots=True)
class RigCheckResult:
    """Result of the check: columns of both panoramas, and the rims of the lower and the upper mirror if found."""

    finding: RigFinding
    rims: tuple[RimShift | None, RimShift | None]

    @property
    def state(self) -> RigState:
        """The state by the columns; a rig that fits has drifted if a rim has moved."""
        fits = all(rim is None or rim.fits for rim in self.rims)
        return RigState.DRIFTED if self.finding.state is RigState.FITS and not fits else self.finding.state


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
        raise OmnidError(
            "calibrate check: no pair of images in the log; "
            f"{decode.fault or 'expected nearly equal stamps of both cameras'}"
        )
    return found


def check_rig(pairs: Sequence[FramePair], rig: Rig, config: PanoramaConfig) -> RigCheckResult:
    """Check a rig by pairs of images."""
    rectification = geometry(rig, config)
    dewarp = Dewarp(rectification, config)
    seen = map(dewarp.process, pairs)
    found = [match(panoramas.lower, panoramas.upper, panoramas.visible) for panoramas in seen]
    rims = tuple(
        rim_shift(brightest(getattr(pair, side) for pair in pairs), mounted.mask)
        for side, mounted in zip(SIDES, (rig.lower, rig.upper), strict=True)
    )
    return RigCheckResult(judge(together(found), rectification.cylinder), (rims[0], rims[1]))


def moving_rig_finding(log: Path, rig: Rig, topics: Topics, config: Config) -> RigFinding:
    """Return what at most PAIRS pairs of cameras that are not synchronised say about the rig.

    The odometry finds the motion between the exposures, for which the pixels are corrected. OmnidError where no pose is
    found.
    """
    place = geometry(rig, config.panorama)
    front_end = FrontEnd(place, config, RigHealth(place.cylinder, "warn"))
    found, number = list[Matches](), 0
    with closing(open_log(log, topics, rig)) as reader:
        stride = max(1, (reader.pair_estimate() or 0) // PAIRS)
        for update in tracked_updates(reader, front_end, config, log):
            exposure, seen = update.depth.exposure, update.depth.panoramas
            if is_motion_unknown(seen, exposure):
                continue
            if number % stride == 0:
                found.append(match(seen.lower, seen.upper, seen.visible, exposure))
            number += 1
    return judge(together(found[-PAIRS:]), place.cylinder)
