"""Is the rig right? `rig_health.py`: matches between both panoramas say so at the start of a run and while it drives.

`drive_landmarks.py` follows landmarks over a drive, for `omnid calibrate drive`.
"""
