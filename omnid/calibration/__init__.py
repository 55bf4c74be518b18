"""From images, logs and live cameras to a rig: what the commands below `omnid calibrate` call.

Begin with `rig.py` (`omnid.calibrate_rig`: boards to a rig and its report) or `drive.py` (`omnid.calibrate_drive`: a
drive to a better rig). `images.py` reads pairs of images from folders and logs, `board_search.py` finds boards in them
on all cores, `live_boards.py` guides a person who holds a board before live cameras, `rig_report.py` writes the HTML
report. `rig_check.py` asks whether a rig still fits a log, `from_log.py` finds the height above the floor and the masks
of what is fixed to a camera. `snapshot.py` measures focus and light. The estimates themselves are in `calib/fit`.
"""
