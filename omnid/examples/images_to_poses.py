"""Images in, poses out: `python -m omnid.examples.images_to_poses RIG.toml FOLDER`.

FOLDER holds lower/<stamp in ns>.png and upper/<the same stamp>.png.
"""

import sys
from pathlib import Path

import cv2

import omnid

if len(sys.argv) != 3:
    sys.exit(__doc__)
_, rig, images = sys.argv
odometry, folder = omnid.Odometry(rig), Path(images)
for stamp_ns in sorted(int(path.stem) for path in (folder / "lower").glob("*.png")):
    lower = cv2.imread(str(folder / "lower" / f"{stamp_ns}.png"), cv2.IMREAD_GRAYSCALE)
    upper = cv2.imread(str(folder / "upper" / f"{stamp_ns}.png"), cv2.IMREAD_GRAYSCALE)
    pose = odometry.process(stamp_ns, lower, upper)
    x_m, y_m, _ = pose.T_odom_rig[:3, 3]
    print(f"{stamp_ns} {pose.state} ({x_m:.3f}, {y_m:.3f}) m, {len(odometry.depth(pose).points)} points")
