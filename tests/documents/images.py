"""Images of README and docs: `python -m tests.documents.images stills|drive` writes docs/images.

stills: one mirror image of the sample log, its panorama and its depth. drive: the simulated robot of
`omnid demo --drive` as a GIF, one image for each second of simulated time; it takes minutes.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

import omnid
from calib.panorama import fit_cylinder, remap_tables
from calib.rig import Rig
from drivers.frame import gray
from drivers.logs.log_reader import LogReader
from omnid.config import load_config
from omnid.simulation.demonstration import TeachAndRepeat, both_paths, draw, seen_obstacles
from omnid.simulation.lockstep import SimulatedRun, simulate
from omnid.simulation.robot import make_robot, with_masks
from omnid.simulation.vehicle import START_NS, SimulatedCameras
from omnid.simulation.world import Walkers, World
from omnid.simulation.world_file import load_world

Image = NDArray[np.uint8]
FOLDER: Final = Path(__file__).parents[2] / "docs" / "images"
PAIR: Final = 40  # of the sample's 99: the start of the turn, with walls and boxes around
WIDTH_PX: Final = 720  # of a still
GIF_WIDTH_PX: Final = 480
GREYS: Final = 8  # of the GIF's panorama; with 20 colours in all this keeps the file below 1 MB
DRIVE_S: Final = 90.0  # of simulated time at most, as in `omnid demo --drive`
FRAME_MS: Final = 125  # a GIF's image stands for a second of the drive: eight times as fast
PAUSE_MS: Final = 2500  # of the last image
RANGES_M: Final = (0.8, 6.0)  # that the colours of the depth span
WHITE: Final = (255, 255, 255)


def stills() -> None:
    """Write mirror.jpg, panorama.jpg and depth.jpg of one pair of the sample."""
    with as_file(files("omnid.sample") / "log.mcap") as log:
        reader = LogReader(log)
        with tempfile.TemporaryDirectory() as folder:
            rig_file = Path(folder) / "rig.toml"
            rig_file.write_bytes(reader.attachments()["rig.toml"])
            odometry = omnid.Odometry(rig_file)
        frames = list(itertools.islice(reader.frames(), 2 * PAIR, 2 * PAIR + 2))
    images = {frame.camera: gray(frame) for frame in frames}
    pose = odometry.process(frames[0].stamp_ns, images["lower"], images["upper"])
    dense = odometry.depth(pose)
    panorama = pose.depth.panoramas.lower.panorama
    _write("mirror.jpg", images["lower"], 360)
    _write("panorama.jpg", panorama, WIDTH_PX)
    _write("depth.jpg", _depth_image(panorama, dense.pixels, np.linalg.norm(dense.points[:, :2], axis=1)), WIDTH_PX)


def _depth_image(panorama: Image, pixels: NDArray[Any], ranges_m: NDArray[np.float64]) -> Image:
    """Return the panorama with each located pixel coloured by its range, and a bar with the scale of the colours."""
    image = cv2.cvtColor(panorama // 3, cv2.COLOR_GRAY2BGR)
    columns, rows = np.rint(pixels).astype(int).T
    for down, across in itertools.product((0, 1), repeat=2):  # each pixel as a square of 2 x 2
        image[np.minimum(rows + down, len(image) - 1), (columns + across) % image.shape[1]] = _colours(ranges_m)
    height, width = image.shape[:2]
    bar = np.geomspace(*RANGES_M, width // 4)
    image[height - 40 : height - 28, 20 : 20 + len(bar)] = _colours(bar)
    for range_m in (1, 2, 3, 4, 6):
        at = 20 + int(np.searchsorted(bar, range_m)) - 6
        cv2.putText(image, f"{range_m}", (at, height - 10), cv2.FONT_HERSHEY_SIMPLEX, 0.6, WHITE, 2, cv2.LINE_AA)
    cv2.putText(image, "m", (24 + len(bar), height - 28), cv2.FONT_HERSHEY_SIMPLEX, 0.6, WHITE, 2, cv2.LINE_AA)
    return np.asarray(image, np.uint8)


def _colours(ranges_m: NDArray[np.float64]) -> Image:
    """Return a colour (N, 3) for each range: near is red, far is blue."""
    near, far = np.log(RANGES_M)
    shade = np.clip((far - np.log(ranges_m)) / (far - near), 0.0, 1.0)
    colours = cv2.applyColorMap((255 * shade).astype(np.uint8).reshape(-1, 1), cv2.COLORMAP_TURBO)
    return np.asarray(colours.reshape(-1, 3), np.uint8)


def _write(name: str, image: Image, width_px: int) -> None:
    height_px = round(image.shape[0] * width_px / image.shape[1])
    method = cv2.INTER_AREA if width_px < image.shape[1] else cv2.INTER_CUBIC
    resized = cv2.resize(image, (width_px, height_px), interpolation=method)
    assert cv2.imwrite(str(FOLDER / name), resized, [cv2.IMWRITE_JPEG_QUALITY, 80])
    print(f"{name}: {(FOLDER / name).stat().st_size / 1e3:.0f} kB")


def drive(seconds: float = DRIVE_S, seed: int = 1) -> None:
    """Write drive.gif: panorama above, plan with what the robot has seen and both paths below."""
    from PIL import Image as PillowImage

    world, robot = load_world("room", seed), make_robot()
    script = TeachAndRepeat(lambda line: print(line, flush=True))
    with tempfile.TemporaryDirectory() as folder:
        config = load_config(None, [f"places.map={folder}/demo.omap", f"navigation.routes={folder}/routes"])
        run = simulate(world, robot, script, seconds=seconds, seed=seed, config=config)
    print("end:", script.end)
    cameras = SimulatedCameras(with_masks(robot.rig), robot.sensor, world, seed, robot.samples)
    images = [
        PillowImage.fromarray(frame).quantize(20, dither=PillowImage.Dither.NONE)
        for frame in _drive_frames(world, run, script.repeated_s, cameras, robot.rig)
    ]
    durations = [FRAME_MS] * (len(images) - 1) + [PAUSE_MS]
    images[0].save(
        FOLDER / "drive.gif", save_all=True, append_images=images[1:], duration=durations, loop=0, optimize=True
    )
    print(f"drive.gif: {len(images)} images, {(FOLDER / 'drive.gif').stat().st_size / 1e3:.0f} kB")


def _drive_frames(
    world: World, run: SimulatedRun, repeated_s: float, cameras: SimulatedCameras, rig: Rig
) -> Iterator[Image]:
    """Yield an RGB image for each second of the run."""
    tables = remap_tables(rig, rig.lower, fit_cylinder(rig, width_px=GIF_WIDTH_PX))
    last_s = run.ticks[-1].time_s
    for seq, time_s in enumerate(np.arange(1.0, last_s, 1.0)):
        until_ns = START_NS + round(time_s * 1e9)
        so_far = replace(
            run,
            rings=tuple(ring for ring in run.rings if ring.stamp_ns <= until_ns),
            ticks=tuple(tick for tick in run.ticks if tick.time_s <= time_s),
        )
        first, second = both_paths(so_far, repeated_s)
        plan = draw(world, seen_obstacles(so_far), first, second)
        plan = cv2.resize(
            plan, (GIF_WIDTH_PX, round(plan.shape[0] * GIF_WIDTH_PX / plan.shape[1])), interpolation=cv2.INTER_AREA
        )
        nearest = int(np.argmin(np.abs(run.stamps_ns - until_ns)))
        frame = cameras.frame("lower", seq, until_ns, run.T_world_base[nearest] @ rig.T_base_rig, Walkers(world.people))
        panorama = cv2.remap(gray(frame), *tables, cv2.INTER_LINEAR)
        coarse = (panorama.astype(int) * GREYS // 256 * 255 // (GREYS - 1)).astype(np.uint8)
        yield np.vstack([cv2.cvtColor(coarse, cv2.COLOR_GRAY2RGB), cv2.cvtColor(plan, cv2.COLOR_BGR2RGB)])


def main() -> None:
    """Write the images that are named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("which", choices=("stills", "drive"))
    FOLDER.mkdir(parents=True, exist_ok=True)
    {"stills": stills, "drive": drive}[parser.parse_args().which]()


if __name__ == "__main__":
    main()
