"""Programs that show the Python API: copy one, and change it.

`first_replay.ipynb` replays the sample and plots it; `rectify_image.py` is the geometry alone, in 23 lines.
`serial_gyro.py` publishes a gyro on the bus, and `acceptance.py` measures lengths that a robot has driven.
"""
