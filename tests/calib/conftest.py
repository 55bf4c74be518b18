"""Rigs whose transforms differ from their inverses, with cameras of both models."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib import se3
from calib.models.camera import Array, OmniCamera
from calib.models.ocam import OcamCamera
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera, Rig

# A mirror camera that looks up: its z axis points down, and forward, left, up become -y, -x, -z of the camera.
T_DOWN = se3.transform([[0, -1, 0], [-1, 0, 0], [0, 0, -1]], [0, 0, 0])


def misaligned(lower: OmniCamera, upper: OmniCamera) -> Rig:
    """Return a rig that is rotated and shifted about every axis, so that a transform differs from its inverse."""
    T_lower_rig = se3.exp([0.01, -0.02, 0.03, 0.04, -0.05, 0.6]) @ T_DOWN
    T_upper_lower = se3.exp([-0.008, 0.011, 0.17, 0.03, 0.02, -0.25])
    T_base_rig = se3.exp([0.1, 0.2, 0.3, 0.01, 0.02, 0.03])
    return Rig(
        MountedCamera(lower, T_lower_rig),
        MountedCamera(upper, T_upper_lower @ T_lower_rig),
        T_base_rig,
        ("/front/lower/image_raw", "/front/upper/image_raw"),
    )


def omni_cameras() -> tuple[UnifiedCamera, UnifiedCamera]:
    return (
        UnifiedCamera(0.93, (-205.0, 211.0), (381.5, 386.25), (768, 770)),
        UnifiedCamera(1.1, (-214.0, 206.0), (390.0, 379.0), (780, 768), (-0.01, 0.002, 1e-4, -2e-4)),
    )


def ocam_cameras() -> tuple[OcamCamera, OcamCamera]:
    curved = (-131.64, 0.0, 1.88e-3, 9.4e-8, -6.1e-10)
    return (
        OcamCamera(curved, (382.4, 514.6), (0.99923, 2.2e-4, -2.1e-4), (1024, 768)),
        OcamCamera((-110.0, 0.0, 2.1e-3), (390.0, 500.0), (1.001, -1e-3, 2e-3), (1000, 780)),
    )


@pytest.fixture(params=["omni", "ocam"])
def rig(request: pytest.FixtureRequest) -> Rig:
    return misaligned(*(omni_cameras() if request.param == "omni" else ocam_cameras()))


@pytest.fixture
def omni_rig() -> Rig:
    return misaligned(*omni_cameras())


@pytest.fixture
def ocam_rig() -> Rig:
    return misaligned(*ocam_cameras())


@pytest.fixture
def around() -> Array:
    """Return points (N, 3) [m] on all sides of a rig, 1 to 5 m away, from 35 degrees below to 30 above the horizon."""
    random = np.random.default_rng(1)
    azimuth, elevation = random.uniform(-np.pi, np.pi, 300), np.deg2rad(random.uniform(-35, 30, 300))
    level = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)])
    return np.asarray(level * random.uniform(1, 5, (300, 1)))


@pytest.fixture
def shared_data() -> Path:
    folder = Path(__file__).parents[3] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not here")
    return folder
