"""Make the log that `omnid demo` replays: two_walls at 512x512, grey, with its rig attached.

python -m tests.replay.make_sample ../shared/data/two_walls omnid/sample
"""

from __future__ import annotations

import argparse
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from rosbags.typesys import Stores, get_typestore

from calib.importers import import_chain
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera, Rig
from calib.rig_file import rig_toml
from drivers.frame import Frame, gray
from drivers.logs.log_reader import LogReader
from drivers.logs.mcap_writer import LogWriter
from omnid.formats.tum import read_tum

SIDE_PX = 512
QUALITY = 70  # 198 images in less than 7.5 MB
SCHEMA = "sensor_msgs/msg/CompressedImage"


def main() -> None:
    """Write log.mcap and truth.txt."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", type=Path, help="folder with log.mcap, camchain.yaml and truth.txt")
    parser.add_argument("target", type=Path, help="folder of the package")
    parser.add_argument("--quality", type=int, default=QUALITY, help="of the JPEGs")
    args = parser.parse_args()
    # The floor of the world is at z = 0, and the truth is the pose of the lower viewpoint.
    height_m = float(read_tum(args.source / "truth.txt").T[0, 2, 3])
    rig = reduced(import_chain(args.source / "camchain.yaml")).at_height(height_m)
    reader = LogReader(args.source / "log.mcap")
    with LogWriter(args.target / "log.mcap", {"rig.toml": rig_toml(rig).encode()}, compression="none") as writer:
        for frame in reader.frames():
            writer.write(reader.topics[frame.camera], SCHEMA, message(frame, args.quality), frame.stamp_ns)
    shutil.copyfile(args.source / "truth.txt", args.target / "truth.txt")
    print(f"{(args.target / 'log.mcap').stat().st_size / 1e6:.2f} MB")


def message(frame: Frame, quality: int) -> bytes:
    """Return the frame's image, reduced in size, as CDR."""
    small = cv2.resize(gray(frame), (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_AREA)
    jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1])[1]
    store = get_typestore(Stores.ROS2_HUMBLE)
    stamp = store.types["builtin_interfaces/msg/Time"](*divmod(frame.stamp_ns, 10**9))
    header = store.types["std_msgs/msg/Header"](stamp, frame.camera)
    image = store.types[SCHEMA](header, "jpeg", np.asarray(jpeg).reshape(-1))
    return bytes(store.serialize_cdr(image, SCHEMA))


def reduced(rig: Rig) -> Rig:
    """Return the rig of the reduced images."""
    return replace(rig, lower=_reduced_camera(rig.lower), upper=_reduced_camera(rig.upper))


def _reduced_camera(mounted: MountedCamera) -> MountedCamera:
    camera = mounted.camera
    assert isinstance(camera, UnifiedCamera)
    s = SIDE_PX / camera.size[0]
    focal = (camera.focal[0] * s, camera.focal[1] * s)
    center = ((camera.center[0] + 0.5) * s - 0.5, (camera.center[1] + 0.5) * s - 0.5)  # pixel centres are integers
    return replace(mounted, camera=replace(camera, focal=focal, center=center, size=(SIDE_PX, SIDE_PX)))


if __name__ == "__main__":
    main()
