"""Is the rig right? Evidence by the columns of its panoramas, and one state machine.

Begin with `rig_health.py`: a point of the world lies in one column of both panoramas; matches between them say whether
the cameras are exchanged, turned or shifted against the calibration, at the start of a run and while it drives.
`column_finding.py` estimates the rotation between the cameras from such matches, `drive_landmarks.py` follows landmarks
over a drive for `omnid calibrate drive`.
"""
