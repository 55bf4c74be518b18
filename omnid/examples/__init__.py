"""Programs that show the Python API: copy one, and change it.

`replay_log.py`, `images_to_poses.py` and `rectify_image.py` have 15 to 23 lines. `serial_gyro.py` publishes a gyro on
the bus, `acceptance.py` measures lengths that a robot has driven, and `first_replay.ipynb` plots the sample.
"""
