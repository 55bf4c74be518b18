"""Hardware and logs: cameras, recorded files, motor controllers. Imports neither `calib` nor `omnid`.

Begin with the contracts: `frame.py` (an undecoded image, and its conversion to grey), `motor.py` (commands and status
of a base), `motion.py` (samples of wheels and gyro), `errors.py` (one line: what was requested, found, and what to do).
`cameras/` reads V4L2 devices or plays a log in their place, `logs/` reads and writes recordings of ROS 1 and 2 and
folders of images, `motors/` speaks to controllers on serial ports. Drivers block for a bounded time only, survive
devices that are unplugged, and take any bytes from outside without a traceback. They log nothing: events go to a
callback.
"""
