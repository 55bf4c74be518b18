"""Models of a rig's cameras for a drive: chosen by landmarks they were not fitted to, judged by their residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.fit.drive.adjustment import DriveAdjustment
from calib.fit.drive.problem import DriveProblem
from calib.fit.residual_structure import OUTLIER_RATIO, ResidualStructure, systematic_px
from calib.models.unified import UnifiedCamera
from calib.rig import Rig

# Terms of omni cameras, in ascending order of their number. Tangential ones hold a camera that is tilted under its
# mirror. A drive on a floor hardly distinguishes radial ones from a stretched world: they are the last resort.
DISTORTIONS: tuple[tuple[str, ...], ...] = ((), ("p1", "p2"), ("k1", "p1", "p2"))
# A model with more terms is chosen where it lowers the error of landmarks held out by this part.
MIN_GAIN = 0.01


@dataclass(frozen=True, slots=True)
class DriveModelScore:
    """The error [px] of a model at landmarks that it was not fitted to."""

    distortion: tuple[str, ...]
    held_out_px: float

    def __str__(self) -> str:
        name = " ".join(self.distortion) or "the file's terms"
        return f"model with {name}: {self.held_out_px:.4f} px at landmarks held out"


def candidate_distortions(rig: Rig) -> tuple[tuple[str, ...], ...]:
    """Return the terms to try for a rig's cameras beyond those of its file."""
    cameras = (rig.lower.camera, rig.upper.camera)
    return DISTORTIONS if all(isinstance(camera, UnifiedCamera) for camera in cameras) else ((),)


def best_model(scores: Sequence[DriveModelScore]) -> DriveModelScore:
    """Return the model with the fewest terms that none with more of them improves significantly."""
    best = scores[0]
    for score in scores[1:]:
        if score.held_out_px < (1 - MIN_GAIN) * best.held_out_px:
            best = score
    return best


def drive_structure(found: DriveAdjustment) -> tuple[ResidualStructure, ResidualStructure]:
    """Return the systematic part and the noise of the residuals in the lower and in the upper image."""
    problem = DriveProblem(found.parameters, found.observations, found.prior, np.zeros(1, int))
    residuals, seen, rig = problem.residuals(found.state), found.observations, found.rig
    structures = []
    for camera, mounted in enumerate((rig.lower, rig.upper)):
        own = residuals[seen.camera == camera]
        systematic = systematic_px(seen.pixels[seen.camera == camera], own, mounted.camera.center)
        length = np.linalg.norm(own, axis=1)
        usual = own[length < OUTLIER_RATIO * np.median(length)]
        noise = float(np.sqrt(max(0.0, float(np.mean(usual**2)) - systematic**2)))
        structures.append(ResidualStructure(systematic, noise))
    return structures[0], structures[1]
