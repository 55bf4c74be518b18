"""Checks of `omnid doctor`: is this computer, with these settings, ready to be a robot?

Begin with `checks.py`: each check takes plain values, checks one subject (cameras, motor, rig, rights, disk, bus) and
yields findings: a severity, what was found, and what to do. The command joins them and sets the exit code.
`wheel_wiring.py` is `omnid motor test`: it turns one wheel after the other, derives sides and directions of the
motors, and shows their scale. Checks change nothing, and end within seconds where a device does not answer.
"""
