"""Refuse a rig that the first images contradict, before its poses move wheels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from calib.panorama import Cylinder
from omnid.core.odometry.exposure_times import Exposure
from omnid.core.rig.start_check import CONTRADICTED, RigStartCheck, StartFinding
from omnid.errors import OmnidError
from omnid.messages import Panoramas

RETRY_S: Final = 1.0  # between two rounds while the images show too little
S_PER_NS: Final = 1e-9
PATIENT_PAIRS: Final = 5  # without a known motion, before pairs are used as if the rig stood
EXCHANGE: Final = ("exchange --lower and --upper, or the cameras in the configuration; if that does not help, the rig "
                   "is that of other cameras")
CALIBRATE: Final = "give the rig of these cameras, or calibrate it: `omnid calibrate check` shows by how much it is off"


def never() -> bool:
    """Return False."""
    return False


class RigContradictedError(OmnidError):
    """The images cannot be of this rig."""


class RigGate:
    """Check the rig by the first pairs, by their stamps; each pair that is used takes some 30 ms.

    mode: "refuse" raises RigContradictedError, "warn" keeps the reason in `warning`, "off" checks nothing. Where the
    first images show too little, as in darkness, later ones are used, and until then the rig counts as fitting.
    """

    def __init__(self, cylinder: Cylinder, mode: str, found_later: Callable[[], bool] = never) -> None:
        """found_later: True once the images of a live run contradict the rig, see RigMonitor."""
        self._check, self._mode, self._found_later = RigStartCheck(cylinder), mode, found_later
        self._next_ns: float = -float("inf")
        self._unknown_pairs = 0  # that were not used, because the motion between their exposures is not known

    @property
    def finding(self) -> StartFinding | None:
        """The newest finding; None before the first."""
        return self._check.finding

    @property
    def decided(self) -> bool:
        """True if the rig was found to fit or not."""
        return self._check.decided

    @property
    def exchanged(self) -> bool:
        """True if the cameras are exchanged."""
        return self.decided and self.finding is not None and self.finding.condition == "exchanged"

    @property
    def contradicted(self) -> bool:
        """True if the first images cannot be of this rig."""
        return self.decided and self.finding is not None and self.finding.condition in CONTRADICTED

    @property
    def doubtful(self) -> bool:
        """True if the first images, or later ones, cannot be of this rig."""
        return self.contradicted or self._found_later()

    @property
    def warning(self) -> str:
        """One line about a rig that does not fit or could not be checked; empty for a good one."""
        if self._mode == "off" or self.finding is None:
            return ""
        if self.contradicted:
            return _contradiction(self.finding)
        if not self.decided:
            return ("the rig could not be checked by the images: too few points are seen by both cameras; are they "
                    "dark, covered or unsharp?")
        if self.finding.condition == "drifted" and self._unknown_pairs > PATIENT_PAIRS:
            return ("the rig could only be checked to 2 deg: the cameras are not synchronised, and the motion between "
                    "their exposures is not known: check it by a recording of slow driving, `omnid calibrate check`")
        if self.finding.condition == "drifted":
            return (f"the images do not quite fit the rig, {self.finding.straight.summary}: run `omnid calibrate "
                    "check` on a recording")
        return ""

    @property
    def is_active(self) -> bool:
        """True if more pairs are needed."""
        return self._mode != "off" and not self._check.ended

    def process(self, panoramas: Panoramas, exposure: Exposure | None = None) -> None:
        """Use a pair if it is needed and due.

        exposure: the motion between the exposures of a pair that is not synchronised. Pairs whose motion is not known
        are used once there were PATIENT_PAIRS of them: a rig that is wrong by degrees lets no odometry start.
        """
        if not self.is_active:
            return
        if self._check.between_rounds and panoramas.stamp_ns < self._next_ns:
            return
        if panoramas.times is not None and (exposure is None or not exposure.is_known):
            self._unknown_pairs, exposure = self._unknown_pairs + 1, None
            if self._unknown_pairs <= PATIENT_PAIRS:
                return
        self._check.add(panoramas.lower, panoramas.upper, panoramas.visible, exposure)
        self._next_ns = panoramas.stamp_ns + RETRY_S / S_PER_NS
        if self.contradicted and self._mode == "refuse":
            raise RigContradictedError(self.warning)


def _contradiction(finding: StartFinding) -> str:
    """Return what the images show against the rig, and what to do."""
    straight = finding.straight
    if finding.condition == "exchanged":
        return (f"the images match better the other way round: {finding.exchanged_matches} points are seen as if the "
                f"lower camera were the upper one, {straight.matches} as the rig says: {EXCHANGE}")
    return (f"the images contradict the rig: the upper camera seems turned by {straight.turn_deg:.1f} deg by "
            f"{straight.matches} points: {CALIBRATE}")
