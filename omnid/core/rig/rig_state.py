"""States of a rig's calibration, against the images of a run."""

from __future__ import annotations

from enum import StrEnum


class RigState(StrEnum):
    """State of a rig by the images; ARCHITECTURE.md has a figure of the transitions."""

    UNCHECKED = "unchecked"  # the images show too little, or nothing was checked yet
    FITS = "fits"
    DRIFTED = "drifted"  # by some tenths of a degree: poses are less accurate
    EXCHANGED = "exchanged"  # the lower camera is taken for the upper one
    BROKEN = "broken"  # by degrees: a mirror was knocked, a camera is covered, or the rig is of other cameras

    @property
    def is_contradicted(self) -> bool:
        """True if the images cannot be of this rig, so that no pose of them is to be relied on."""
        return self in (RigState.EXCHANGED, RigState.BROKEN)
