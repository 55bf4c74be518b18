"""Exposure of live cameras, by what the mirrors show.

`exposure.py` is all of it: the brightness of the useful part of both panoramas, the control law (one exposure and gain
for both cameras, within the limits of motion blur), and the requests to the cameras, which carry them out between two
images. It takes images and returns requests; the drivers of the cameras set them. `cameras.auto_exposure` chooses
between this, the camera's own automatic mode, and fixed values.
"""
