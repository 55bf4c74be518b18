"""State and counters of a camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from drivers.cameras.camera_exposure import CameraExposure


@dataclass(slots=True)
class CameraState:
    """Status and counters; only the capturing thread writes them, any thread may read one field at a time."""

    status: Literal["opened", "streaming", "lost", "closed"] = "opened"
    mode: str = ""  # present mode, such as "GREY 640x480 at 30 Hz"
    problem: str = ""  # reason for the status "lost"
    frames: int = 0  # images that were delivered
    drops: int = 0  # gaps in the driver's sequence numbers: captured by the camera, never received
    errors: int = 0  # buffers that the driver flagged as broken, or that are too short
    restamped: int = 0  # invalid stamps, replaced by the time of arrival
    restarts: int = 0  # restarts of the driver's sequence numbers within a stream
    losses: int = 0  # transitions to the status "lost"
    reopens: int = 0
    exposure: CameraExposure | None = None  # None: the camera offers no exposure time to set
