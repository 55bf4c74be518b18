"""`omnid cameras`: list the cameras, with a udev rule that gives them persistent names, or show their images."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Generator, Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from omnid.commands.options import SETTINGS, cameras, command, option, settings_of
from omnid.errors import OmnidError

if TYPE_CHECKING:  # the list loads none of these
    from drivers.frame import Camera, Frame
    from omnid.calibration.images import Image
    from omnid.calibration.snapshot import CameraView

ROOT = Path("/")  # folder of sys and dev
CAMERAS: tuple[Camera, Camera] = ("lower", "upper")
SETTLE = 10  # images of a camera that are skipped: its exposure adapts in the first ones
_ADVICE = """
To name them /dev/omnid/lower and /dev/omnid/upper in whatever order they are plugged in, put this into {file}
(exchange lower and upper if they are the other way round), then run
`udevadm control --reload && udevadm trigger --subsystem-match=video4linux`:
"""


@command(
    option("--snapshot", type=Path, metavar="DIR", help="write DIR/lower.png and DIR/upper.png"),
    option("--log", type=Path, metavar="LOG", help="of --snapshot: take the images of a log"),
    *cameras("of --log: images of the {camera} camera; default: by name"),
    *SETTINGS,
    examples=(
        "cameras",
        "cameras --snapshot views --config /etc/omnid/omnid.toml",
        "cameras --snapshot views --log drive.mcap",
    ),
    description="List cameras and the udev rule to copy. With --snapshot write an image of each "
    "configured camera with the mirror's rim, and print a measure of its focus, which is highest where "
    "the lens is set best.",
)
def run(args: argparse.Namespace) -> int:
    """Print the list, or write the snapshots; return 1 if there is no camera, or something to correct."""
    if args.snapshot is not None:
        return _snapshot(args)
    for name in ("log", "lower", "upper"):
        if getattr(args, name) is not None:
            raise OmnidError(f"--{name} belongs to --snapshot DIR: name the folder for the images as well")
    return _list()


def _list() -> int:
    from drivers.cameras.v4l2_device import RULES_FILE, capture_devices, udev_rules

    devices = capture_devices(ROOT)
    if not devices:
        print(
            "omnid: no cameras: the kernel has no capture device; check the cables and the output of `dmesg`",
            file=sys.stderr,
        )
        return 1
    for device in devices:
        print(f"{device.node}  {device.name}  ({', '.join(filter(None, (device.driver, device.bus)))})")
        exposure = device.exposure or "no exposure time to set"
        for line in filter(None, (device.by_path, device.by_id, device.problem or exposure)):
            print(f"  {line}")
    print(f"\nThe modes of a camera: v4l2-ctl -d {devices[0].node} --list-formats-ext")
    if rules := list(udev_rules(devices)):
        print(_ADVICE.format(file=RULES_FILE), *rules, sep="\n")
    return 0


def _snapshot(args: argparse.Namespace) -> int:
    from calib.atomic_file import write_file
    from calib.rig_file import png
    from omnid.calibration.snapshot import annotated, described, view_of, warnings

    try:
        args.snapshot.mkdir(exist_ok=True)
    except OSError as error:
        raise OmnidError(f"--snapshot {args.snapshot}: {error.strerror}; name a folder that can be made") from error
    views: dict[str, CameraView] = {name: view_of(images) for name, images in _images(args)}
    for name, view in views.items():
        path = args.snapshot / f"{name}.png"
        write_file(path, png(annotated(name, view)))
        print(f"{path}: {described(view)}")
    problems = list(warnings(views))
    for problem in problems:
        print(f"omnid: {problem}", file=sys.stderr)
    return int(bool(problems))


def _images(args: argparse.Namespace) -> Iterator[tuple[Camera, list[Image]]]:
    """Yield the first images of each camera. Raise OmnidError or DriverError for one that gives none."""
    from itertools import islice

    from drivers.frame import gray
    from omnid.calibration.snapshot import IMAGES

    for camera in CAMERAS:
        frames = _of_device(args, camera) if args.log is None else _of_log(args, camera)
        with closing(frames):
            found = [gray(frame) for frame in islice(frames, IMAGES)]
        if not found:
            raise OmnidError(f"the {camera} camera gave no image: check its cable, and see `omnid doctor`")
        yield camera, found


def _of_log(args: argparse.Namespace, camera: Camera) -> Generator[Frame, None, None]:
    from drivers.logs.log_reader import LogReader

    config = settings_of(args)
    with closing(
        LogReader(args.log, args.lower, args.upper, bits=config.cameras.bits, rate_hz=config.log.rate_hz)
    ) as reader:
        yield from (frame for frame in reader.frames() if frame.camera == camera)


def _of_device(args: argparse.Namespace, camera: Camera) -> Generator[Frame, None, None]:
    """Yield frames once the exposure has adapted; they end when the camera gives none within the driver's time."""
    from itertools import islice

    from drivers.cameras.v4l2_camera import V4l2Camera

    settings = settings_of(args).cameras.settings(camera)

    def end_when_lost(_: int, __: str) -> None:
        if source.state.status == "lost":
            source.close()

    source = V4l2Camera(settings, camera, on_event=end_when_lost)
    with closing(source):
        yield from islice(source.frames(), SETTLE, None)
