"""The process that steers the base, and the daemon's link to it.

Begin with `controller.py`: a loop of fixed period takes messages from a socket pair, steps the control law of
`core/control`, and sends the command to the motor driver. `process.py` starts and ends it, `link.py` is the daemon's
side, `ipc.py` what passes between them. It is one thread with real-time priority, without numpy and
OpenCV; end of file on the socket, whatever the reason, is a ramp to a stop.
"""
