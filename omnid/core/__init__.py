"""Pure numerics: arrays in, arrays out. No clock, no thread, no logging, no I/O.

Begin with `docs/method.md`, which follows one pair of images through this package, and with `odometry/odometry.py`, its
centre. `stereo/` matches two panoramas, `odometry/` estimates the motion of the rig, `places/` recognises places,
`mapping/` and `obstacles/` say what is around, `navigation/` plans ways, `control/` decides what the wheels do, `rig/`
asks whether the calibration still holds. `floor.py` is the one floor of a run, `frames.py` the frames of poses and
covariances, `types/` the images that all share. Time comes as `stamp_ns` arguments; errors are values or exceptions,
never log lines. Loops over pixels are compiled by numba (`compiled.py`) and are in files `*_kernels.py` next to the
code that calls them.
"""
