"""Dewarping."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from calib import se3
from calib.panorama import remap_tables
from drivers.frame import Frame
from omnid.config import Config
from omnid.messages import FramePair
from omnid.stages.dewarp import Dewarp
from omnid.stages.geometry import Geometry, geometry
from tests.omnid.stages.scene_parts import CONFIG, front_end, run_pairs
from tests.simulation import build, render_grey


def test_points_project_to_the_pixels_they_were_matched_at() -> None:
    """In a misaligned rig, points project into both images where the remap tables have their pixels."""
    run = build("misaligned", seed=1, size=256, pairs=1)
    rig_geometry = geometry(run.rig, CONFIG.panorama)
    pair = FramePair(0, 0, *(render_grey(run.scene, m, run.poses[0]) for m in (run.rig.lower, run.rig.upper)))
    depth = front_end(rig_geometry).dense.points(Dewarp(rig_geometry, CONFIG.panorama).process(pair))
    column, row = depth.pixels.astype(int).T
    below = row + depth.disparity[row, column]
    assert len(column) > 300
    for mounted, rows in ((run.rig.lower, row), (run.rig.upper, below)):
        seen = mounted.camera.project(se3.apply(mounted.T_cam_rig, depth.points))
        tables = remap_tables(run.rig, mounted, rig_geometry.cylinder)
        expected = np.column_stack(
            [cv2.remap(t, column.astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR).ravel() for t in tables]
        )
        assert np.abs(seen - expected).max() < 0.05


def test_panoramas_keep_the_steps_of_their_jpegs(rig_geometry: Geometry, frames: list[Frame]) -> None:
    (pair,), _ = run_pairs(rig_geometry, frames[:2])
    found = Dewarp(rig_geometry, CONFIG.panorama).process(replace(pair, jpeg_steps=((1, 2), (3, 4))))
    assert (found.lower.jpeg_steps, found.upper.jpeg_steps) == ((1, 2), (3, 4))


def test_a_dim_image_is_brightened_and_its_noise_is_known(rig_geometry: Geometry, frames: list[Frame]) -> None:
    pair = run_pairs(rig_geometry, frames)[0][0]
    dewarp = Dewarp(rig_geometry, Config().panorama)
    bright = dewarp.process(pair)
    noise = np.random.default_rng(1).normal(0, 5, pair.lower.shape)
    dim = np.clip(np.rint(0.25 * pair.lower + 5 + noise), 0, 255).astype(np.uint8)
    dark = Dewarp(rig_geometry, Config().panorama).process(replace(pair, lower=dim))
    assert bright.lower.gain == bright.upper.gain == dark.upper.gain == 1
    np.testing.assert_array_equal(bright.upper.image, dark.upper.image)
    shown, other = (one.panorama[dark.visible].mean() for one in (dark.lower, dark.upper))
    assert dark.lower.gain > 1.5 and abs(shown / other - 1) < 0.1
    both = np.clip(np.rint(0.25 * pair.upper + 5 + noise), 0, 255).astype(np.uint8)
    evening = Dewarp(rig_geometry, Config().panorama).process(replace(pair, lower=dim, upper=both))
    assert abs(evening.lower.panorama[dark.visible].mean() - 80) < 2
    assert dark.light.level_grey < 50 < bright.light.level_grey
    assert dark.light.contrast_to_noise < 0.4 * bright.light.contrast_to_noise
    assert not dark.light.is_too_dark and not bright.light.is_too_dark
    night = np.clip(np.rint(0.02 * pair.lower + 5 + noise), 0, 255).astype(np.uint8)
    assert Dewarp(rig_geometry, Config().panorama).process(replace(pair, lower=night)).light.is_too_dark
    assert 2.0 < dark.lower.noise_grey / dark.lower.gain < 6.0  # interpolation makes it less than 5
    assert bright.lower.noise_grey < 3.0


def test_a_coarser_panorama_is_made_of_a_blurred_image(rig_geometry: Geometry) -> None:
    """Single pixels of noise are averaged, not picked."""
    size = rig_geometry.rig.lower.camera.size[::-1]
    image = np.random.default_rng(3).integers(100, 200, size).astype(np.uint8)
    pair, spread = FramePair(0, 0, image, image), []
    for config in (CONFIG.panorama, replace(CONFIG.panorama, scale=0.5)):
        seen = Dewarp(geometry(rig_geometry.rig, config), config).process(pair)
        spread.append(seen.lower.panorama[seen.visible].std())
    assert spread[1] < 0.75 * spread[0]
