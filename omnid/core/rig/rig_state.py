"""States of a rig's calibration, against the images of a run."""

from __future__ import annotations

from enum import StrEnum


class RigState(StrEnum):
    """State of a rig by the images; ARCHITECTURE.md has a figure of the transitions."""

    UNCHECKED = "unchecked"  # The images show too little, or nothing was checked yet.
    FITS = "fits"
    DRIFTED = "drifted"  # The rig is off by some tenths of a degree: poses are less accurate.
    EXCHANGED = "exchanged"  # The lower camera was taken for the upper one.
    BROKEN = "broken"  # The rig is off by degrees: a mirror was knocked, a camera covered, or it is of other cameras.

    @property
    def is_contradicted(self) -> bool:
        """True if the images cannot be of this rig, so that no pose of them is to be relied on."""
        return self in (RigState.EXCHANGED, RigState.BROKEN)
