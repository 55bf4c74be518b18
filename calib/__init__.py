"""Geometry of omnidirectional cameras: rigid transforms, camera models, rigs, panoramas, calibration.

A library of its own: it imports neither `drivers` nor `omnid`, reads no clock, starts no thread and logs nothing. Only
the readers and writers of files (`rig_file.py`, `importers.py`) touch the disk. All angles are radians, all lengths
metres, pixels are (u, v) with integer centres; `T_a_b` maps points of frame b to frame a.

Begin with `rig.py`: a `Rig` holds two mounted cameras and the rectified frame, in which epipolar lines are columns.
`panorama.py` makes the table that dewarps an image onto the cylinder of that frame. `models/` has the cameras,
`boards/` finds boards in images, `fit/` estimates rigs from what their cameras saw. `rig_file.py` is the text format
`rig.toml`, and `importers.py` reads the calibrations of other programs.
"""
