"""Small images for the tests of the core: random panoramas, and frames of a rendered rig in a corridor."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder, Maps, fit_cylinder, remap_tables, visible
from calib.rig import Rig
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.stereo.matcher import Matcher, MatchingSettings
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.stereo_model import StereoModel
from tests.simulation import MountedSensor, Scene, Sensor, render_grey

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Image = NDArray[np.uint8]

PAD_PX = 48
BORDER_PX = 8


def texture(seed: int, shape: tuple[int, int] = (120, 480), sigma_px: float = 2.0) -> Image:
    """A smooth random panorama (H, W) that goes on across its seam."""
    noise = np.random.default_rng(seed).standard_normal(shape)
    around = cv2.GaussianBlur(np.hstack([noise] * 3), (0, 0), sigma_px)[:, shape[1] : 2 * shape[1]]
    return np.asarray(np.clip(128 + 45 * around / around.std(), 0, 255), np.uint8)


def wrapped(panorama: Image) -> PaddedPanorama:
    """The panorama with PAD_PX columns repeated on either side."""
    return PaddedPanorama(np.hstack([panorama[:, -PAD_PX:], panorama, panorama[:, :PAD_PX]]), PAD_PX)


def turned(panorama: Image, columns: float) -> Image:
    """The panorama shifted right by that many columns, to sub-pixels, around the seam, as by a turn to the left."""
    spectrum = np.fft.rfft(panorama.astype(float), axis=1)
    phase = np.exp(-2j * np.pi * columns * np.arange(spectrum.shape[1]) / panorama.shape[1])
    return np.clip(np.rint(np.fft.irfft(spectrum * phase, panorama.shape[1], axis=1)), 0, 255).astype(np.uint8)


@dataclass(frozen=True, slots=True)
class RenderedCameras:
    """A rig in a scene, and the processing of its images to stereo frames; its pose is T_world_rig."""

    rig: Rig
    scene: Scene
    cylinder: Cylinder
    maps: tuple[Maps, Maps]
    usable: Flags
    exposures: tuple[MountedSensor, MountedSensor]
    matcher: Matcher

    @staticmethod
    def of(rig: Rig, scene: Scene) -> RenderedCameras:
        """Return the cameras of a rig, with noise and blur as their only sensor faults."""
        cylinder = fit_cylinder(rig)
        maps = remap_tables(rig, rig.lower, cylinder, PAD_PX), remap_tables(rig, rig.upper, cylinder, PAD_PX)
        seen = visible(rig.lower, maps[0], 2) & visible(rig.upper, maps[1], 2)
        seen[:BORDER_PX], seen[-BORDER_PX:] = False, False
        sensors = [MountedSensor(Sensor(), m.visible, m.camera.size) for m in (rig.lower, rig.upper)]
        return RenderedCameras(
            rig,
            scene,
            cylinder,
            maps,
            seen[:, PAD_PX:-PAD_PX],
            (sensors[0], sensors[1]),
            Matcher(seen.shape, MatchingSettings(disparities=32)),
        )

    @property
    def model(self) -> StereoModel:
        """The stereo model of the panoramas."""
        return StereoModel(self.cylinder, self.rig.baseline_m)

    def frame(self, seq: int, T_world_rig: Array) -> StereoFrame:
        """Return the frame seen from a pose."""
        rng = np.random.default_rng([seq, 99])
        mounted = (self.rig.lower, self.rig.upper)
        images = [
            e.expose(render_grey(self.scene, m, T_world_rig), rng) for e, m in zip(self.exposures, mounted, strict=True)
        ]
        return self.stereo_frame(seq, images[0], images[1])

    def darkness(self, seq: int) -> StereoFrame:
        """Return the frame seen with the light off."""
        black = np.zeros(self.rig.lower.camera.size[::-1], np.uint8)
        return self.stereo_frame(seq, black, black)

    def stereo_frame(self, seq: int, lower: Image, upper: Image) -> StereoFrame:
        """Return the frame of two images."""
        panoramas = [
            np.asarray(cv2.remap(image, *maps, cv2.INTER_LINEAR), np.uint8)
            for image, maps in zip((lower, upper), self.maps, strict=True)
        ]
        padded = np.zeros(panoramas[0].shape, bool)
        padded[:, PAD_PX:-PAD_PX] = self.usable
        pixels, found = self.matcher.match(panoramas[0], panoramas[1], padded)
        disparity = np.full(padded.shape, np.nan, np.float32)
        disparity.reshape(-1)[pixels] = found
        inner = np.ascontiguousarray(disparity[:, PAD_PX:-PAD_PX])
        return StereoFrame(
            seq, PaddedPanorama(panoramas[0], PAD_PX), PaddedPanorama(panoramas[1], PAD_PX), inner, self.usable
        )


def motion_errors(estimated: Array, truth: Array) -> tuple[float, float]:
    """Distance [m] and angle [rad] between two poses (4, 4)."""
    difference = se3.log(se3.inverse(truth) @ estimated)
    return float(np.linalg.norm(difference[:3])), float(np.linalg.norm(difference[3:]))
