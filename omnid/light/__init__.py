"""Exposure of live cameras, by what the mirrors show: all of it is `exposure.py`.

It takes images and returns requests, within the limits of motion blur; the drivers of the cameras carry them out
between two images. `cameras.auto_exposure` chooses between this, the camera's own automatic mode, and fixed values.
"""
