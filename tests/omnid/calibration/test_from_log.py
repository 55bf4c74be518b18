"""Height, tilt and masks of a rig by a log; parts that are fixed to a camera, learned as the base turns."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import omnid
from calib import se3
from calib.panorama import Cylinder
from calib.rig_file import read_rig
from omnid.calibration.from_log import HEADINGS, FixedParts, HeightCalibration, MaskCalibration, on_floor
from omnid.cli import main
from omnid.core.floor import Floor
from omnid.core.types.panorama import PaddedPanorama
from tests.simulation.disturbances import REFLECTION_RADIUS
from tests.simulation.logs import write_log
from tests.simulation.recipes import build
from tests.simulation.rigs import make_rig

HEIGHT_M = 1.2  # of rendered rigs: tests/simulation/paths.py
SIZE_PX, PAIRS = 200, 24


def command(*words: object) -> int:
    return main(["calibrate", *map(str, words)])


@pytest.fixture(scope="module")
def found(scene: Path) -> HeightCalibration:
    return omnid.calibrate_height(str(scene / "log.mcap"), scene / "rig.toml")


def test_the_height_is_found_within_its_sigma(found: HeightCalibration) -> None:
    assert abs(found.floor.height_m - HEIGHT_M) < 2 * found.floor.sigma_m < 0.08
    assert found.rig.height_m() == pytest.approx(found.floor.height_m, rel=1e-3)
    assert f"{found.floor.height_m:.3f} m (sigma" in str(found)


def test_a_tilted_rig_is_found_tilted(scene: Path) -> None:
    """By 1.5 degrees, more than the sigma of the prior, which draws it towards 0."""
    T_base_rig = se3.transform(se3.rotation_exp(np.deg2rad([0.0, 1.5, 0.0])), np.array([0.2, 0.0, 0.7]))
    rig = replace(read_rig(scene / "rig.toml"), T_base_rig=T_base_rig)
    floor = omnid.calibrate_height(scene / "log.mcap", rig).floor
    assert abs(floor.height_m - HEIGHT_M) < 0.05 and floor.a < -np.deg2rad(0.3)
    assert np.hypot(floor.a + np.deg2rad(1.5), floor.b) < 2.5 * floor.sigma_rad


def test_a_rig_is_levelled() -> None:
    T_base_rig = se3.transform(se3.rotation_exp(np.deg2rad([0.0, 1.5, 0.0])), np.array([0.2, 0.1, 0.0]))
    rig = replace(make_rig(), T_base_rig=T_base_rig)
    floor = Floor(HEIGHT_M, -np.tan(np.deg2rad(1.5)), 0.0, 0.01, np.deg2rad(0.1))
    found = on_floor(rig, floor).T_base_rig
    np.testing.assert_allclose(found[2, :3], [0.0, 0.0, 1.0], atol=1e-3)
    np.testing.assert_allclose(found[:3, 3], [0.2, 0.1, HEIGHT_M], atol=0.02)


def test_the_command_writes_the_rig(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], found: HeightCalibration
) -> None:
    words = ("drive", scene / "log.mcap", "--only", "height", "--rig", scene / "rig.toml", "-o", tmp_path / "rig.toml")
    assert command(*words) == 0
    out = capsys.readouterr().out
    assert str(found) in out and "no height of the cameras" in out
    assert read_rig(tmp_path / "rig.toml").height_m() == pytest.approx(found.floor.height_m, rel=1e-3)


@pytest.fixture(scope="module")
def spin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("spin")
    run = build("spin", seed=3, size=SIZE_PX, pairs=PAIRS)
    write_log(folder, run.rig, run.poses, run.scene, seed=3, supersample=1, disturbances=("flare",))
    return folder


@pytest.fixture(scope="module")
def masks(spin: Path) -> MaskCalibration:
    return omnid.calibrate_mask(spin / "log.mcap", spin / "rig.toml")


def test_the_reflection_is_masked_and_the_world_is_not(spin: Path, masks: MaskCalibration) -> None:
    assert 0.005 < masks.share < 0.15 and f"{100 * masks.share:.1f} %" in str(masks)
    before = read_rig(spin / "rig.toml")
    for was, mounted in ((before.lower, masks.rig.lower), (before.upper, masks.rig.upper)):
        assert mounted.mask is not None and mounted.mask.image is not None
        v, u = np.nonzero(mounted.mask.image == 0)
        rim_px = min(was.visible.outer_px, SIZE_PX / 2)
        radius = np.hypot(u - was.visible.center[0], v - was.visible.center[1]) / rim_px
        # Its light lies between 1.5 and 2.5 of REFLECTION_RADIUS of the rim's radius; a band-pass spreads the border.
        assert radius.size and radius.min() > 1.3 * REFLECTION_RADIUS and radius.max() < 3.2 * REFLECTION_RADIUS


def test_the_command_writes_a_rig_that_needs_no_other_mask(
    spin: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], masks: MaskCalibration
) -> None:
    masked = tmp_path / "rig.toml"
    words = ("drive", spin / "log.mcap", "--only", "mask", "--rig")
    assert command(*words, spin / "rig.toml", "-o", masked) == 0
    assert f"{masks}\n{masked}: written" in capsys.readouterr().out
    assert command(*words, masked) == 0
    assert capsys.readouterr().out.startswith("nothing is fixed to the cameras that the masks do not hide")


def test_a_robot_that_hardly_turns_is_refused(scene: Path) -> None:
    with pytest.raises(omnid.OmnidError, match=r"shows \d of 16 headings of a turn, 12 are needed: record a log"):
        omnid.calibrate_mask(scene / "log.mcap", scene / "rig.toml")


# Parts that are fixed to a camera


CYLINDER = Cylinder(872, 253, 86.0)
SHOWN = np.ones((CYLINDER.height, CYLINDER.width), bool)
PAD_PX, NOISE_GREY = 24, 1.0
TURN = [(n + 0.5) * math.tau / HEADINGS for n in range(HEADINGS)]


@lru_cache(maxsize=1)
def world() -> NDArray[np.float32]:
    """Return a panorama of texture of all sizes."""
    rng = np.random.default_rng(3)
    grey = np.full((CYLINDER.height, CYLINDER.width), 120.0, np.float32)
    for sigma_px, contrast_grey in ((1.0, 8.0), (4.0, 8.0), (12.0, 8.0)):
        noise = cv2.GaussianBlur(rng.normal(size=grey.shape), (0, 0), sigma_px)
        grey += (contrast_grey / noise.std() * noise).astype(np.float32)
    return grey


def seen(heading_rad: float) -> PaddedPanorama:
    """Return the world at a heading."""
    grey = np.roll(world(), round(heading_rad / math.tau * CYLINDER.width), axis=1)
    noise = np.random.default_rng(round(1e3 * heading_rad)).normal(0.0, NOISE_GREY, grey.shape)
    image = np.clip(np.rint(grey + noise), 0, 255).astype(np.uint8)
    return PaddedPanorama(np.pad(image, ((0, 0), (PAD_PX, PAD_PX)), mode="wrap"), PAD_PX, NOISE_GREY)


def turned(heading_rad: float, x_m: float = 0.0) -> NDArray[np.float64]:
    """Return a pose (4, 4)."""
    T = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, heading_rad]))
    T[0, 3] = x_m
    return T


def observed(pairs: Callable[[float], tuple[PaddedPanorama, PaddedPanorama]]) -> NDArray[np.bool_]:
    """Return the pixels that are fixed by the pairs of a turn."""
    parts = FixedParts(CYLINDER)
    for heading in TURN:
        parts.observe(turned(heading), *pairs(heading), SHOWN)
    assert parts.headings == HEADINGS
    return parts.pixels()


def test_the_world_the_horizon_and_images_that_do_not_follow_the_heading_are_not_fixed() -> None:
    """Without the rows of the horizon a bar as high as the cameras would not be seen; wheels may carry the pose past
    images that do not change."""
    grey, still = np.zeros((CYLINDER.height, CYLINDER.width + 2 * PAD_PX), np.uint8), seen(0.0)
    grey[: round(CYLINDER.row0) + 8] = 60  # the sky, and hills
    before_hills = lambda heading: replace(seen(heading), image=seen(heading).image + grey)  # noqa: E731
    for pairs in (
        lambda heading: (seen(heading), seen(heading)),
        lambda heading: (before_hills(heading), before_hills(heading)),
        lambda _: (still, still),
    ):
        assert not observed(pairs).any()
