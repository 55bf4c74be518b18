"""Whether the rig's file is right: of the cameras that a run has, and still true after a knock.

Begin with `rig_health.py`: matches between both panoramas of the first pairs, and of views of the drive, show whether
the cameras are exchanged, or turned against the file; `calib/fit/rig_drift.py` measures by how much.
`drive_landmarks.py` follows landmarks over a drive, for `omnid calibrate drive`. Images in, findings out: a run decides
what a finding means (`rig.check`).
"""
