"""The start of a calibration from drives: masks of the images, and a rig with which columns match."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib.fit.drive.adjustment import adjust_pairs
from calib.fit.drive.rig_parameters import RigParameters
from calib.fit.drive.rig_prior import prior_information
from calib.fit.rig_drift import apply_drift
from calib.rig import Rig
from drivers.logs.log_reader import LogCameras
from omnid.calibration.board_search import Progress
from omnid.calibration.drive_observations import observe_pairs
from omnid.calibration.images import open_log
from omnid.calibration.rig_check import check_rig, read_rig_pairs
from omnid.config import Config
from omnid.errors import OmnidError
from omnid.stages.geometry import with_rims

Array = NDArray[np.float64]

# Rounds of matching columns before the first drive: each matches in panoramas that the one before has straightened, so
# that wrong matches become fewer.
PAIR_ROUNDS = 3
# Largest difference of stamps during which no motion counts: 3 ms are 3 mm at walking speed.
SYNCHRONOUS_S = 3e-3


def with_masks(log: Path, rig: Rig, cameras: LogCameras) -> Rig:
    """Return the rig with the masks of its mirrors, found in the images of a log where the rig has none."""
    with closing(open_log(log, cameras, rig)) as reader:
        return with_rims(rig, reader.frames())


def straightened(
    log: Path, parameters: RigParameters, cameras: LogCameras, config: Config, progress: Progress
) -> Array:
    """Return steps (P,) to a rig with which columns match, from where tracking works; OmnidError if there is none."""
    rig = parameters.rig
    with closing(open_log(log, cameras, rig)) as reader:
        pairs = read_rig_pairs(reader, rig)
    finding = check_rig(pairs, rig, config.panorama).finding
    progress(finding.summary)
    if finding.drift is None:
        raise OmnidError(
            f"calibrate drive: {finding.summary}; are both cameras the ones of this rig, not exchanged, "
            "and is there enough to see?"
        )
    # Errors of a centre have the effect of a shifted viewpoint, so only the rotation is a start.
    steps = parameters.transform_steps(apply_drift(rig, replace(finding.drift, shift=np.zeros(2))))
    prior = prior_information(parameters, rig)
    if float(np.median([abs(pair.skew_s) for pair in pairs])) > SYNCHRONOUS_S:
        return steps  # the motion between the exposures would be taken for errors of the centres
    for _ in range(PAIR_ROUNDS):
        state, observations = observe_pairs(pairs, parameters.at(steps), config)
        steps = adjust_pairs(parameters, replace(state, steps=steps), observations, prior)
    finding = check_rig(pairs, parameters.at(steps), config.panorama).finding
    progress(finding.summary)
    return steps
