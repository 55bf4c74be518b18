"""Images of rendered scenes in whole grey levels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib.models.camera import Array
from calib.rig import MountedCamera
from omnid.simulation.rendering.ray_caster import render_grey
from omnid.simulation.rendering.surfaces import Scene


def render(scene: Scene, mounted: MountedCamera, T_world_rig: Array, supersample: int = 2) -> NDArray[np.uint8]:
    """Return the image (H, W) uint8 of the camera on a rig at T_world_rig; 0 outside the mask."""
    return np.clip(np.rint(render_grey(scene, mounted, T_world_rig, supersample)), 0, 255).astype(np.uint8)
