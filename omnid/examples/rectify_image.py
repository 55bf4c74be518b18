"""The geometry alone: `python -m omnid.examples.rectify_image RIG.toml LOWER.png PANORAMA.png`."""

import sys
from pathlib import Path

import cv2
import numpy as np

from calib import se3
from calib.panorama import fit_cylinder, remap_tables
from calib.rig_file import read_rig

if len(sys.argv) != 4:
    sys.exit(__doc__)
_, rig_file, image_file, panorama_file = sys.argv
rig, image = read_rig(Path(rig_file)), cv2.imread(image_file, cv2.IMREAD_GRAYSCALE)
if image is None:
    sys.exit(f"{image_file} cannot be read as an image")
point_rig = np.array([[2.0, 0.5, 0.3]])  # m, 2 m ahead of the rig
pixel = rig.lower.camera.project(se3.apply(rig.lower.T_cam_rig, point_rig))
ray = rig.lower.camera.lift(pixel)  # unit vector in the camera frame
print(f"the point is at pixel {pixel[0].round(2)}, whose ray is {ray[0].round(4)}")
tables = remap_tables(rig, rig.lower, fit_cylinder(rig))
if not cv2.imwrite(panorama_file, cv2.remap(image, *tables, cv2.INTER_LINEAR)):
    sys.exit(f"{panorama_file} cannot be written")
